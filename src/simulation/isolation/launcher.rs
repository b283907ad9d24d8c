//! The launcher of simulations on this server: its isolation level is decided once at start, the same for all.
//!
//! A level of isolation turns a program into a command that runs it at that level ([`SpawnSpec`]).

use std::ffi::OsString;
use std::fmt;
use std::io;
use std::net::IpAddr;
use std::path::{Path, PathBuf};

use nix::sys::resource::{Resource, getrlimit};
use serde::Serialize;
use which::which;

use super::cgroup::{Cgroup, Cgroups};
use super::inherited_environment;
use super::network::OwnNetwork;
use super::program::Program;
use super::sandbox::Sandbox;
use super::watcher::MostProcesses;
use crate::simulation::config::{IsolationSetting, ResourceLimits, SandboxNetwork, SimulationConfig, VariableName};
use crate::simulation::process::SpawnSpec;

/// The levels of isolation that this server supports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum IsolationLevel {
    /// A process group of the server's own user.
    None,
    /// bubblewrap.
    Sandbox,
    /// Docker.
    Container,
}

/// The configuration asks for what this machine does not have.
#[derive(Debug, thiserror::Error)]
pub enum IsolationError {
    /// A level.
    #[error("isolation is \"sandbox\", but {0}; \"none\" runs worlds without it")]
    Level(String),
    /// A network of simulations' own.
    #[error("sandbox.network is \"own\" or \"closed\", but {0}; \"shared\" runs worlds in the machine's network")]
    Network(String),
}

/// Which network the programs of worlds have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Network {
    /// The machine's.
    Shared,
    /// One of each simulation's own.
    Own,
    /// The same, and nothing can be reached from it.
    Closed,
}

/// Soft limit of open files that programs expect; programs that use `select` can't handle more.
const USUAL_FILES: u64 = 1024;

/// How a program is started at a level.
enum Method {
    /// Without a wrapper.
    Plain,
    /// In a sandbox.
    Sandbox(Box<Sandbox>),
    /// In a container, which is not started here.
    Container,
}

/// Launches simulations at one level.
pub struct Launcher {
    method: Method,
    /// Why it is not a sandbox, with `isolation: "auto"`.
    shortcoming: Option<String>,
    /// Why it has no network of its own, where the configuration leaves it to the machine.
    why_shared: Option<String>,
    cgroups: Option<Cgroups>,
    controllers: Vec<&'static str>,
    prlimit: Option<PathBuf>,
    variables: Vec<VariableName>,
    limits: ResourceLimits,
}

impl Launcher {
    /// Determines the isolation level. Blocks for some milliseconds, for ten seconds at most.
    ///
    /// # Errors
    /// When the configuration requires a level that is not available.
    pub fn new(config: &SimulationConfig) -> Result<Self, IsolationError> {
        // Before a sandbox is tried: what that has started may still be in this server's group.
        let controllers = Cgroups::controllers();
        let sandbox = || Sandbox::new(config).and_then(Sandbox::tried);
        let (method, shortcoming) = match config.isolation {
            IsolationSetting::None => (Method::Plain, None),
            IsolationSetting::Container => (Method::Container, None),
            IsolationSetting::Sandbox => (Method::Sandbox(Box::new(sandbox().map_err(IsolationError::Level)?)), None),
            IsolationSetting::Auto => match sandbox() {
                Ok(sandbox) => (Method::Sandbox(Box::new(sandbox)), None),
                Err(why) => (Method::Plain, Some(why)),
            },
        };
        let mut launcher = Self {
            method,
            shortcoming,
            why_shared: None,
            cgroups: None,
            controllers,
            prlimit: which("prlimit").ok(),
            variables: config.environment.clone(),
            limits: config.limits.clone(),
        };
        launcher.join_network(config)?;
        Ok(launcher)
    }

    /// Gives simulations networks of their own, if the configuration wants that and they can be had.
    fn join_network(&mut self, config: &SimulationConfig) -> Result<(), IsolationError> {
        let wanted = config.sandbox.network;
        let joined = match &mut self.method {
            Method::Sandbox(_) if wanted == SandboxNetwork::Shared => return Ok(()),
            Method::Sandbox(sandbox) => OwnNetwork::new(config).and_then(|network| sandbox.join(network)),
            Method::Plain | Method::Container => Err(self.shortcoming.clone().unwrap_or_default()),
        };
        match joined {
            Err(why) if wanted.is_demanded() => Err(IsolationError::Network(why)),
            joined => {
                self.why_shared = joined.err().filter(|_| self.level() == IsolationLevel::Sandbox);
                Ok(())
            }
        }
    }

    /// The same for a server that is starting: it logs the level, and each simulation gets a control group of its own
    /// if these are delegated to this server.
    ///
    /// # Errors
    /// When the configuration requires a level that is not available.
    pub fn start(config: &SimulationConfig) -> Result<Self, IsolationError> {
        let cgroups = match config.isolation {
            IsolationSetting::Container => None,
            _ => Cgroups::delegated(),
        };
        let mut launcher = Self::new(config)?;
        match &launcher.shortcoming {
            Some(why) => log::warn!("worlds' programs may do whatever this user may (isolation: none): {why}"),
            None => log::info!("isolation: {}", launcher.level()),
        }
        if let Some(network) = launcher.network_in_words() {
            let level = if launcher.why_shared.is_some() { log::Level::Warn } else { log::Level::Info };
            log::log!(level, "network of simulations: {network}");
        }
        for line in launcher.unenforced_limits() {
            log::warn!("{line}");
        }
        launcher.cgroups = cgroups.map(|cgroups| cgroups.with_limits(&launcher.limits, launcher.runners()));
        Ok(launcher)
    }

    /// The limits that this machine can't enforce, one line each.
    pub fn unenforced_limits(&self) -> Vec<String> {
        if self.level() == IsolationLevel::Container {
            // Docker enforces them.
            return Vec::new();
        }
        let mut lines = Vec::new();
        if self.prlimit.is_none() {
            lines.push(
                "limits.openFiles does not hold, and files, core dumps and processes have no limit of the kernel's: prlimit \
                 is not there; on Debian, Ubuntu and Fedora the package util-linux has it"
                    .to_owned(),
            );
        }
        if matches!(&self.method, Method::Sandbox(sandbox) if !sandbox.ends_namespaces()) {
            lines.push(
                "worlds' programs can make user namespaces, which brings more of the kernel within their reach: only \
                 bubblewrap from 0.8 on forbids it"
                    .to_owned(),
            );
        }
        let (controllers, limits) = (&self.controllers, &self.limits);
        for (key, controller, is_set) in
            [("limits.memory", "memory", limits.memory.is_some()), ("limits.cores", "cpu", limits.cores.is_some())]
        {
            if is_set && !controllers.contains(&controller) {
                lines.push(format!(
                    "{key} does not hold: systemd has not delegated control groups with the controller {controller} to \
                     this program (Delegate={controller} in its unit)"
                ));
            }
        }
        lines
    }

    /// The isolation level of all simulations.
    pub fn level(&self) -> IsolationLevel {
        match self.method {
            Method::Plain => IsolationLevel::None,
            Method::Sandbox(_) => IsolationLevel::Sandbox,
            Method::Container => IsolationLevel::Container,
        }
    }

    /// How many processes of each simulation are what runs it: bubblewrap has one outside of the sandbox and one inside, and
    /// pasta is one.
    pub fn runners(&self) -> u64 {
        match &self.method {
            Method::Plain | Method::Container => 0,
            Method::Sandbox(sandbox) => 2 + u64::from(sandbox.network().is_some()),
        }
    }

    /// Which network the programs of worlds have; at level `container` that is Docker's.
    pub fn network(&self) -> Option<Network> {
        match &self.method {
            Method::Plain => Some(Network::Shared),
            Method::Sandbox(sandbox) => Some(match sandbox.network() {
                None => Network::Shared,
                Some(network) if network.is_closed() => Network::Closed,
                Some(_) => Network::Own,
            }),
            Method::Container => None,
        }
    }

    /// The same for an administrator: what can be reached, and why no less.
    pub fn network_in_words(&self) -> Option<String> {
        Some(match (self.network()?, &self.why_shared) {
            (Network::Shared, None) => "shared with this machine".to_owned(),
            (Network::Shared, Some(why)) => format!("shared with this machine: {why}"),
            (Network::Closed, _) => "closed, nothing can be reached".to_owned(),
            (Network::Own, _) if self.reaches_private_addresses() => {
                "own, with the internet and private addresses, for nft can't be used; the package nftables has it"
                    .to_owned()
            }
            (Network::Own, _) => "own, with the internet, without this machine and private addresses".to_owned(),
        })
    }

    /// Whether simulations reach private addresses from networks of their own, since no packet filter can be loaded there.
    fn reaches_private_addresses(&self) -> bool {
        matches!(&self.method, Method::Sandbox(sandbox) if sandbox.network().is_some_and(|one| !one.is_filtered()))
    }

    /// The address at which this server reaches the forwarded ports of simulations, if each has a network of its own.
    pub fn reached(&self) -> Option<IpAddr> {
        let Method::Sandbox(sandbox) = &self.method else { return None };
        sandbox.network().map(OwnNetwork::reached)
    }

    /// Why simulations run at level `none` although the configuration does not say so, if they do.
    pub fn shortcoming(&self) -> Option<&str> {
        self.shortcoming.as_deref()
    }

    /// A remark on the level for the client of a program that did not become ready.
    pub fn remark(&self) -> &'static str {
        match self.level() {
            IsolationLevel::None => "",
            IsolationLevel::Container => {
                " It ran in a container, which has its image and its project only; the server's administrator can give it \
                 more (container, limits)."
            }
            IsolationLevel::Sandbox => {
                " It ran in a sandbox, which shows it the system and Webots only; the server's administrator can show it \
                 more (sandbox.readable, sandbox.writable), or run worlds without (isolation)."
            }
        }
    }

    /// The specification of the process that runs a program, and its control group.
    ///
    /// # Errors
    /// When a directory can't be created.
    pub fn prepare(&self, mut program: Program<'_>) -> io::Result<(SpawnSpec, Option<Cgroup>)> {
        let cgroup = self.cgroups.as_ref().and_then(Cgroups::make);
        let mut command = cgroup.as_ref().map(Cgroup::joining).unwrap_or_default();
        let mut environment = inherited_environment::allowed(&self.variables);
        environment.push(program.display.variable());
        environment.extend(program.variables.iter().cloned());
        if let Method::Sandbox(sandbox) = &self.method {
            // Symlinks are not followed out of a sandbox.
            if let Some(file) = program.command.first_mut()
                && let Ok(real) = Path::new(&*file).canonicalize()
            {
                *file = real.into();
            }
            command.extend(sandbox.command(&program)?);
            environment.extend(sandbox.environment());
        }
        command.extend(self.limited());
        command.extend(program.display.launcher(self.level() == IsolationLevel::Sandbox));
        let spec = SpawnSpec {
            command: command.into_iter().chain(program.command).collect(),
            inherits: false,
            environment,
            wrappers: match &self.method {
                Method::Sandbox(sandbox) => 1 + usize::from(sandbox.network().is_some()),
                Method::Plain | Method::Container => 0,
            },
            folder: Some(program.folder.to_owned()),
            mark: program.instance.to_owned(),
            grace: program.grace,
        };
        Ok((spec, cgroup))
    }

    /// Whether the kernel counts the processes of each sandbox separately.
    fn limits_by_namespace(&self) -> bool {
        let is_ordinary = !nix::unistd::getuid().is_root();
        self.level() == IsolationLevel::Sandbox && is_ordinary && self.prlimit.is_some() && counts_by_namespace()
    }

    /// Limit of a simulation's processes; `None` if the kernel or Docker enforces it.
    pub fn most_processes(&self) -> Option<MostProcesses> {
        let is_kept = self.level() == IsolationLevel::Container
            || self.limits_by_namespace()
            || self.cgroups.as_ref().is_some_and(Cgroups::limit_processes);
        (!is_kept).then(|| MostProcesses { limit: self.limits.processes, runners: self.runners() })
    }

    /// The prefix of a command that runs it with the kernel's limits for processes.
    fn limited(&self) -> Vec<OsString> {
        let Some(prlimit) = &self.prlimit else {
            return Vec::new();
        };
        let files = at_most(Resource::RLIMIT_NOFILE, self.limits.open_files);
        let size = at_most(Resource::RLIMIT_FSIZE, self.limits.disk << 20);
        let mut words = vec![format!("--nofile={}:{files}", files.min(USUAL_FILES)), format!("--fsize={size}")];
        words.push("--core=0".to_owned());
        // The kernel counts all processes of a user, but in a user namespace only those inside, one of which is
        // bubblewrap.
        if self.limits_by_namespace() {
            words.push(format!("--nproc={}", at_most(Resource::RLIMIT_NPROC, self.limits.processes + 1)));
        }
        let words = std::iter::once(prlimit.into()).chain(words.into_iter().map(OsString::from));
        words.chain(std::iter::once("--".into())).collect()
    }
}

/// A limit, capped at this server's own hard limit, which its child processes can't exceed.
fn at_most(resource: Resource, limit: u64) -> u64 {
    getrlimit(resource).map_or(limit, |(_, most)| limit.min(most))
}

/// Since Linux 5.14 the kernel counts the processes of a user in each user namespace.
fn counts_by_namespace() -> bool {
    procfs::sys::kernel::Version::current().is_ok_and(|version| (version.major, version.minor) >= (5, 14))
}

impl fmt::Display for IsolationLevel {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Self::None => "none",
            Self::Sandbox => "sandbox",
            Self::Container => "container",
        })
    }
}
