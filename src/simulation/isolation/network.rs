//! A network of its own for each sandbox, by pasta (package passt): a network namespace whose packets pasta forwards as
//! an ordinary program of this user. The machine's loopback, its abstract sockets and the ports of other simulations
//! are out of reach; one port of the machine is forwarded into the namespace.
//!
//! pasta starts bubblewrap and ends with it; bubblewrap ends with pasta, and pasta with the server
//! (`PR_SET_PDEATHSIG`). Both nft and bubblewrap start as root of the namespace: nft loads a packet filter, then
//! bubblewrap drops the privileges, so that no program in the sandbox can change the filter.

use std::ffi::OsString;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, UdpSocket};
use std::path::{Path, PathBuf};

use which::which;

use super::mount::Mount;
use super::names;
use crate::simulation::config::{SandboxNetwork, SimulationConfig};

/// The programs and settings that give each sandbox a network of its own.
pub struct OwnNetwork {
    pasta: PathBuf,
    /// The program that loads the packet filter; `None` if it is missing or fails.
    pub nft: Option<PathBuf>,
    /// The port of the machine's loopback at which names are resolved; `None` if programs reach nothing at all.
    names: Option<u16>,
    /// Whether the configuration demands a network that is isolated in full.
    needs_filter: bool,
    loopback: IpAddr,
    /// The address of the machine on which the port of each simulation is forwarded: the one on which the server
    /// listens, or the loopback if only this server may reach simulations.
    forwarded: IpAddr,
}

/// Internet addresses (reserved for documentation) to look up a route; nothing is sent to them.
const INTERNET: IpAddr = IpAddr::V4(Ipv4Addr::new(203, 0, 113, 7));
const INTERNET_6: IpAddr = IpAddr::V6(Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 7));
/// The system's resolver configuration, and its replacement in the instance's directory.
const RESOLV_CONF: &str = "/etc/resolv.conf";
const OWN_RESOLV_CONF: &str = "resolv.conf";
/// The port of a network's loopback that pasta forwards to [`names`].
const NAMES: u16 = 53;
/// The socket of the system's log.
const SYSTEM_LOG: &str = "/dev/log";
/// Path of nft, which is not in the `PATH` of ordinary users.
const NFT: &str = "/usr/sbin/nft";
/// Loads the packet filter of the file `$1`, if there is one, and executes the program that follows. First closes the
/// listening socket, which is one of the machine's network: versions of pasta until 2023 leak it to their child.
const BEGIN: &str = r#"exec 3>&- 4>&- 5>&- 6>&- 7>&- 8>&- 9>&-
[ -z "$1" ] || "$0" -f "$1" || exit
shift
exec "$@""#;

impl OwnNetwork {
    /// Prepares networks for a server with this configuration.
    ///
    /// # Errors
    /// Why it can't prepare them, as text for an administrator.
    pub fn new(config: &SimulationConfig) -> Result<Self, String> {
        if nix::unistd::getuid().is_root() {
            return Err("pasta gives none to root, run the server as a user of its own".to_owned());
        }
        let missing = |program, package| {
            format!("{program} is not there; on Debian, Ubuntu and Fedora the package {package} has it")
        };
        let pasta = which("pasta").map_err(|_| missing("pasta", "passt"))?;
        let nft = which("nft")
            .ok()
            .or_else(|| Some(PathBuf::from(NFT)).filter(|nft| nft.is_file()));
        let needs_filter = config.sandbox.network.is_demanded();
        if needs_filter && nft.is_none() {
            return Err(missing("nft", "nftables"));
        }
        // If the machine has no IPv4 route, pasta makes networks without IPv4, and forwards nothing from 127.0.0.1.
        let loopback = if has_route(INTERNET) {
            Ipv4Addr::LOCALHOST.into()
        } else {
            Ipv6Addr::LOCALHOST.into()
        };
        let forwarded = if config.ports_are_public() {
            config.bind
        } else {
            loopback
        };
        let is_closed = config.sandbox.network == SandboxNetwork::Closed;
        let names = (!is_closed).then(|| names::start(loopback)).transpose();
        Ok(Self {
            pasta,
            nft,
            needs_filter,
            names: names.map_err(|error| format!("names can't be resolved for it: {error}"))?,
            loopback,
            forwarded,
        })
    }

    /// Drops the packet filter, if the configuration allows that. Returns whether there was one.
    pub fn give_up_filter(&mut self) -> bool {
        !self.needs_filter && self.nft.take().is_some()
    }

    /// Whether programs reach nothing at all.
    pub fn is_closed(&self) -> bool {
        self.names.is_none()
    }

    /// The address at which this server reaches the forwarded port of each simulation.
    pub fn reached(&self) -> IpAddr {
        if self.forwarded.is_unspecified() {
            self.loopback
        } else {
            self.forwarded
        }
    }

    /// The prefix of a command that runs it in a network of its own, into which this port is forwarded. Writes the
    /// files that it needs into the instance's directory.
    ///
    /// # Errors
    /// When these files can't be written.
    pub fn command(&self, instance: &Path, port: u16) -> io::Result<Vec<OsString>> {
        let mut command: Vec<OsString> = ["setpriv", "--pdeathsig", "KILL", "--"].map(Into::into).into();
        command.push(self.pasta.clone().into());
        // By default pasta maps its gateway to the machine's loopback, and forwards ports in both directions.
        command.extend(["--config-net", "--no-map-gw", "-u", "none", "-U", "none", "-T"].map(Into::into));
        let names = self.names.map(|port| format!("{NAMES}:{port}"));
        command.push(names.map_or_else(|| "none".into(), Into::into));
        command.push("-t".into());
        // A port without an address is forwarded from all addresses, IPv4 and IPv6.
        let is_any = self.forwarded == Ipv6Addr::UNSPECIFIED;
        command.push(
            if is_any {
                port.to_string()
            } else {
                format!("{}/{port}", self.forwarded)
            }
            .into(),
        );
        // pasta prints a warning about a version of IP without a route.
        if self.loopback.is_ipv4() && !has_route(INTERNET_6) {
            command.push("--ipv4-only".into());
        }
        // Without the system's log pasta prints errors. If there is one, AppArmor may not allow a log file.
        if !Path::new(SYSTEM_LOG).exists() {
            command.extend(["--log-file".into(), instance.join("pasta.log").into()]);
        }
        if !self.is_closed() {
            let text = format!("nameserver {}\noptions use-vc\n", self.loopback);
            std::fs::write(instance.join(OWN_RESOLV_CONF), text)?;
        }
        command.extend(["--", "/bin/sh", "-c"].map(Into::into));
        let mut loader = Path::new("sh");
        let mut rules = PathBuf::new();
        if let Some(nft) = &self.nft {
            (loader, rules) = (nft, instance.join("network.nft"));
            std::fs::write(&rules, self.rules())?;
        }
        command.extend([BEGIN.into(), loader.into(), rules.into()]);
        // pasta starts a new PID namespace, and bubblewrap needs a `/proc` that matches it.
        command.extend(["unshare", "--mount-proc", "--"].map(Into::into));
        Ok(command)
    }

    /// The packet filter, as nft reads it.
    fn rules(&self) -> String {
        if self.is_closed() {
            return include_str!("closed.nft").to_owned();
        }
        let version = if self.loopback.is_ipv4() { "ipv4" } else { "ipv6" };
        include_str!("own.nft").replace("RELAY", version)
    }

    /// The mount of the resolver configuration, if programs in the sandbox may resolve names.
    pub fn mounts(&self, instance: &Path) -> Option<Mount> {
        let at = Path::new(RESOLV_CONF)
            .canonicalize()
            .ok()
            .filter(|_| !self.is_closed())?;
        Some(Mount::file(at, instance.join(OWN_RESOLV_CONF)))
    }
}

/// Whether the machine has a route to this address.
fn has_route(address: IpAddr) -> bool {
    let any: IpAddr = if address.is_ipv4() {
        Ipv4Addr::UNSPECIFIED.into()
    } else {
        Ipv6Addr::UNSPECIFIED.into()
    };
    UdpSocket::bind((any, 0)).is_ok_and(|socket| socket.connect((address, 9)).is_ok())
}
