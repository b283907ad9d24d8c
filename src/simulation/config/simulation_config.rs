//! The simulation server's configuration, `config/simulation/NAME.json`.

use std::net::{IpAddr, Ipv6Addr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use actix_web::http::header::HeaderName;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::container::{ContainerDisplay, ContainerSettings, EDITOR_PORT};
use super::isolation::{IsolationSetting, SandboxFolders, VariableName};
use super::mirrors::Mirrors;
use super::resources::{GpuUse, RealTime, ResourceLimits};
use super::timing::Timing;
use super::urls::Streaming;
use crate::shared::config::keys::keys;
use crate::shared::config::{
    ApiToken, Configuration, Expanded, ExpandedPath, Minutes, OneOrMany, OptionalWhole, Percent, Seconds, Secret,
    Sentence, Whole, check_api_tokens, check_fleet_key, require,
};
use crate::shared::domain::{PublicUrl, ReadyEntry, UrlPrefix, complete_host};
use crate::shared::http::{Origin, TrustedProxies};
use crate::simulation::machine::display;

keys! {
/// Every key of the simulation server. The original's keys keep their meaning.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct SimulationConfig {
    /// Fully qualified domain name of the simulation server. Default: `localhost`, with a warning.
    #[serde(alias = "fullyQualifiedDomainName", with = "Expanded")]
    #[schemars(extend("default" = "localhost"))]
    pub server: String = String::new(),
    /// Whether URLs begin with `https` and `wss`. Default: true.
    pub ssl: bool = true,
    /// Local port. Webots uses the ports that follow it. Default: 2000.
    #[serde(with = "Whole::<1, 65000>")]
    pub port: u16 = 2000,
    /// Local address to listen on. Default: `::`, all addresses of IPv4 and IPv6.
    pub bind: IpAddr = Ipv6Addr::UNSPECIFIED.into(),
    /// Whether a reverse proxy rewrites ports in URLs: HOST/PORT, not HOST:PORT. Default: true.
    pub port_rewrite: bool = true,
    /// How clients reach this server and its simulations through one reverse proxy: a URL with the placeholders
    /// `{host}` (that is `server`) and `{port}`. Default: none, so that each has its own address.
    pub public_url: Option<PublicUrl> = None,
    /// How clients reach the streams of simulations: at the ports of their Webots, or through this server. Default: `direct`.
    pub streaming: Streaming = Streaming::default(),
    /// Directory of `simulation/output.log`, `simulation/monitor.csv` and the instances' output. Default: `log`.
    pub log_dir: ExpandedPath = ExpandedPath("log".into()),
    /// Log to standard output. Default: false.
    pub debug: bool = false,
    /// Headline of the monitor page.
    pub title: Option<String> = None,
    /// Text below the headline.
    pub description: Option<String> = None,
    /// Installation directory of Webots. Default: the environment variable `WEBOTS_HOME`.
    pub webots_home: Option<ExpandedPath> = None,
    /// The program to start instead of the one in `webotsHome`.
    pub webots: Option<ExpandedPath> = None,
    /// Directory of local projects. Accepted for existing files; not used.
    pub projects_dir: Option<ExpandedPath> = None,
    /// The isolation level of simulations. Default: `auto`.
    pub isolation: IsolationSetting = IsolationSetting::default(),
    /// What a sandbox mounts besides the system and Webots.
    pub sandbox: SandboxFolders = SandboxFolders::default(),
    /// How simulations run in containers.
    pub container: ContainerSettings = ContainerSettings::default(),
    /// Environment variables that simulations get besides those that Webots needs. Default: none.
    #[serde(with = "OneOrMany::<VariableName>")]
    pub environment: Vec<VariableName> = Vec::new(),
    /// The resource limits of one simulation.
    pub limits: ResourceLimits = ResourceLimits::default(),
    /// What is promised of the speed of simulations.
    pub real_time: RealTime = RealTime::default(),
    /// Run Webots in containers: the original's key for `isolation: "container"`. Default: false.
    pub docker: bool = false,
    /// Images that this server never removes, although it has pulled them. Default: none.
    #[serde(alias = "persistentDockerImages", with = "OneOrMany::<String>")]
    pub persistant_docker_images: Vec<String> = Vec::new(),
    /// Repositories whose worlds may run, as URL prefixes of whole path segments. Default: none.
    #[serde(with = "OneOrMany::<UrlPrefix>")]
    pub allowed_repositories: Vec<UrlPrefix> = Vec::new(),
    /// Repositories whose worlds never run, as URL prefixes. Default: none.
    #[serde(with = "OneOrMany::<UrlPrefix>")]
    pub blocked_repositories: Vec<UrlPrefix> = Vec::new(),
    /// With docker, worlds of other repositories run while the load (percent) is at most this; 0: never. Default: 50.
    #[serde(with = "Percent::<100>")]
    pub share_idle_time: f64 = 50.0,
    /// URLs to which the server announces itself when it starts. Default: none.
    #[serde(with = "OneOrMany::<url::Url>")]
    pub notify: Vec<url::Url> = Vec::new(),
    /// Number of slots: simulations that may run at a time. Webots uses port+1 .. port+maxConnections. Default: 100.
    #[serde(with = "Whole::<1, 10_000>")]
    pub max_connections: u16 = 100,
    /// Limit of clients that wait for a slot. Default: 100.
    #[serde(with = "Whole::<0, 100_000>")]
    pub waiting_line: usize = 100,
    /// Limit of open client `WebSockets` in all, with or without a simulation. Default: 1000.
    #[serde(with = "Whole::<1, 1_000_000>")]
    pub max_clients: usize = 1000,
    /// Limit of open client `WebSockets` per client address. Default: three quarters of `maxClients`, but at most 1000,
    /// because a class sits behind one address.
    #[serde(with = "OptionalWhole::<1, 1_000_000>")]
    pub max_clients_per_address: Option<usize> = None,
    /// Limit of slots per client address; the same number of its clients may wait. Default: all, because a class sits
    /// behind one address.
    #[serde(with = "OptionalWhole::<1, 10_000>")]
    pub max_places_per_address: Option<usize> = None,
    /// Limit of slots per user (`userHeader`); the same number of the user's clients may wait. Default: all.
    #[serde(with = "OptionalWhole::<1, 10_000>")]
    pub max_places_per_user: Option<usize> = None,
    /// The header in which a reverse proxy of `trustedProxies` sends the user's name, such as `X-Forwarded-User`.
    /// Default: none.
    pub user_header: Option<String> = None,
    /// Reverse proxies, as addresses or networks, whose header `X-Forwarded-For` is trusted.
    /// Default: `["127.0.0.0/8", "::1/128"]`.
    pub trusted_proxies: TrustedProxies = TrustedProxies::default(),
    /// Seconds after which a simulation is closed, at least 360. Default: 7200.
    #[serde(with = "Whole::<360, 31_536_000>")]
    pub timeout: u64 = 7200,
    /// Minutes after which a simulation that is paused is closed; 0: never. Default: 0.
    #[serde(with = "Minutes")]
    pub idle_timeout: f64 = 0.0,
    /// Write `simulation/monitor.csv`. Default: true.
    pub monitor_log_enabled: bool = true,
    /// Months for which the lines of `simulations.csv` are kept after the month in which the simulation ended. Default: 12.
    #[serde(with = "Whole::<1, 120>")]
    pub record_months: u32 = 12,
    /// Whether a world's URL may name any commit by its hash, not only one that is in a branch or tag. Git hosts also
    /// serve commits of forks and pull requests, which the repository's owner never accepted. Default: false.
    pub any_commit: bool = false,
    /// Where repositories are fetched from instead of their URL: {URL prefix: replacement}. Default: none.
    pub git_mirrors: Mirrors = Mirrors::default(),
    /// File of settings for git, in git's own format: a proxy, certificates, credentials. They add to those of the
    /// machine. Default: none.
    pub git_config: Option<ExpandedPath> = None,
    /// Directory of cached repositories and of the projects of running simulations. Default: `cache`.
    pub cache_dir: ExpandedPath = ExpandedPath("cache".into()),
    /// Size limit of all cached repositories, in MiB. Default: 10240.
    #[serde(with = "Whole::<1, 100_000_000>")]
    pub cache_size: u64 = 10 * 1024,
    /// Size limit of the assets that Webots has downloaded in sandboxes, in MiB; 0: none are kept. Default: 2048.
    #[serde(with = "Whole::<0, 100_000_000>")]
    pub assets_size: u64 = 2048,
    /// Size limit of a project, in MiB, for the fetch and for the checkout. Default: 1024.
    #[serde(with = "Whole::<1, 100_000_000>")]
    pub project_size: u64 = 1024,
    /// Free space that the disk of `cacheDir` must have for new simulations, in MiB; 0: any. Default: 512.
    #[serde(with = "Whole::<0, 100_000_000>")]
    pub disk_reserve: u64 = 512,
    /// Whether the server is ready only while it sees GPUs and none is lost. Default: false.
    pub require_gpu: bool = false,
    /// Which GPU a simulation gets, of several. Default: the first.
    pub gpus: GpuUse = GpuUse::default(),
    /// The X screen that each GPU drives, in the order of `nvidia-smi`; with `gpus: "spread"`. Default: none.
    #[serde(with = "OneOrMany::<String>")]
    pub displays: Vec<String> = Vec::new(),
    /// The display that Webots opens its window on. Default: the environment variable `DISPLAY`, else `:0`.
    pub display: Option<String> = None,
    /// Give each Webots a virtual display of its own (needs `Xvfb`). Default: false.
    pub xvfb: bool = false,
    /// Seconds after six missed heartbeats until a simulation is ended. Default: 60.
    #[serde(with = "Seconds")]
    pub hang_limit: Duration = Duration::from_mins(1),
    /// Worlds of which simulations are kept ready: `{"world": ..., "count": ..., "when": ...}`. Default: none.
    #[serde(with = "OneOrMany::<ReadyEntry>")]
    pub ready: Vec<ReadyEntry> = Vec::new(),
    /// Load (percent) from which none is started to be kept ready; from 10 more, in memory of the machine or its GPUs, they
    /// end. Above 100: the load does not matter. Default: 80.
    #[serde(with = "Percent::<1000>")]
    pub ready_load: f64 = 80.0,
    /// Pages from which browsers may open `/client`, as origins (`https://lab.org`). Default: any.
    #[serde(with = "OneOrMany::<Origin>")]
    pub allowed_origins: Vec<Origin> = Vec::new(),
    /// Password for actions such as `/drain`. Default: none, and actions are off.
    pub admin_password: Option<Secret> = None,
    /// What the client of a simulation is told that an administrator stops, before the reason. Default: `The administrator
    /// has stopped this simulation`.
    #[serde(with = "Sentence")]
    pub stop_text: String = "The administrator has stopped this simulation".to_owned(),
    /// Tokens of programs, each with what it may do. Default: none.
    #[serde(with = "OneOrMany::<ApiToken>")]
    pub api_tokens: Vec<ApiToken> = Vec::new(),
    /// Secret of at least 16 letters that all servers of a fleet share: it signs the passes and tickets of the line.
    /// Default: none, and a free slot is for the first client that comes.
    pub fleet_key: Option<Secret> = None,
    /// All other durations.
    pub timing: Timing = Timing::default(),
    /// The file that this was read from; empty if there is none.
    #[serde(skip)]
    pub file: PathBuf = PathBuf::new(),
}
}

impl SimulationConfig {
    /// Returns the files that may contain secrets: the configuration file, and those that it names.
    pub fn secret_files(&self) -> impl Iterator<Item = &Path> {
        let tokens = self.api_tokens.iter().map(|one| &one.token);
        let secrets = self.admin_password.iter().chain(&self.fleet_key).chain(tokens);
        let files = [Some(self.file.as_path()), self.git_config.as_ref().map(|file| &*file.0)];
        files.into_iter().flatten().chain(secrets.filter_map(Secret::file))
    }

    /// The folder of `monitor.csv`, `simulations.csv` and the outputs of simulations.
    pub fn records(&self) -> PathBuf {
        self.log_dir.0.join("simulation")
    }

    /// The name of the program that runs worlds.
    pub fn simulator(&self) -> Option<String> {
        let program = self.webots.as_ref()?.0.file_name()?;
        Some(program.to_string_lossy().into_owned())
    }

    /// Whether simulations are spread over the GPUs of the machine.
    pub fn spreads(&self) -> bool {
        self.gpus == GpuUse::Spread && (self.container.gpu || !self.docker)
    }

    /// The displays of the GPUs, if Webots opens its windows on them.
    pub fn displays_of_gpus(&self) -> &[String] {
        let in_container = self.container.display == ContainerDisplay::Virtual;
        let is_virtual = if self.docker { in_container } else { self.xvfb };
        if self.spreads() && !is_virtual {
            &self.displays
        } else {
            &[]
        }
    }

    /// The display for the window of a Webots with this GPU, or without a GPU of its own.
    pub fn display_on(&self, gpu: Option<u32>) -> String {
        let own = self.displays_of_gpus().get(gpu.unwrap_or_default() as usize);
        display::effective(own.or(self.display.as_ref()))
    }

    /// The displays on which simulations open their windows.
    pub fn all_displays(&self) -> Vec<String> {
        let count = self.displays_of_gpus().len().max(1);
        (0..count).map(|gpu| self.display_on(u32::try_from(gpu).ok())).collect()
    }
}

impl Configuration for SimulationConfig {
    const ALIASES: &'static [&'static str] = &["fullyQualifiedDomainName", "persistentDockerImages"];

    fn complete(&mut self, file: &Path) -> Result<Vec<String>, String> {
        file.clone_into(&mut self.file);
        let mut warnings = Vec::new();
        warnings.extend(complete_host(&mut self.server, self.port_rewrite)?);
        if self.webots_home.is_none() {
            self.webots_home = std::env::var_os("WEBOTS_HOME").map(|home| ExpandedPath(home.into()));
        }
        if self.docker {
            let is_free = matches!(self.isolation, IsolationSetting::Auto | IsolationSetting::Container);
            require(is_free, "docker", || {
                "true asks for containers, but isolation for another level; remove one of them".to_owned()
            })?;
            self.isolation = IsolationSetting::Container;
        }
        self.docker = self.isolation == IsolationSetting::Container;
        let places = self.max_connections;
        let editors = if self.docker { EDITOR_PORT } else { 0 };
        let last = u32::from(self.port) + u32::from(places) + u32::from(editors);
        require(
            u16::try_from(last).is_ok() && (!self.docker || places <= EDITOR_PORT),
            "maxConnections",
            || {
                format!(
                    "{places} places above port {} leave the range of ports; with containers allowed are up to {EDITOR_PORT} \
                 places, and editors up to port 65535: each has the port of its Webots + {EDITOR_PORT}",
                    self.port
                )
            },
        )?;
        if matches!(self.isolation, IsolationSetting::Auto | IsolationSetting::Sandbox) {
            self.sandbox.check()?;
        } else {
            require(!self.sandbox.network.is_demanded(), "sandbox.network", || {
                "networks of simulations' own are for sandboxes, and isolation is neither \"sandbox\" nor \"auto\""
                    .to_owned()
            })?;
        }
        warnings.extend(
            self.sandbox
                .missing()
                .map(|path| format!("sandbox: {} is not there", path.display())),
        );
        check_fleet_key(self.fleet_key.as_ref())?;
        check_api_tokens(&self.api_tokens)?;
        require(self.timing.silence > self.timing.ping, "timing.silence", || {
            format!("{} s is not more than timing.ping", self.timing.silence.as_secs_f64())
        })?;
        if let Some(header) = &self.user_header {
            require(HeaderName::try_from(header).is_ok(), "userHeader", || {
                format!("{header:?} is no name of a header, such as X-Forwarded-User")
            })?;
        }
        if self.allowed_repositories.is_empty() {
            let effect = if self.docker && self.share_idle_time > 0.0 {
                format!(
                    "any repository runs while the load is at most {} % (shareIdleTime)",
                    self.share_idle_time
                )
            } else {
                "no world will run here".to_owned()
            };
            warnings.push(format!("allowedRepositories is not set: {effect}"));
        }
        Ok(warnings)
    }
}
