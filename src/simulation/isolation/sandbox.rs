//! A sandbox by bubblewrap: the system is read-only, the server's own files are hidden, and everything inside ends with
//! it.
//!
//! The mounts are one list, outer directories before inner ones. The most specific path wins: a mount covers a
//! directory and its contents unless a longer path overrides it.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io;
use std::net::{Ipv4Addr, TcpListener};
use std::path::PathBuf;
use std::time::Duration;

use which::which;

use super::assets::RepositoryAssets;
use super::display::Display;
use super::mount::{Mount, hidden};
use super::network::OwnNetwork;
use super::system_calls;
use crate::shared::text::one_line;
use crate::simulation::config::{SandboxNetwork, SimulationConfig};
use crate::simulation::machine::display;
use crate::simulation::process::{ExitReason, InstanceDir, Run, SpawnSpec};

/// The common part of all sandboxes of this server.
pub struct Sandbox {
    bubblewrap: PathBuf,
    homes: Vec<PathBuf>,
    mounts: Vec<Mount>,
    /// Whether programs inside can't create user namespaces: bubblewrap can prevent that since 0.8.
    pub ends_namespaces: bool,
    /// Its own network, if it has one.
    pub network: Option<OwnNetwork>,
    /// Size limit of its shared memory, in bytes.
    shared_memory: u64,
}

/// What programs need of `/run` to resolve names, except in closed networks: services there query the internet.
const NAMES_RUN: [&str; 4] = [
    "/run/systemd/resolve",
    "/run/resolvconf",
    "/run/NetworkManager/resolv.conf",
    "/run/nscd",
];
/// What programs need of `/run` to find users and graphics cards. The rest are sockets of services, some of which start
/// programs on request.
const SYSTEM_RUN: [&str; 4] = [
    "/run/udev",
    "/run/nvidia-persistenced",
    "/run/opengl-driver",
    "/run/current-system",
];
/// Graphics cards, besides all in `/dev` whose name begins with `nvidia`.
const DEVICES: [&str; 2] = ["/dev/dri", "/dev/kfd"];
/// Timeout of a trial run of a sandbox.
const TRIAL: Duration = Duration::from_secs(5);
/// What an administrator can do if bubblewrap does not work.
const REMEDY: &str = "user namespaces must be allowed (sysctl user.max_user_namespaces, \
                      kernel.unprivileged_userns_clone, kernel.apparmor_restrict_unprivileged_userns), and /proc not be \
                      covered as in a container";

/// What an administrator can do if pasta does not work.
const NETWORK_REMEDY: &str = "ordinary users must be allowed to open /dev/net/tun (mode 0666, as udev has it), and the \
                              machine must have a default route, of the version of IP of bind";

impl Sandbox {
    /// The name of the home in the directory of an instance.
    pub const HOME: &str = "home";

    /// Prepares sandboxes for a server with this configuration, and tries whether they work here. Blocks for ten seconds at
    /// most.
    ///
    /// # Errors
    /// Why they don't, and what to do about it, as text for an administrator.
    pub fn new(config: &SimulationConfig) -> Result<Self, String> {
        let bubblewrap = which("bwrap").map_err(|_| {
            "bubblewrap (bwrap) is not there; on Debian, Ubuntu and Fedora the package bubblewrap has it".to_owned()
        })?;
        let mut mounts = vec![Mount::empty("/run")];
        let names = NAMES_RUN
            .into_iter()
            .filter(|_| config.sandbox.network != SandboxNetwork::Closed);
        mounts.extend(names.chain(SYSTEM_RUN).map(Mount::read_only));
        let readable = config.webots_home.iter().chain(&config.sandbox.readable);
        mounts.extend(
            readable
                .filter_map(|path| path.0.canonicalize().ok())
                .map(Mount::read_only),
        );
        let writable = config
            .sandbox
            .writable
            .iter()
            .filter_map(|path| path.0.canonicalize().ok());
        mounts.extend(writable.map(|at| Mount::writable(at.clone(), &at)));
        // Last, so that nothing overrides these.
        let homes = homes();
        mounts.extend(hidden(config));
        mounts.retain(|mount| mount.at.exists());
        let shared_memory = config.limits.disk << 20;
        let mut sandbox = Self {
            bubblewrap,
            homes,
            mounts,
            ends_namespaces: true,
            network: None,
            shared_memory,
        };
        let mut tried = sandbox.trial();
        if tried.is_err() {
            sandbox.ends_namespaces = false;
            tried = sandbox.trial();
        }
        let told = |error: io::Error| one_line(error.to_string().trim());
        tried
            .map(|()| sandbox)
            .map_err(|error| format!("bubblewrap makes no sandbox here ({}): {REMEDY}", told(error)))
    }

    /// The prefix of the command that runs a program in a sandbox of its own. Creates the directories that it needs in
    /// the instance's directory.
    ///
    /// # Errors
    /// When a directory can't be created.
    pub fn command(
        &self,
        spec: &SpawnSpec,
        port: u16,
        display: &Display,
        assets: Option<&RepositoryAssets>,
    ) -> io::Result<Vec<OsString>> {
        let instance = &spec.mark;
        let mut command = self
            .network
            .as_ref()
            .map_or_else(|| Ok(Vec::new()), |network| network.command(instance, port))?;
        let filter = instance.join("system-calls");
        std::fs::write(&filter, system_calls::filter())?;
        command.extend(["/bin/sh", "-c", "exec \"$@\" 3<\"$0\""].map(Into::into));
        command.extend([
            filter.into(),
            self.bubblewrap.clone().into(),
            "--seccomp".into(),
            "3".into(),
        ]);
        let fixed = [
            "--die-with-parent",
            "--new-session",
            "--unshare-user",
            "--unshare-pid",
            "--unshare-ipc",
        ];
        command.extend(fixed.map(Into::into));
        if self.ends_namespaces {
            command.push("--disable-userns".into());
        }
        if self.network.is_some() {
            // In pasta's namespace the user is root.
            let user = nix::unistd::getuid().to_string();
            let group = nix::unistd::getgid().to_string();
            command.extend(["--uid".into(), user.into(), "--gid".into(), group.into()]);
        }
        command.extend(
            [
                "--cap-drop",
                "ALL",
                "--ro-bind",
                "/",
                "/",
                "--dev",
                "/dev",
                "--proc",
                "/proc",
            ]
            .map(Into::into),
        );
        // The kernel lets root write there without capabilities.
        command.extend(["--ro-bind-try", "/proc/sys", "/proc/sys"].map(Into::into));
        for device in devices() {
            command.extend(["--dev-bind-try".into(), device.clone().into(), device.into()]);
        }
        // Of two mounts at the same path the last one counts.
        let mut mounts = BTreeMap::new();
        for mount in self
            .own(spec, display, assets)?
            .into_iter()
            .chain(self.mounts.iter().cloned())
        {
            mounts.insert((mount.at.components().count(), mount.at.clone()), mount);
        }
        // Empty directories are tmpfs, which takes memory: they are made read-only, as is the rest of `/dev`.
        let empty = mounts
            .values()
            .filter(|mount| mount.source.is_none())
            .map(|mount| mount.at.clone());
        let closed: Vec<PathBuf> = empty.chain(["/dev".into()]).collect();
        command.extend(mounts.into_values().flat_map(Mount::into_arguments));
        // bubblewrap has `--size` since 0.7, and `--disable-userns` since 0.8.
        if self.ends_namespaces {
            command.extend(["--size".into(), self.shared_memory.to_string().into()]);
        }
        command.extend(["--tmpfs", "/dev/shm"].map(Into::into));
        command.extend(closed.into_iter().flat_map(|at| ["--remount-ro".into(), at.into()]));
        command.extend(spec.folder.iter().flat_map(|folder| ["--chdir".into(), folder.into()]));
        command.push("--".into());
        Ok(command)
    }

    /// The mounts that differ between simulations.
    fn own(&self, spec: &SpawnSpec, display: &Display, assets: Option<&RepositoryAssets>) -> io::Result<Vec<Mount>> {
        let inside = |name: &str| {
            let folder = spec.mark.join(name);
            std::fs::create_dir_all(&folder).map(|()| folder)
        };
        let home = inside(Self::HOME)?;
        let run = inside("run")?;
        let tmp = inside("tmp")?;
        display.prepare(&tmp)?;
        let mut own: Vec<Mount> = temporary_folders().map(|at| Mount::writable(at, &tmp)).collect();
        own.push(Mount::writable(runtime_folder(), &run));
        own.extend(self.homes.iter().map(|at| Mount::writable(at.clone(), &home)));
        let project = spec.mark.join(InstanceDir::PROJECT);
        own.push(Mount::writable(project.clone(), &project));
        // Symlinks would be resolved inside the sandbox, where their targets may not exist.
        let files = spec
            .command
            .first()
            .map(PathBuf::from)
            .into_iter()
            .chain(self.display_files(display));
        own.extend(files.filter_map(|file| file.canonicalize().ok()).map(Mount::read_only));
        own.extend(self.network.as_ref().and_then(|network| network.mounts(&spec.mark)));
        if let Some(assets) = assets {
            assets.offer(&home)?;
            own.push(Mount::read_only(&assets.folder));
        }
        own.retain(|mount| mount.at.exists() || mount.at == runtime_folder());
        Ok(own)
    }

    /// The socket and the authority file of the display; of a virtual one, Xvfb and the authority file.
    fn display_files(&self, display: &Display) -> Vec<PathBuf> {
        let name = match display {
            Display::Outside(name) => name,
            Display::Virtual { xvfb, authority } => return vec![xvfb.clone(), authority.clone()],
        };
        let authority = std::env::var_os("XAUTHORITY").map(PathBuf::from);
        let usual = || self.homes.first().map(|home| home.join(".Xauthority"));
        display::socket(name)
            .into_iter()
            .chain(authority.or_else(usual))
            .collect()
    }

    /// Variables that differ in a sandbox. Shared memory with the display is not available.
    pub fn environment(&self) -> Vec<(OsString, OsString)> {
        let home = self.homes.first().map_or_else(|| "/tmp".into(), Clone::clone);
        vec![
            ("HOME".into(), home.into()),
            ("TMPDIR".into(), "/tmp".into()),
            ("XDG_RUNTIME_DIR".into(), runtime_folder().into()),
            ("QT_X11_NO_MITSHM".into(), "1".into()),
        ]
    }

    /// Gives each sandbox a network of its own, if that works here. Blocks for ten seconds at most.
    ///
    /// # Errors
    /// Why it does not, as text for an administrator.
    pub fn join(&mut self, network: OwnNetwork) -> Result<(), String> {
        self.network = Some(network);
        let mut tried = self.trial();
        if tried.is_err() && self.network.as_mut().is_some_and(OwnNetwork::give_up_filter) {
            tried = self.trial();
        }
        tried.map_err(|error| {
            self.network = None;
            format!(
                "pasta makes no network here ({}): {NETWORK_REMEDY}",
                one_line(error.to_string().trim())
            )
        })
    }

    /// Runs `true` in a sandbox with all mounts.
    fn trial(&self) -> io::Result<()> {
        let instance = tempfile::tempdir()?;
        let project = instance.path().join(InstanceDir::PROJECT);
        std::fs::create_dir(&project)?;
        let spec = SpawnSpec {
            folder: Some(project),
            ..SpawnSpec::new(Vec::new(), instance.path())
        };
        // A port that was free a moment ago.
        let port = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()?.port();
        let mut command = self.command(&spec, port, &Display::Outside(String::new()), None)?;
        command.extend(["/bin/sh", "-c", "true"].map(Into::into));
        let mut complaint = String::new();
        let ran = Run::new(command, instance.path(), TRIAL).run_blocking(|line| complaint = line);
        match ran.map_err(io::Error::other)?.ending {
            ExitReason::Code(0) => Ok(()),
            _ => Err(io::Error::other(complaint)),
        }
    }
}

/// The user's runtime directory.
fn runtime_folder() -> PathBuf {
    PathBuf::from(format!("/run/user/{}", nix::unistd::getuid()))
}

/// The home directories of the server's user: `HOME`, and the one in the user database.
fn homes() -> Vec<PathBuf> {
    let known = nix::unistd::User::from_uid(nix::unistd::getuid())
        .ok()
        .flatten()
        .map(|user| user.dir);
    let all = std::env::var_os("HOME").map(PathBuf::from).into_iter().chain(known);
    let real = all.filter_map(|home| home.canonicalize().ok());
    let mut homes: Vec<PathBuf> = real.filter(|home| home.parent().is_some()).collect();
    homes.dedup();
    homes
}

/// The directories for temporary files of the system and of this server, without symlinks.
fn temporary_folders() -> impl Iterator<Item = PathBuf> {
    let all = ["/tmp".into(), "/var/tmp".into(), std::env::temp_dir()];
    let real = all.into_iter().filter_map(|folder: PathBuf| folder.canonicalize().ok());
    // Each sandbox has its own shared memory.
    real.filter(|folder| folder.parent().is_some() && !folder.starts_with("/dev"))
}

/// The graphics cards of this machine.
fn devices() -> impl Iterator<Item = PathBuf> {
    let all = std::fs::read_dir("/dev").into_iter().flatten().flatten();
    let nvidia = all.filter(|entry| entry.file_name().as_encoded_bytes().starts_with(b"nvidia"));
    DEVICES
        .iter()
        .map(PathBuf::from)
        .chain(nvidia.map(|entry| entry.path()))
}
