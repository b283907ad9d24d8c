//! A network of its own for each sandbox, by pasta (package passt): a network namespace whose packets pasta sends on as an
//! ordinary program of this user. The machine's loopback, its abstract sockets and the ports of other simulations are out
//! of reach; one port of the machine is forwarded into it.
//!
//! pasta starts bubblewrap and ends with it; bubblewrap ends with pasta, and pasta with the server (`PR_SET_PDEATHSIG`).
//! In the namespace bubblewrap begins as its root. Before it gives that up, nft loads a packet filter there, which no
//! program in the sandbox can change.

use std::ffi::OsString;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, UdpSocket};
use std::path::{Path, PathBuf};

use which::which;

use super::mount::Mount;
use crate::simulation::config::{SandboxNetwork, SimulationConfig};

/// The programs and settings that give each sandbox a network of its own.
pub struct OwnNetwork {
    pasta: PathBuf,
    /// The program that loads the packet filter; `None` if it is missing or fails.
    pub nft: Option<PathBuf>,
    /// Whether programs reach nothing at all.
    pub closed: bool,
    loopback: IpAddr,
    /// The address of the machine on which the port of each simulation is forwarded: the one on which the server listens,
    /// or the loopback where only this server is to reach simulations.
    forwarded: IpAddr,
}

/// Where programs in a sandbox ask for names, and pasta asks the machine's own name server; on a machine without IPv4 the
/// second one.
const RESOLVER: &str = "169.254.1.1";
const RESOLVER_6: &str = "fd53::1:1";
/// Addresses of the internet (for documentation), to which nothing is sent.
const INTERNET: IpAddr = IpAddr::V4(Ipv4Addr::new(203, 0, 113, 7));
const INTERNET_6: IpAddr = IpAddr::V6(Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 7));
/// The file that names it, and that of a simulation in the folder of its instance.
const RESOLV_CONF: &str = "/etc/resolv.conf";
const OWN_RESOLV_CONF: &str = "resolv.conf";
/// The socket of the system's log.
const SYSTEM_LOG: &str = "/dev/log";
/// Path of nft, which is not in the `PATH` of ordinary users.
const NFT: &str = "/usr/sbin/nft";
/// Loads the packet filter of the file `$1`, if there is one, and becomes the program that follows. Versions of pasta until
/// 2023 leave the socket on which they listen, which is one of the machine's network, to what they start.
const BEGIN: &str = r#"exec 3>&- 4>&- 5>&- 6>&- 7>&- 8>&- 9>&-
[ -z "$1" ] || "$0" -f "$1" || exit
shift
exec "$@""#;

impl OwnNetwork {
    /// Prepares networks for a server with this configuration.
    ///
    /// # Errors
    /// Why there can be none, as text for an administrator.
    pub fn new(config: &SimulationConfig) -> Result<Self, String> {
        if nix::unistd::getuid().is_root() {
            return Err("pasta gives none to root, run the server as a user of its own".to_owned());
        }
        let missing = |program, package| {
            format!("{program} is not there; on Debian, Ubuntu and Fedora the package {package} has it")
        };
        let pasta = which("pasta").map_err(|_| missing("pasta", "passt"))?;
        let closed = config.sandbox.network == SandboxNetwork::Closed;
        let nft = which("nft").ok().or_else(|| Some(PathBuf::from(NFT)).filter(|nft| nft.is_file()));
        if closed && nft.is_none() {
            return Err(missing("nft", "nftables"));
        }
        // pasta makes networks without IPv4 where the machine has no route for it, and then forwards nothing from 127.0.0.1.
        let loopback = if has_route(INTERNET) { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() };
        let forwarded = if config.ports_are_public() { config.bind } else { loopback };
        Ok(Self { pasta, nft, closed, loopback, forwarded })
    }

    /// Drops the packet filter, if the configuration allows that. Returns whether there was one.
    pub fn give_up_filter(&mut self) -> bool {
        !self.closed && self.nft.take().is_some()
    }

    /// The address at which this server reaches the forwarded port of each simulation.
    pub fn reached(&self) -> IpAddr {
        if self.forwarded.is_unspecified() { self.loopback } else { self.forwarded }
    }

    /// The words that run a program in a network of its own, into which this port is forwarded. Writes the files that it needs
    /// into the instance's folder.
    ///
    /// # Errors
    /// When these can't be written.
    pub fn command(&self, instance: &Path, port: u16) -> io::Result<Vec<OsString>> {
        let mut command: Vec<OsString> = ["setpriv", "--pdeathsig", "KILL", "--"].map(Into::into).into();
        command.push(self.pasta.clone().into());
        // By default it maps its gateway to the machine's loopback, and opens ports to and from the machine.
        let fixed = ["--config-net", "--no-map-gw", "-u", "none", "-T", "none", "-U", "none", "-t"];
        command.extend(fixed.map(Into::into));
        // A port alone is one of all addresses, of either version of IP.
        let is_any = self.forwarded == Ipv6Addr::UNSPECIFIED;
        command.push(if is_any { port.to_string() } else { format!("{}/{port}", self.forwarded) }.into());
        // It prints a warning about a version of IP for which it finds no route.
        if self.loopback.is_ipv4() && !has_route(INTERNET_6) {
            command.push("--ipv4-only".into());
        }
        // Without the system's log it prints errors. With it, AppArmor may allow no other file.
        if !Path::new(SYSTEM_LOG).exists() {
            command.extend(["--log-file".into(), instance.join("pasta.log").into()]);
        }
        if !self.closed {
            let resolver = if self.loopback.is_ipv4() { RESOLVER } else { RESOLVER_6 };
            command.extend(["--dns-forward", resolver].map(Into::into));
            std::fs::write(instance.join(OWN_RESOLV_CONF), format!("nameserver {resolver}\n"))?;
        }
        command.extend(["--", "/bin/sh", "-c"].map(Into::into));
        let (mut loader, mut rules) = (Path::new("sh"), PathBuf::new());
        if let Some(nft) = &self.nft {
            (loader, rules) = (nft, instance.join("network.nft"));
            std::fs::write(&rules, if self.closed { include_str!("closed.nft") } else { include_str!("own.nft") })?;
        }
        command.extend([BEGIN.into(), loader.into(), rules.into()]);
        // bubblewrap finds its own processes in `/proc`, and pasta has begun to count them anew.
        command.extend(["unshare", "--mount-proc", "--"].map(Into::into));
        Ok(command)
    }

    /// The mount by which programs in a sandbox resolve names.
    pub fn mounts(&self, instance: &Path) -> Option<Mount> {
        let at = Path::new(RESOLV_CONF).canonicalize().ok().filter(|_| !self.closed)?;
        Some(Mount::file(at, instance.join(OWN_RESOLV_CONF)))
    }
}

/// Whether the machine has a route to this address.
fn has_route(address: IpAddr) -> bool {
    let any: IpAddr = if address.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
    UdpSocket::bind((any, 0)).is_ok_and(|socket| socket.connect((address, 9)).is_ok())
}
