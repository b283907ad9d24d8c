//! The simulation server's configuration, `config/simulation/NAME.json`.

use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::shared::config::{Configuration, Unfit};
use crate::shared::config::{ExpandedPath, folder, local_address, object, one_or_many, percent, seconds, whole};
use crate::shared::domain::UrlPrefix;
use crate::shared::domain::{PublicAddress, check_host};
use crate::shared::http::Origin;
use crate::shared::http::TrustedProxies;
use crate::simulation::checkout::Mirrors;
use crate::simulation::machine::display::DisplayName;

/// Every key of the simulation server. The original's keys keep their meaning.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
#[expect(clippy::struct_excessive_bools, reason = "they are keys of a file that exists")]
pub struct SimulationConfig {
    /// Fully qualified domain name of the simulation server. Default: `localhost`, with a warning.
    #[serde(default, alias = "fullyQualifiedDomainName")]
    pub server: String,
    /// Whether URLs begin with `https` and `wss`. Default: true.
    #[serde(default = "yes")]
    pub ssl: bool,
    /// Local port. Webots uses the ports that follow it. Default: 2000.
    #[serde(default = "port", deserialize_with = "whole::<1, 65000, _, _>")]
    pub port: u16,
    /// Local address to listen on. Default: all of them.
    #[serde(default = "everywhere", deserialize_with = "local_address")]
    pub bind: IpAddr,
    /// Whether a web server in front rewrites ports in URLs: HOST/PORT, not HOST:PORT. Default: true.
    #[serde(default = "yes")]
    pub port_rewrite: bool,
    /// Folder of `simulation/output.log`, `simulation/monitor.csv` and the instances' output. Default: `log`.
    #[serde(default = "log_folder", deserialize_with = "folder")]
    pub log_dir: ExpandedPath,
    /// Log to standard output. Default: false.
    #[serde(default)]
    pub debug: bool,
    /// Headline of the monitor page.
    #[serde(default)]
    pub title: Option<String>,
    /// Text below the headline.
    #[serde(default)]
    pub description: Option<String>,
    /// Where Webots is installed. Default: the environment variable `WEBOTS_HOME`.
    #[serde(default)]
    pub webots_home: Option<ExpandedPath>,
    /// The program to start in place of the one in `webotsHome`.
    #[serde(default)]
    pub webots: Option<ExpandedPath>,
    /// Folder of local projects. It is accepted for existing files; nothing is read from it.
    #[serde(default)]
    pub projects_dir: Option<ExpandedPath>,
    /// Run Webots in containers. Not supported: only `false` is accepted.
    #[serde(default)]
    pub docker: bool,
    /// Images that pruning keeps. It is accepted for existing files, and used with docker only.
    #[serde(default, alias = "persistentDockerImages", deserialize_with = "one_or_many")]
    pub persistant_docker_images: Vec<String>,
    /// Whose worlds run here, as URL prefixes by whole path segments. Default: nobody's.
    #[serde(default, deserialize_with = "one_or_many")]
    pub allowed_repositories: Vec<UrlPrefix>,
    /// Whose worlds never run here.
    #[serde(default, deserialize_with = "one_or_many")]
    pub blocked_repositories: Vec<UrlPrefix>,
    /// With docker, worlds of others may run while the load (percent) is at most this; 0: never. Default: 50.
    #[serde(default = "half", deserialize_with = "percent")]
    pub share_idle_time: f64,
    /// Addresses that are told, at start, that this server is there. Default: none.
    #[serde(default, deserialize_with = "one_or_many")]
    pub notify: Vec<String>,
    /// How many simulations may run at a time. Webots uses port+1 .. port+maxConnections. Default: 100.
    #[serde(default = "places", deserialize_with = "whole::<1, 10_000, _, _>")]
    pub max_connections: u16,
    /// How many clients may wait for a place. Default: 100.
    #[serde(default = "waiting_line", deserialize_with = "whole::<0, 100_000, _, _>")]
    pub waiting_line: usize,
    /// How many client connections may be open in all, those without a simulation included. Default: 1000.
    #[serde(default = "many_clients", deserialize_with = "whole::<1, 1_000_000, _, _>")]
    pub max_clients: usize,
    /// How many of them one client address may have. Default: 1000, for a class sits behind one address.
    #[serde(default = "a_class", deserialize_with = "whole::<1, 1_000_000, _, _>")]
    pub max_clients_per_address: usize,
    /// Web servers, as addresses or networks, whose `X-Forwarded-For` or `Forwarded` tells their clients' addresses.
    /// Default: `["127.0.0.0/8", "::1/128"]`.
    #[serde(default)]
    pub trusted_proxies: TrustedProxies,
    /// Seconds after which a simulation is closed, at least 360. Default: 7200.
    #[serde(default = "two_hours", deserialize_with = "whole::<360, 31_536_000, _, _>")]
    pub timeout: u64,
    /// Write `simulation/monitor.csv`. Default: true.
    #[serde(default = "yes")]
    pub monitor_log_enabled: bool,
    /// Whether a world's URL may name any commit by its hash, not only the newest of a branch or tag. Forges hand out
    /// commits of forks and proposals too, which the repository's owner never accepted. Default: false.
    #[serde(default)]
    pub any_commit: bool,
    /// From where repositories are cloned in place of their URL: {URL prefix: replacement}.
    #[serde(default)]
    pub git_mirrors: Mirrors,
    /// Folder of cached repositories and of the projects of running simulations. Default: `cache`.
    #[serde(default = "cache_folder", deserialize_with = "folder")]
    pub cache_dir: ExpandedPath,
    /// How much room cached repositories may take, in MiB. Default: 10240.
    #[serde(default = "ten_gigabytes", deserialize_with = "whole::<1, 100_000_000, _, _>")]
    pub cache_size: u64,
    /// How large a project may be, in MiB: what is fetched, and what is checked out. Default: 1024.
    #[serde(default = "one_gigabyte", deserialize_with = "whole::<1, 100_000_000, _, _>")]
    pub project_size: u64,
    /// The display that Webots opens its window on. Default: the environment variable `DISPLAY`, else `:0`.
    #[serde(default)]
    pub display: Option<DisplayName>,
    /// Give each Webots a virtual display of its own (needs `xvfb-run`). Default: false.
    #[serde(default)]
    pub xvfb: bool,
    /// A simulation that is silent for six heartbeats is ended after so many more seconds. Default: 60.
    #[serde(default = "one_minute", with = "seconds")]
    pub hang_limit: Duration,
    /// Pages from which browsers may open `/client`, as origins (`https://lab.org`). Default: any.
    #[serde(default, deserialize_with = "one_or_many")]
    pub allowed_origins: Vec<Origin>,
    /// Password of actions such as `/drain`. Default: none, and actions are off.
    #[serde(default)]
    pub admin_password: Option<crate::shared::config::Secret>,
    /// Every other duration.
    #[serde(default, deserialize_with = "object")]
    pub timing: Timing,
}

/// Durations, in seconds.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct Timing {
    /// How long a checkout may take. Default: 120.
    #[serde(with = "seconds")]
    pub checkout: Duration,
    /// How long Webots may take until it listens. Default: 120.
    #[serde(with = "seconds")]
    pub launch: Duration,
    /// Between two signs of life of Webots. Default: 5.
    #[serde(with = "seconds")]
    pub heartbeat: Duration,
    /// How long Webots may take to end after SIGTERM, before SIGKILL. Default: 5.
    #[serde(with = "seconds")]
    pub grace: Duration,
    /// Between two pings of a client. Default: 20.
    #[serde(with = "seconds")]
    pub ping: Duration,
    /// A client that is silent for so long is gone. Default: 60.
    #[serde(with = "seconds")]
    pub silence: Duration,
    /// How long open connections and simulations may take to end when the server stops. Default: 9.
    #[serde(with = "seconds")]
    pub stop: Duration,
    /// Between two tries to announce the server. Default: 5.
    #[serde(with = "seconds")]
    pub announce: Duration,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            checkout: Duration::from_mins(2),
            launch: Duration::from_mins(2),
            heartbeat: Duration::from_secs(5),
            grace: Duration::from_secs(5),
            ping: Duration::from_secs(20),
            silence: Duration::from_mins(1),
            stop: Duration::from_secs(9),
            announce: Duration::from_secs(5),
        }
    }
}

impl SimulationConfig {
    /// Where this server, or a Webots of it, is reached from outside.
    #[must_use]
    pub fn address(&self, port: u16) -> PublicAddress {
        PublicAddress::new(&self.server, port, self.port_rewrite)
    }

    /// The ports that Webots may use.
    #[must_use]
    pub fn streaming_ports(&self) -> std::ops::RangeInclusive<u16> {
        self.port + 1..=self.port.saturating_add(self.max_connections)
    }

    /// The program that is started for each client, if it is known.
    #[must_use]
    pub fn webots_program(&self) -> Option<PathBuf> {
        if let Some(program) = &self.webots {
            return Some(program.0.clone());
        }
        let inside = if cfg!(target_os = "macos") { "Contents/MacOS/webots" } else { "webots" };
        self.webots_home.as_ref().map(|home| home.0.join(inside))
    }
}

impl Configuration for SimulationConfig {
    const ALIASES: &'static [&'static str] = &["fullyQualifiedDomainName", "persistentDockerImages"];

    fn complete(&mut self) -> Result<Vec<String>, Unfit> {
        let mut warnings = Vec::new();
        if self.server.is_empty() {
            warnings.push("server is not set: URLs will name localhost".to_owned());
            "localhost".clone_into(&mut self.server);
        }
        check_host(&self.server, self.port_rewrite).map_err(|problem| Unfit { key: "server", problem })?;
        if self.webots_home.is_none() {
            self.webots_home = std::env::var_os("WEBOTS_HOME").map(ExpandedPath::plain);
        }
        if self.docker {
            let problem = "true is not supported; allowed is false. Worlds would run without the container that was \
                           asked for";
            return Err(Unfit { key: "docker", problem: problem.to_owned() });
        }
        if self.port.checked_add(self.max_connections).is_none() {
            let problem = format!("{} places above port {} leave the range of ports", self.max_connections, self.port);
            return Err(Unfit { key: "maxConnections", problem });
        }
        if self.timing.silence <= self.timing.ping {
            let problem = format!("{} s is not more than timing.ping", self.timing.silence.as_secs_f64());
            return Err(Unfit { key: "timing.silence", problem });
        }
        for address in &self.notify {
            let is_web = url::Url::parse(address).is_ok_and(|url| matches!(url.scheme(), "http" | "https"));
            if !is_web {
                let problem = format!("{address:?} is no URL; allowed are http and https URLs");
                return Err(Unfit { key: "notify", problem });
            }
        }
        if self.allowed_repositories.is_empty() {
            warnings.push("allowedRepositories is not set: no world will run here".to_owned());
        }
        Ok(warnings)
    }
}

fn yes() -> bool {
    true
}

fn port() -> u16 {
    2000
}

fn everywhere() -> IpAddr {
    Ipv4Addr::UNSPECIFIED.into()
}

fn log_folder() -> ExpandedPath {
    ExpandedPath::plain("log")
}

fn cache_folder() -> ExpandedPath {
    ExpandedPath::plain("cache")
}

fn half() -> f64 {
    50.0
}

fn places() -> u16 {
    100
}

fn waiting_line() -> usize {
    100
}

fn a_class() -> usize {
    1000
}

fn many_clients() -> usize {
    1000
}

fn two_hours() -> u64 {
    7200
}

fn ten_gigabytes() -> u64 {
    10 * 1024
}

fn one_gigabyte() -> u64 {
    1024
}

fn one_minute() -> Duration {
    Duration::from_mins(1)
}
