//! The session server's configuration, `config/session/NAME.json`.

use std::net::{IpAddr, Ipv6Addr};
use std::time::Duration;

use actix_web::http::header::HeaderName;
use lettre::message::Mailbox;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::mail_address::MailAddress;
use super::server_entry::ServerEntry;
use super::timing::Timing;
use crate::session::placement::PlacementPolicy;
use crate::shared::config::keys::keys;
use crate::shared::config::{
    ApiToken, Configuration, Expanded, ExpandedPath, OneOrMany, OptionalWhole, Percent, Seconds, Secret, Whole,
    check_api_tokens, check_fleet_key, is_web_url, require,
};
use crate::shared::domain::{PublicAddress, PublicUrl, ReadyEntry, complete_host};
use crate::shared::http::{Origin, TrustedProxies};

keys! {
/// Every key of the session server. The original's keys keep their meaning.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default)]
pub struct SessionConfig {
    /// Fully qualified domain name of the session server. Default: `localhost`, with a warning.
    #[serde(with = "Expanded")]
    #[schemars(extend("default" = "localhost"))]
    pub server: String = String::new(),
    /// Whether URLs begin with `https` and `wss`. Default: true.
    pub ssl: bool = true,
    /// Local port; 0 takes any free one. Default: 1999.
    #[serde(with = "Whole::<0, 65535>")]
    pub port: u16 = 1999,
    /// Local address to listen on. Default: `::`, all addresses of IPv4 and IPv6.
    pub bind: IpAddr = Ipv6Addr::UNSPECIFIED.into(),
    /// Whether a reverse proxy rewrites ports in URLs: HOST/PORT, not HOST:PORT. Default: true.
    pub port_rewrite: bool = true,
    /// How clients reach the simulation servers through one reverse proxy: a URL with the placeholders `{host}` and
    /// `{port}`. Default: none, and each is reached at its own address.
    pub public_url: Option<PublicUrl> = None,
    /// The simulation servers: HOST:PORT, HOST/PORT, or `dns+NAME:PORT` for all addresses of a name.
    /// Required.
    pub simulation_servers: Vec<ServerEntry> = Vec::new(),
    /// Those of `simulationServers` that get no new clients. They are still monitored. Default: none.
    pub drained_servers: Vec<PublicAddress> = Vec::new(),
    /// Mail address of the administrator, who gets notifications. Default: none, and no mail is sent.
    #[serde(with = "MailAddress")]
    pub administrator: Option<Mailbox> = None,
    /// Host of the SMTP server. Default: none, and no mail is sent.
    pub mail_server: Option<String> = None,
    /// SMTP port. Default: 25, with a password 587.
    #[serde(with = "OptionalWhole::<1, 65535>")]
    pub mail_server_port: Option<u16> = None,
    /// Whether the SMTP server encrypts from the first byte, without STARTTLS. Default: true for port 465, else false.
    pub mail_server_implicit_tls: Option<bool> = None,
    /// Mail address that notifications come from. Default: none, and no mail is sent.
    #[serde(with = "MailAddress")]
    pub mail_sender: Option<Mailbox> = None,
    /// User name for SMTP. Default: `mailSender`.
    pub mail_sender_user: Option<String> = None,
    /// Password for SMTP. With a password the connection is always encrypted. Default: none.
    pub mail_sender_password: Option<Secret> = None,
    /// URL that notices are posted to as JSON, `{"text": ...}`, as Slack and Matrix expect it. Default: none.
    pub webhook: Option<Secret> = None,
    /// Password for actions such as `/announcement`. Default: none, and actions are off.
    pub admin_password: Option<Secret> = None,
    /// Tokens of programs, each with what it may do. Default: none.
    #[serde(with = "OneOrMany::<ApiToken>")]
    pub api_tokens: Vec<ApiToken> = Vec::new(),
    /// Secret of at least 16 letters that all servers of a fleet share: it signs the passes and tickets of the line.
    /// Default: none, and a free slot is for the first client that comes.
    pub fleet_key: Option<Secret> = None,
    /// The header in which a reverse proxy of `trustedProxies` sends the user's name, such as `X-Forwarded-User`: a user
    /// has one place in the line. Default: none.
    pub user_header: Option<String> = None,
    /// Whether the page `/viewer` starts simulations only of visitors who give a name. Default: `optional`.
    pub ask_name: AskName = AskName::Optional,
    /// Folder of `session/output.log`. Default: `log`.
    pub log_dir: ExpandedPath = ExpandedPath("log".into()),
    /// Log to standard output. Default: false.
    pub debug: bool = false,
    /// A simulation server with this load (percent) or more gets no client. Above 100, the load does not matter.
    /// Default: 95.
    #[serde(with = "Percent::<1000>")]
    pub load_threshold: f64 = PlacementPolicy::default().threshold,
    /// Interval between two probes of a simulation server, in seconds. Default: 1.
    #[serde(with = "Seconds")]
    pub load_refresh: Duration = Duration::from_secs(1),
    /// Load (percent) that a client adds to a simulation server that reports only its load. For the others it is
    /// learned, starting from this. Default: 2.
    #[serde(with = "Percent::<100>")]
    pub client_cost: f64 = PlacementPolicy::default().client_cost,
    /// Limit of open client `WebSockets` in all. Default: 20000.
    #[serde(with = "Whole::<1, 1_000_000>")]
    pub max_clients: usize = 20_000,
    /// Limit of open client `WebSockets` per client address. Default: three quarters of `maxClients`, but at most 1000,
    /// because a class shares one address.
    #[serde(with = "OptionalWhole::<1, 1_000_000>")]
    pub max_clients_per_address: Option<usize> = None,
    /// Reverse proxies, as addresses or networks, whose header `X-Forwarded-For` is trusted.
    /// Default: `["127.0.0.0/8", "::1/128"]`.
    pub trusted_proxies: TrustedProxies = TrustedProxies::default(),
    /// Worlds that the page `/viewer` offers: `{"title": ..., "url": ...}`. Default: none.
    #[serde(with = "OneOrMany::<Example>")]
    pub examples: Vec<Example> = Vec::new(),
    /// Worlds of which the fleet keeps simulations ready: `{"world": ..., "count": ..., "when": ...}`; needs `fleetKey`.
    /// Default: none.
    #[serde(with = "OneOrMany::<ReadyEntry>")]
    pub ready: Vec<ReadyEntry> = Vec::new(),
    /// URL of Webots' own viewer (`WebotsView.js`), for simulation servers that don't have it. Default: none.
    pub viewer_script: Option<url::Url> = None,
    /// Origins of web pages, such as `https://lab.org`, that may show `/viewer?embed=1` in a frame. Default: none.
    #[serde(with = "OneOrMany::<Origin>")]
    pub frame_ancestors: Vec<Origin> = Vec::new(),
    /// All other durations.
    pub timing: Timing = Timing::default(),
}
}

/// The key `askName`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum AskName {
    /// A visitor may give a name.
    Optional,
    /// A visitor must give a name, unless a web server with sign-in names the user.
    Required,
}

/// An example on the page `/viewer`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Example {
    /// Its title.
    pub title: String,
    /// The world's URL.
    pub url: String,
}

impl SessionConfig {
    /// The parameters of placement.
    pub fn policy(&self) -> PlacementPolicy {
        PlacementPolicy {
            threshold: self.load_threshold,
            client_cost: self.client_cost,
            placement_timeout: self.timing.placement,
        }
    }

    /// Returns the address of this server.
    pub fn address(&self) -> PublicAddress {
        PublicAddress::new(&self.server, self.port, self.port_rewrite)
    }

    /// Returns the HTTP URL under which clients reach this server. With a public URL, it is that of the reverse proxy.
    pub fn http_url(&self) -> String {
        self.public_url
            .as_ref()
            .map_or_else(|| self.address().http_url(self.ssl), PublicUrl::http_door)
    }

    /// Returns the WebSocket URL under which clients reach this server.
    pub fn websocket_url(&self) -> String {
        let door = self.public_url.as_ref().map(PublicUrl::websocket_door);
        format!(
            "{}/session",
            door.unwrap_or_else(|| self.address().websocket_url(self.ssl))
        )
    }

    /// Checks that only listed servers are drained.
    fn check_servers(&self) -> Result<(), String> {
        // A name may resolve to any server.
        let has_names = self.simulation_servers.iter().any(|entry| entry.name().is_some());
        for address in &self.drained_servers {
            let is_listed = has_names || self.simulation_servers.contains(&ServerEntry::Server(address.clone()));
            require(is_listed, "drainedServers", || {
                format!("{address} is not one of simulationServers")
            })?;
        }
        Ok(())
    }
}

impl Configuration for SessionConfig {
    const REQUIRED: &'static [&'static str] = &["simulationServers"];

    fn complete(&mut self, _: &std::path::Path) -> Result<Vec<String>, String> {
        let warning = complete_host(&mut self.server, self.port_rewrite)?;
        self.check_servers()?;
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
        let allowed = "no URL of a web server; allowed are http and https";
        if let Some(script) = &self.viewer_script {
            require(is_web_url(script.as_str()), "viewerScript", || {
                format!("{script} is {allowed}")
            })?;
        }
        self.webhook = self.webhook.take().filter(|url| !url.reveal().is_empty());
        if let Some(webhook) = &self.webhook {
            // The text itself is a secret.
            require(is_web_url(webhook.reveal()), "webhook", || format!("it is {allowed}"))?;
        }
        self.mail_server = self.mail_server.take().filter(|host| !host.is_empty());
        let no_key =
            "ready needs fleetKey, the same as that of the simulation servers: without it, nothing is kept ready";
        let unkept = (!self.ready.is_empty() && self.fleet_key.is_none()).then(|| no_key.to_owned());
        Ok(warning.into_iter().chain(unkept).collect())
    }
}
