//! The launcher of simulations on this server: its isolation level is decided once at start, the same for all.
//!
//! It turns a program into a command that runs it at that level ([`SpawnSpec`]).

use std::ffi::OsString;
use std::fmt;
use std::io;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nix::sys::resource::{Resource, getrlimit};
use serde::Serialize;
use which::which;

use super::assets::{AssetCache, RepositoryAssets};
use super::cgroup::{Cgroup, Cgroups};
use super::display::Display;
use super::network::OwnNetwork;
use super::sandbox::Sandbox;
use crate::simulation::config::{IsolationSetting, ResourceLimits, SandboxNetwork, SimulationConfig, VariableName};
use crate::simulation::process::SpawnSpec;

/// Soft limit of open files that programs expect; programs that use `select` can't handle more.
const USUAL_FILES: u64 = 1024;
/// Variables of the server's environment that Webots, Qt, graphics drivers and interpreters read; with `*`, all with this
/// prefix. None of them is a secret of the server.
const NEEDED: &str = "PATH HOME USER LOGNAME SHELL TERM TZ LANG LANGUAGE LC_* TMPDIR XAUTHORITY XDG_RUNTIME_DIR \
                      XDG_DATA_DIRS XDG_CONFIG_DIRS WEBOTS_* LD_LIBRARY_PATH PYTHONPATH OMP_* QT_* QTWEBENGINE_* LIBGL_* \
                      MESA_* GALLIUM_* DRI_PRIME __GL* __NV* __EGL* VK_* VGL_* NVIDIA_* CUDA_*";

/// Launches simulations at one level.
pub struct Launcher {
    /// How all simulations are isolated.
    isolation: Isolation,
    /// What Webots has downloaded, for the next simulations.
    assets: Option<AssetCache>,
    cgroups: Option<Cgroups>,
    controllers: Vec<&'static str>,
    /// Its absolute path: a search after the fork would delay each start by a millisecond.
    prlimit: PathBuf,
    variables: Vec<VariableName>,
    limits: ResourceLimits,
}

/// How simulations are isolated on this machine.
enum Isolation {
    /// Not at all.
    None {
        /// Why, if the configuration leaves that to the machine.
        shortcoming: Option<String>,
    },
    /// By bubblewrap.
    Sandbox {
        sandbox: Sandbox,
        /// Why sandboxes have no networks of their own, if the configuration leaves that to the machine.
        why_shared: Option<String>,
    },
    /// By Docker: they are not started here.
    Container,
}

/// The isolation level of all simulations of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum IsolationLevel {
    /// As the server's own user, in a process group.
    None,
    /// With bubblewrap.
    Sandbox,
    /// With Docker.
    Container,
}

impl fmt::Display for IsolationLevel {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(out)
    }
}

/// The network of worlds' programs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Network {
    /// One of each simulation's own.
    Own,
    /// One of each simulation's own, without the internet.
    Closed,
    /// The machine's.
    Shared,
}

impl Launcher {
    /// Determines the isolation level. Blocks for some milliseconds, for ten seconds at most.
    ///
    /// # Errors
    /// When the configuration requires what this machine does not have, as text for an administrator.
    pub fn new(config: &SimulationConfig) -> Result<Self, String> {
        let prlimit = which("prlimit").unwrap_or_default();
        if config.isolation != IsolationSetting::Container && prlimit.as_os_str().is_empty() {
            return Err("prlimit is not there; on Debian, Ubuntu and Fedora the package util-linux has it".to_owned());
        }
        // Before a sandbox is tried, because its processes may still be in this server's group afterwards.
        let controllers = Cgroups::controllers();
        let isolation = match config.isolation {
            IsolationSetting::None => Isolation::None { shortcoming: None },
            IsolationSetting::Container => Isolation::Container,
            IsolationSetting::Sandbox => sandboxed(
                config,
                Sandbox::new(config)
                    .map_err(|why| format!("isolation is \"sandbox\", but {why}; \"none\" runs worlds without it"))?,
            )?,
            IsolationSetting::Auto => match Sandbox::new(config) {
                Ok(sandbox) => sandboxed(config, sandbox)?,
                Err(why) => {
                    demand_no_network(config, &why)?;
                    Isolation::None { shortcoming: Some(why) }
                }
            },
        };
        Ok(Self {
            isolation,
            assets: None,
            cgroups: None,
            controllers,
            prlimit,
            variables: config.environment.clone(),
            limits: config.limits.clone(),
        })
    }

    /// Like [`Self::new`], for a server that is starting: logs the level, and gives each simulation a control group of
    /// its own if these are delegated to this server.
    ///
    /// # Errors
    /// As for [`Self::new`].
    pub fn start(config: &SimulationConfig) -> Result<Self, String> {
        let cgroups = (config.isolation != IsolationSetting::Container)
            .then(Cgroups::delegated)
            .flatten();
        let mut launcher = Self::new(config)?;
        match launcher.shortcoming() {
            Some(why) => log::warn!("worlds' programs may do whatever this user may (isolation: none): {why}"),
            None => log::info!("isolation: {}", launcher.level()),
        }
        if let Some(network) = launcher.network_in_words() {
            let level = if launcher.why_shared().is_some() {
                log::Level::Warn
            } else {
                log::Level::Info
            };
            log::log!(level, "network of simulations: {network}");
        }
        for line in launcher
            .unenforced_limits()
            .into_iter()
            .chain(launcher.exposed_files(config))
        {
            log::warn!("{line}");
        }
        launcher.cgroups = cgroups;
        // With any commit, anybody can run a world in the name of a repository.
        let keeps_assets = launcher.sandbox().is_some() && config.assets_size > 0 && !config.any_commit;
        let cache = config.cache_dir.0.canonicalize().ok().filter(|_| keeps_assets);
        launcher.assets = cache.map(|cache| AssetCache::new(&cache, config.assets_size, config.disk_reserve));
        Ok(launcher)
    }

    /// The isolation level of all simulations.
    pub fn level(&self) -> IsolationLevel {
        match self.isolation {
            Isolation::None { .. } => IsolationLevel::None,
            Isolation::Sandbox { .. } => IsolationLevel::Sandbox,
            Isolation::Container => IsolationLevel::Container,
        }
    }

    /// Why they run at level `none` although the configuration does not say so, if they do.
    pub fn shortcoming(&self) -> Option<&str> {
        match &self.isolation {
            Isolation::None { shortcoming } => shortcoming.as_deref(),
            _ => None,
        }
    }

    fn sandbox(&self) -> Option<&Sandbox> {
        match &self.isolation {
            Isolation::Sandbox { sandbox, .. } => Some(sandbox),
            _ => None,
        }
    }

    fn why_shared(&self) -> Option<&str> {
        match &self.isolation {
            Isolation::Sandbox { why_shared, .. } => why_shared.as_deref(),
            _ => None,
        }
    }

    /// Why visitors may read files of the server's user, if they may: Webots serves any file that it can read to whoever
    /// reaches its port.
    pub fn exposed_files(&self, config: &SimulationConfig) -> Option<String> {
        let (first, last) = config.streaming_ports().into_inner();
        (config.ports_are_public() && self.level() == IsolationLevel::None).then(|| {
            format!(
                "any file that this user may read, such as this server's configuration, can be read by anybody who \
                 reaches ports {first} to {last}, because Webots serves it there (streaming: \"direct\", isolation: \
                 none); set streaming to \"relay\", or isolation to \"sandbox\""
            )
        })
    }

    /// The limits that this machine can't enforce, one line each.
    pub fn unenforced_limits(&self) -> Vec<String> {
        let mut lines = Vec::new();
        if self.sandbox().is_some_and(|sandbox| !sandbox.ends_namespaces) {
            lines.push(
                "worlds' programs can make user namespaces, which brings more of the kernel within their reach: only \
                 bubblewrap from 0.8 on forbids it"
                    .to_owned(),
            );
        }
        let controllers = &self.controllers;
        let limits = &self.limits;
        for (key, controller, is_set) in [
            ("limits.memory", "memory", limits.memory.is_some()),
            ("limits.cores", "cpu", limits.cores.is_some()),
        ] {
            // Docker enforces them for containers.
            if is_set && self.level() != IsolationLevel::Container && !controllers.contains(&controller) {
                lines.push(format!(
                    "{key} does not hold: systemd has not delegated control groups with the controller {controller} to \
                     this program (Delegate={controller} in its unit)"
                ));
            }
        }
        lines
    }

    /// The network of each simulation's own, if it has one.
    fn own_network(&self) -> Option<&OwnNetwork> {
        self.sandbox()?.network.as_ref()
    }

    /// The network of worlds' programs; `None` at level `container`, where it is Docker's.
    pub fn network(&self) -> Option<Network> {
        match self.own_network() {
            None => (self.level() != IsolationLevel::Container).then_some(Network::Shared),
            Some(network) if network.is_closed() => Some(Network::Closed),
            Some(_) => Some(Network::Own),
        }
    }

    /// The same as text for an administrator: what programs can reach, and why the network is shared.
    pub fn network_in_words(&self) -> Option<String> {
        Some(match (self.network()?, self.why_shared()) {
            (Network::Shared, None) => "shared with this machine".to_owned(),
            (Network::Shared, Some(why)) => format!("shared with this machine: {why}"),
            (Network::Closed, _) => "closed, nothing can be reached".to_owned(),
            _ if self.own_network().is_some_and(|network| network.nft.is_none()) => {
                "own, with the internet, private addresses and UDP ports of this machine, for nft can't be used; the \
                 package nftables has it"
                    .to_owned()
            }
            _ => "own, with the internet by TCP, without this machine and private addresses".to_owned(),
        })
    }

    /// The address at which this server reaches the forwarded ports of simulations, if each has a network of its own.
    pub fn reached(&self) -> Option<IpAddr> {
        self.own_network().map(OwnNetwork::reached)
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

    /// The process at the isolation level of this server, with this display and stream port; and its control group.
    ///
    /// # Errors
    /// When a directory can't be created.
    pub fn prepare(
        &self,
        mut spec: SpawnSpec,
        port: u16,
        display: &Display,
        assets: Option<&RepositoryAssets>,
    ) -> io::Result<(SpawnSpec, Option<Cgroup>)> {
        let cgroup = self.cgroups.as_ref().and_then(|cgroups| cgroups.make(&self.limits));
        let mut command = cgroup.as_ref().map(Cgroup::joining).unwrap_or_default();
        let mut environment = self.inherited();
        environment.push(display.variable());
        environment.append(&mut spec.environment);
        if let Some(sandbox) = self.sandbox() {
            // In a sandbox, a symlink may point to a path that does not exist there.
            if let Some(file) = spec.command.first_mut()
                && let Ok(real) = Path::new(&*file).canonicalize()
            {
                *file = real.into();
            }
            command.extend(sandbox.command(&spec, port, display, assets)?);
            environment.extend(sandbox.environment());
            spec.wrappers = 1 + usize::from(sandbox.network.is_some());
        }
        command.extend(self.limited());
        command.extend(display.launcher(self.sandbox().is_some()));
        command.append(&mut spec.command);
        Ok((
            SpawnSpec {
                command,
                environment,
                inherits: false,
                ..spec
            },
            cgroup,
        ))
    }

    /// The assets of the repository with this URL, if they are kept.
    pub fn assets_of(&self, repository: &str) -> Option<Arc<RepositoryAssets>> {
        let assets = self.assets.as_ref()?.of(repository);
        assets
            .inspect_err(|error| log::warn!("the assets of {repository} are downloaded again: {error}"))
            .ok()
    }

    /// Keeps what Webots has downloaded in the simulation with this directory, which has ended. Blocks.
    pub fn keep_assets(&self, assets: &RepositoryAssets, instance: &Path) {
        if let Some(cache) = &self.assets {
            cache.adopt(assets, &instance.join(Sandbox::HOME));
        }
    }

    /// The variables of the server's own environment that a simulation gets.
    fn inherited(&self) -> Vec<(OsString, OsString)> {
        let needed = NEEDED
            .split_whitespace()
            .filter_map(|name| VariableName::try_from(name.to_owned()).ok());
        let names: Vec<VariableName> = needed.chain(self.variables.iter().cloned()).collect();
        let is_named = |name: &OsString| {
            name.to_str()
                .is_some_and(|name| names.iter().any(|one| one.covers(name)))
        };
        std::env::vars_os().filter(|(name, _)| is_named(name)).collect()
    }

    /// The prefix of a command that runs it with the kernel's limits for processes.
    fn limited(&self) -> Vec<OsString> {
        let files = at_most(Resource::RLIMIT_NOFILE, self.limits.open_files);
        let size = at_most(Resource::RLIMIT_FSIZE, self.limits.disk << 20);
        let mut words = vec![format!("--nofile={}:{files}", files.min(USUAL_FILES))];
        words.extend([format!("--fsize={size}"), "--core=0".to_owned()]);
        // The kernel counts all processes of a user, but in a user namespace only those inside, one of which is
        // bubblewrap.
        if self.sandbox().is_some() && !nix::unistd::getuid().is_root() && counts_by_namespace() {
            words.push(format!(
                "--nproc={}",
                at_most(Resource::RLIMIT_NPROC, self.limits.processes + 1)
            ));
        }
        words.push("--".to_owned());
        std::iter::once(self.prlimit.clone().into())
            .chain(words.into_iter().map(OsString::from))
            .collect()
    }
}

/// Simulations in this sandbox, with the network that the configuration says.
fn sandboxed(config: &SimulationConfig, mut sandbox: Sandbox) -> Result<Isolation, String> {
    let why_shared = match config.sandbox.network {
        SandboxNetwork::Shared => None,
        _ => OwnNetwork::new(config).and_then(|network| sandbox.join(network)).err(),
    };
    if let Some(why) = &why_shared {
        demand_no_network(config, why)?;
    }
    Ok(Isolation::Sandbox { sandbox, why_shared })
}

/// Refuses a configuration that demands a network of each simulation's own, which can't be had for this reason.
fn demand_no_network(config: &SimulationConfig, why: &str) -> Result<(), String> {
    if config.sandbox.network.is_demanded() {
        return Err(format!(
            "sandbox.network is \"own\" or \"closed\", but {why}; \"shared\" runs worlds in the machine's network"
        ));
    }
    Ok(())
}

/// A limit, capped at this server's own hard limit, which its child processes can't exceed.
fn at_most(resource: Resource, limit: u64) -> u64 {
    getrlimit(resource).map_or(limit, |(_, most)| limit.min(most))
}

/// Since Linux 5.14 the kernel counts the processes of a user in each user namespace.
fn counts_by_namespace() -> bool {
    procfs::sys::kernel::Version::current().is_ok_and(|version| (version.major, version.minor) >= (5, 14))
}
