//! A session server and two simulation servers behind a web server, one of them on another machine.

use std::time::Duration;

use super::browser::Browser;
use super::rules::{Place, Rules};
use super::web_server::WebServer;
use crate::support::authority::{Authority, trusting};
use crate::support::client::Client;
use crate::support::git::Forge;
pub use crate::support::git::arm;
use crate::support::http;
use crate::support::ports;
use crate::support::program::{Builder, Server, session_server, simulation_server};
use crate::support::until;
use crate::support::webots::Webots;

/// The fleet; dropping it stops every part.
pub struct Fleet {
    rules: Rules,
    pub browser: Browser,
    pub web: WebServer,
    pub session: Server,
    /// On the first machine.
    pub here: Server,
    /// On the second machine.
    pub there: Server,
    _authority: Authority,
    _webots: Webots,
    _forge: Forge,
}

/// The slots of each simulation server.
pub const PLACES: u16 = 3;
/// The web servers' idle timeout, shortened: after this time without traffic they close a connection.
pub const IDLE: Duration = Duration::from_secs(4);

impl Fleet {
    pub async fn start(rules: Rules) -> Self {
        Self::start_with(rules, |server| server).await
    }

    /// A fleet; `keys` sets further keys on all its servers.
    pub async fn start_with(rules: Rules, keys: impl Fn(Builder) -> Builder) -> Self {
        let authority = Authority::new();
        let certificate = authority.issue(&["localhost", "www.localhost"]);
        let http = ports::block(1);
        let https = ports::block(1);
        let host = format!("localhost:{https}");
        let webots = Webots::launcher();
        let forge = Forge::with_arm();
        forge.commit("lab/arm", "main", &[("worlds/textures/old wood.png", "a picture")]);
        let behind = |server: Builder| {
            let server = if rules.is_door() {
                server.set("publicUrl", format!("wss://{host}/{{host}}/{{port}}"))
            } else {
                server
                    .set("server", host.as_str())
                    .set("ssl", true)
                    .set("portRewrite", true)
            };
            // While a test waits for one connection, it answers no pings on the others.
            keys(server.set("timing.ping", 0.5).set("timing.silence", 60))
        };
        let port = ports::block(PLACES + 12);
        let [here, there] = rules.machines().map(|machine| {
            let server = simulation_server(&webots.path(), forge.path(), PLACES).env("DEMO_SIMULATOR_BIND", machine);
            let server = server.set("bind", machine).set("timing.heartbeat", 0.2);
            if rules.is_door() {
                // As a container learns its host name.
                behind(
                    server
                        .port(port)
                        .set("server", "$FLEET_TEST_HOST")
                        .env("FLEET_TEST_HOST", machine),
                )
                .spawn()
            } else {
                behind(server).spawn()
            }
        });
        let addresses = if rules.is_door() {
            rules.machines().map(|machine| format!("{machine}:{port}"))
        } else {
            [&here, &there].map(|server| format!("{host}/{}", server.port))
        };
        let examples = serde_json::json!([{"title": "Arm", "url": arm()}]);
        let session = session_server(&addresses)
            .set("examples", examples)
            // Other load on this machine must not make the servers full.
            .set("loadThreshold", 1000)
            .set("timing.gather", 0.1)
            .set("timing.flapping", 0.1)
            .env("SSL_CERT_FILE", authority.file().to_str().unwrap());
        let session = behind(session).spawn();
        let ports = |server: &Server| (server.port..=server.port + PLACES).collect::<Vec<_>>();
        let place = Place {
            http,
            https,
            session: session.port,
            here: &ports(&here),
            there: &ports(&there),
            chain: certificate.chain.to_str().unwrap(),
            key: certificate.key.to_str().unwrap(),
        };
        let web = WebServer::start(rules.kind(), (http, https), &rules.text(&place), IDLE).await;
        let browser = Browser {
            address: "127.0.0.1",
            trust: trusting(&authority.file()),
            host,
            plain: http,
        };
        let _authority = authority;
        let _webots = webots;
        let _forge = forge;
        let fleet = Self {
            rules,
            browser,
            web,
            session,
            here,
            there,
            _authority,
            _webots,
            _forge,
        };
        fleet.both_up().await;
        fleet
    }

    /// Waits until both simulation servers are up.
    pub async fn both_up(&self) {
        until("both simulation servers answer", async || {
            let status = http::try_get(&self.session.url("/status")).await;
            status.is_ok_and(|page| {
                page.json()["servers"]
                    .as_array()
                    .unwrap()
                    .iter()
                    .all(|one| one["load"].is_number())
            })
        })
        .await;
    }

    /// Starts a simulation; returns its client and the URL of its stream.
    pub async fn simulate(&self, browser: &Browser, server: &Server) -> (Client, String) {
        let mut client = browser.open(&format!("{}/client", self.wss(server))).await;
        client
            .send(&serde_json::json!({"start": {"url": arm()}}).to_string())
            .await;
        let webots = client.until("webots:").await;
        (client, webots.strip_prefix("webots:").unwrap().to_owned())
    }

    /// The machine of a simulation server.
    pub fn machine(&self, server: &Server) -> &'static str {
        self.rules.machines()[usize::from(std::ptr::eq(server, &self.there))]
    }

    /// The web server's path of a port of a simulation server's machine.
    pub fn path(&self, server: &Server, port: u16) -> String {
        if self.rules.is_door() {
            format!("/{}/{port}", self.machine(server))
        } else {
            format!("/{port}")
        }
    }

    /// The URL at which clients connect to a simulation server.
    pub fn wss(&self, server: &Server) -> String {
        format!("wss://{}{}", self.browser.host, self.path(server, server.port))
    }
}
