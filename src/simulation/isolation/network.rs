//! A network of its own for each sandbox, by pasta (package passt): a network namespace whose packets pasta sends on as an
//! ordinary program of this user. The machine's loopback, its abstract sockets and the ports of other simulations are not
//! in it; one port of the machine is forwarded into it.
//!
//! pasta starts bubblewrap and ends with it; bubblewrap ends with pasta, and pasta with the server (`PR_SET_PDEATHSIG`).
//! In the namespace bubblewrap begins as its root. Before it gives that up, nft loads a packet filter there, which no
//! program in the sandbox can change.

use std::ffi::OsString;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::path::{Path, PathBuf};

use which::which;

use super::mount::{Mount, MountKind};
use super::program::Program;
use crate::simulation::config::{SandboxNetwork, SimulationConfig};

/// What gives each sandbox a network of its own.
#[derive(Debug)]
pub struct OwnNetwork {
    pasta: PathBuf,
    setpriv: PathBuf,
    unshare: PathBuf,
    /// What loads the packet filter; `None` where that can't be had.
    nft: Option<PathBuf>,
    closed: bool,
    forwarded: IpAddr,
}

/// Where programs in a sandbox ask for names, and pasta asks the machine's own name server.
const RESOLVER: &str = "169.254.1.1";
/// The file that names it.
const RESOLV_CONF: &str = "/etc/resolv.conf";
/// The socket of the system's log.
const SYSTEM_LOG: &str = "/dev/log";
/// Where root has nft, and others don't look for programs.
const NFT: &str = "/usr/sbin/nft";
/// Versions of pasta until 2023 leave the socket on which they listen, which is one of the machine's network, to what they
/// start.
const CLOSE: &str = "exec 3>&- 4>&- 5>&- 6>&- 7>&- 8>&- 9>&-";
/// Fails where a program in the sandbox has inherited a socket.
pub const CHECK: &str = "for one in /proc/self/fd/*; do case $(readlink \"$one\") in socket:*) \
                         echo 'pasta leaves sockets open' >&2; exit 1 ;; esac; done";

impl OwnNetwork {
    /// Prepares networks for a server with this configuration.
    ///
    /// # Errors
    /// Why there can be none, in words for an administrator.
    pub fn new(config: &SimulationConfig) -> Result<Self, String> {
        if nix::unistd::getuid().is_root() {
            return Err("pasta gives none to root, run the server as a user of its own".to_owned());
        }
        if let Some(display) = remote_display(config) {
            return Err(format!("the display {display} is reached by TCP, which such a network closes"));
        }
        let missing = |program, package| {
            format!("{program} is not there; on Debian, Ubuntu and Fedora the package {package} has it")
        };
        let pasta = which("pasta").map_err(|_| missing("pasta", "passt"))?;
        let util = |program| which(program).map_err(|_| missing(program, "util-linux"));
        let (setpriv, unshare) = (util("setpriv")?, util("unshare")?);
        let closed = config.sandbox.network == SandboxNetwork::Closed;
        let nft = which("nft").ok().or_else(|| Some(PathBuf::from(NFT)).filter(|nft| nft.is_file()));
        if closed && nft.is_none() {
            return Err(missing("nft", "nftables"));
        }
        Ok(Self { pasta, setpriv, unshare, nft, closed, forwarded: forwarded(config) })
    }

    /// Whether programs reach nothing at all.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.closed
    }

    /// Whether a packet filter keeps programs from private addresses.
    #[must_use]
    pub fn is_filtered(&self) -> bool {
        self.nft.is_some()
    }

    /// Does without the packet filter, if that is allowed and makes a difference.
    pub fn give_up_filter(&mut self) -> bool {
        !self.closed && self.nft.take().is_some()
    }

    /// The address of the machine on which the port of each simulation is forwarded.
    #[must_use]
    pub fn forwarded(&self) -> IpAddr {
        self.forwarded
    }

    /// The words that run a program in a network of its own. Writes the files that it needs into the instance's folder.
    ///
    /// # Errors
    /// When these can't be written.
    pub fn command(&self, program: &Program<'_>) -> io::Result<Vec<OsString>> {
        let mut command: Vec<OsString> = vec![self.setpriv.clone().into()];
        command.extend(["--pdeathsig", "KILL", "--"].map(Into::into));
        command.push(self.pasta.clone().into());
        // It would take the machine's loopback for its gateway, and open ports to and from the machine by itself.
        let fixed = ["--config-net", "--no-map-gw", "-u", "none", "-T", "none", "-U", "none", "-t"];
        command.extend(fixed.map(Into::into));
        // A port alone is one of all addresses, of either version of IP.
        let is_any = self.forwarded == Ipv6Addr::UNSPECIFIED;
        let port = program.port;
        command.push(if is_any { port.to_string() } else { format!("{}/{port}", self.forwarded) }.into());
        // It complains where the system has no log. Where it has one, AppArmor may allow no other file.
        if !Path::new(SYSTEM_LOG).exists() {
            command.extend(["--log-file".into(), program.instance.join("pasta.log").into()]);
        }
        if !self.closed {
            command.extend(["--dns-forward", RESOLVER].map(Into::into));
            std::fs::write(resolv_conf(program.instance), format!("nameserver {RESOLVER}\n"))?;
        }
        command.extend(["--", "/bin/sh", "-c"].map(Into::into));
        if let Some(nft) = &self.nft {
            let rules = program.instance.join("network.nft");
            std::fs::write(&rules, if self.closed { include_str!("closed.nft") } else { include_str!("own.nft") })?;
            command.push(format!("{CLOSE}; \"$0\" -f \"$1\" && shift && exec \"$@\"").into());
            command.extend([nft.clone().into(), rules.into()]);
        } else {
            command.push(format!("{CLOSE}; exec \"$@\"").into());
            command.push("sh".into());
        }
        // bubblewrap finds its own processes in `/proc`, and pasta has begun to count them anew.
        command.extend([self.unshare.clone().into(), "--mount-proc".into(), "--".into()]);
        Ok(command)
    }

    /// What a sandbox shows so that programs find names.
    pub fn mounts(&self, instance: &Path) -> Option<Mount> {
        let at = Path::new(RESOLV_CONF).canonicalize().ok().filter(|_| !self.closed)?;
        Some(Mount { at, content: MountKind::ReadableFile(resolv_conf(instance)) })
    }
}

/// A display that simulations are given and reach by TCP.
fn remote_display(config: &SimulationConfig) -> Option<String> {
    let of_gpus = (0..config.displays_of_gpus().len()).map(|index| config.display_on(u32::try_from(index).ok()));
    let mut displays = of_gpus.chain([config.display_on(None)]).filter(|_| !config.xvfb);
    displays.find(|display| !display.starts_with(':') && !display.starts_with("unix:"))
}

fn resolv_conf(instance: &Path) -> PathBuf {
    instance.join("resolv.conf")
}

/// The address of the machine on which the port of each simulation is forwarded: the one on which the server listens, or
/// the loopback where only this server is to reach simulations. Nothing else decides it.
fn forwarded(config: &SimulationConfig) -> IpAddr {
    if config.ports_are_public() { config.bind } else { Ipv4Addr::LOCALHOST.into() }
}
