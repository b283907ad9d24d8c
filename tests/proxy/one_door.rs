//! A fleet of several machines behind one nginx (`deploy/nginx-door.conf`, that of `deploy/kubernetes`, `publicUrl`). The
//! machines are 127.0.0.2 and 127.0.0.3, whose servers have the same port.

use tokio::net::TcpStream;

use super::browser::Browser;
use super::exposure::private_service;
use super::fleet::{IDLE, arm};
use super::rules::adapt;
use super::web_server::{Kind, WebServer};
use crate::support::authority::{Authority, Certificate, trusting};
use crate::support::client::Client;
use crate::support::git::Forge;
use crate::support::program::{Builder, Server, session_server, simulation_server};
use crate::support::webots::Webots;
use crate::support::{ports, until};

const PLACES: u16 = 2;
const MACHINES: [&str; 2] = ["127.0.0.2", "127.0.0.3"];

/// Everything; each part ends with it.
struct Fleet {
    browser: Browser,
    session: Server,
    simulation: [Server; 2],
    _web: WebServer,
    _authority: Authority,
    _webots: Webots,
    _forge: Forge,
}

/// The files of nginx that are tried.
#[derive(Debug, Clone, Copy)]
enum Door {
    Example,
    Kubernetes,
}

const DOORS: [Door; 2] = [Door::Example, Door::Kubernetes];

impl Door {
    /// The file, for this certificate and these ports.
    fn site(self, certificate: &Certificate, (http, https): (u16, u16), session: &str) -> String {
        let (chain, key) = (certificate.chain.to_str().unwrap(), certificate.key.to_str().unwrap());
        let listen = (format!("listen 127.0.0.1:{http};"), format!("listen 127.0.0.1:{https} ssl;"));
        match self {
            Self::Example => adapt(
                include_str!("../../deploy/nginx-door.conf"),
                &[
                    ("/etc/letsencrypt/live/fleet.example.org/fullchain.pem", chain),
                    ("/etc/letsencrypt/live/fleet.example.org/privkey.pem", key),
                    ("fleet.example.org", "localhost"),
                    ("listen [::]:80;\n", "\n"),
                    ("listen [::]:443 ssl;\n", "\n"),
                    ("listen 80;", &listen.0),
                    ("listen 443 ssl;", &listen.1),
                    ("192\\.0\\.2\\.[0-9]+", "127\\.0\\.0\\.[23]"),
                    ("192.0.2.1:1999", session),
                ],
            ),
            Self::Kubernetes => adapt(
                include_str!("../../deploy/kubernetes/base/config/fleet.conf"),
                &[
                    (
                        "include /etc/nginx/conf.d/tls*.part;",
                        include_str!("../../deploy/kubernetes/base/config/tls.part"),
                    ),
                    ("/etc/nginx/tls/tls.crt", chain),
                    ("/etc/nginx/tls/tls.key", key),
                    ("listen 8080;", &listen.0),
                    ("listen 8443 ssl;", &listen.1),
                    ("^10\\.[0-9]+\\.[0-9]+\\.[0-9]+$", "^127\\.0\\.0\\.[23]$"),
                    ("session:1999", session),
                ],
            ),
        }
    }
}

impl Fleet {
    async fn start(door: Door) -> Self {
        let authority = Authority::new();
        let certificate = authority.issue(&["localhost"]);
        let (http, https) = (ports::block(1), ports::block(1));
        let host = format!("localhost:{https}");
        let behind = |server: Builder| {
            let server = server.set("publicUrl", format!("wss://{host}/{{host}}/{{port}}"));
            server.set("timing.ping", 0.5).set("timing.silence", 10)
        };
        let (webots, forge) = (Webots::launcher(), Forge::with_arm());
        forge.commit("lab/arm", "main", &[("worlds/textures/wood.png", "a picture")]);
        let port = ports::block(PLACES + 12);
        let simulation = MACHINES.map(|machine| {
            let server = simulation_server(&webots.path(), forge.path(), PLACES).port(port);
            // As engines tell a container which host it is.
            let server = server.set("bind", machine).set("server", "$FLEET_TEST_HOST").env("FLEET_TEST_HOST", machine);
            behind(server.env("DEMO_SIMULATOR_BIND", machine).set("timing.heartbeat", 0.2)).spawn()
        });
        let addresses = MACHINES.map(|machine| format!("{machine}:{port}"));
        let session = behind(session_server(&addresses).set("loadThreshold", 1000)).spawn();
        let places: Vec<_> = (port + 1..=port + PLACES).map(|port| port.to_string()).collect();
        let site = adapt(
            &door.site(&certificate, (http, https), &session.address()),
            &[
                ("(?<fleet_port>2000)", &format!("(?<fleet_port>{port})")),
                ("200[1-9]|201[0-9]|2020", &places.join("|")),
            ],
        );
        let web = WebServer::start(Kind::Nginx, (http, https), &site, IDLE).await;
        let browser = Browser { address: "127.0.0.1", trust: trusting(&authority.file()), host, plain: http };
        let fleet =
            Self { browser, session, simulation, _web: web, _authority: authority, _webots: webots, _forge: forge };
        until("both simulation servers answer", async || {
            let status = fleet.browser.get("/status").await;
            status.status == 200
                && status.json()["servers"].as_array().unwrap().iter().all(|server| server["load"].is_number())
        })
        .await;
        fleet
    }

    fn port(&self) -> u16 {
        self.simulation[0].port
    }
}

#[actix_rt::test]
async fn a_visitor_gets_everywhere_through_one_door() {
    for door in DOORS {
        goes_everywhere(&Fleet::start(door).await).await;
    }
}

async fn goes_everywhere(fleet: &Fleet) {
    let (browser, port) = (&fleet.browser, fleet.port());
    let door = |scheme: &str, machine: &str, port: u16| format!("{scheme}://{}/{machine}/{port}", browser.host);

    // The session server tells clients the way through the door, and asks the servers themselves.
    let page = browser.get("/monitor").await.text();
    let status = browser.get("/status").await.json();
    for (number, machine) in MACHINES.into_iter().enumerate() {
        let monitor = format!("{}/monitor", door("https", machine, port));
        assert!(page.contains(&monitor), "{monitor} is not in {page}");
        assert_eq!(status["servers"][number]["monitor"], monitor);
        assert_eq!(status["servers"][number]["address"], format!("{machine}:{port}"));
        assert_eq!(browser.ask(&monitor, &[]).await.status, 200);
        let log = fleet.simulation[number].log();
        let line = format!("simulation server  {monitor}   {}/client", door("wss", machine, port));
        assert!(log.lines().any(|one| one == line), "{line} is not in {log}");
    }
    let line = format!("session server     https://{0}/monitor   wss://{0}/session", browser.host);
    assert!(fleet.session.log().lines().any(|one| one == line), "{}", fleet.session.log());
    let policy = browser.get("/viewer").await.header("content-security-policy").unwrap().to_owned();
    assert!(policy.contains(&format!("https://{0} wss://{0}", browser.host)), "{policy}");

    let mut session = browser.connect("/session").await;
    session.until("1").await;
    session.send(&arm()).await;
    let given = session.until("wss").await;
    assert!(MACHINES.iter().any(|machine| given == door("wss", machine, port)), "{given}");

    // A simulation on each machine; the web client appends /client, and derives the address of files from that of the stream.
    for machine in MACHINES {
        let mut client: Client = browser.open(&format!("{}/client", door("wss", machine, port))).await;
        client.send(&serde_json::json!({"start": {"url": arm()}}).to_string()).await;
        let stream = client.until("webots:").await;
        assert_eq!(stream, format!("webots:{}", door("wss", machine, port + 1)));
        let mut viewer = browser.open(&format!("{}/", door("wss", machine, port + 1))).await;
        viewer.send("x3d").await;
        viewer.until("scene load completed").await;
        let file = browser.get(&format!("/{machine}/{}/worlds/textures/wood.png?x=1", port + 1)).await;
        assert_eq!((file.status.as_u16(), file.text().as_str()), (200, "a picture"));
        assert_eq!(file.header("content-security-policy"), Some("sandbox allow-scripts"));
        client.leave().await;
        viewer.closed().await;
        until("Webots has ended", async || TcpStream::connect((machine, port + 1)).await.is_err()).await;
    }
}

#[actix_rt::test]
async fn who_is_lost_comes_back_through_the_door() {
    let fleet = Fleet::start(Door::Example).await;
    let client = |machine: &str| format!("/{machine}/{}/client", fleet.port());
    let mut tokens = Vec::new();
    for machine in MACHINES {
        let mut lost = fleet.browser.connect(&client(machine)).await;
        lost.send(&serde_json::json!({"start": {"url": arm(), "resumable": true}}).to_string()).await;
        let stream = lost.until("webots:").await["webots:".len()..].to_owned();
        tokens.push((lost.until("resume: ").await["resume: ".len()..].to_owned(), stream));
        drop(lost);
    }
    // Each at its own machine only, and from another address.
    let browser = fleet.browser.at("127.0.0.9");
    for (number, machine) in MACHINES.into_iter().enumerate() {
        let mut stranger = browser.connect(&client(machine)).await;
        stranger.send(&serde_json::json!({"resume": tokens[1 - number].0}).to_string()).await;
        assert_eq!(stranger.until("").await, "loading: Error: this simulation has ended");
        assert_eq!(stranger.closed().await, Some(1000));
        let mut back = browser.connect(&client(machine)).await;
        let (token, stream) = &tokens[number];
        back.send(&serde_json::json!({ "resume": token }).to_string()).await;
        assert_eq!(back.until("webots:").await, format!("webots:{stream}"));
        let mut viewer = browser.open(&format!("{stream}/")).await;
        viewer.send("x3d;broadcast").await;
        viewer.until("scene load completed").await;
        // It counts once, here and for the session server.
        until("both servers say so", async || {
            let own = browser.get(&format!("/{machine}/{}/status", fleet.port())).await.json();
            let known = browser.get("/status").await.json()["servers"][number]["instances"].clone();
            own["instances"]["arrivals"] == 1 && own["simulations"].as_array().unwrap().len() == 1 && known["idle"] == 1
        })
        .await;
        back.close_with(1000).await;
        viewer.closed().await;
    }
}

#[actix_rt::test]
async fn the_door_leads_to_the_fleet_and_nowhere_else() {
    for door in DOORS {
        leads_nowhere_else(&Fleet::start(door).await).await;
    }
}

async fn leads_nowhere_else(fleet: &Fleet) {
    let (private, port) = (private_service(), fleet.port());
    for path in [
        // Another host: this machine, one of its names, one on the internet.
        format!("/127.0.0.1/{private}/"),
        format!("/127.0.0.1/{port}/"),
        format!("/localhost/{port}/"),
        format!("/127.0.0.2.example.org/{port}/"),
        format!("/127.0.0.22/{port}/"),
        format!("/1.1.1.1/{port}/"),
        format!("/example.org/{port}/"),
        // Another port of a machine of the fleet.
        "/127.0.0.2/22/".to_owned(),
        format!("/127.0.0.2/{private}/"),
        format!("/127.0.0.2/{port}0/"),
        format!("/127.0.0.2/0{port}/"),
        format!("/127.0.0.2/{}/", port + PLACES + 1),
        format!("/127.0.0.2/{port}/../../127.0.0.1/{private}/"),
        format!("/127.0.0.2/{port}/%2e%2e/%2e%2e/127.0.0.1/{private}/"),
        format!("/127.0.0.2:{private}/{port}/"),
        format!("/127.0.0.2/{port}:{private}/"),
        format!("/127.0.0.2/{port}@127.0.0.1:{private}/"),
        format!("/127.0.0.2%40127.0.0.1/{port}/"),
        format!("/127.0.0.1%23127.0.0.2/{port}/"),
        format!("/%0a127.0.0.2/{port}/"),
        // The session server has no such path, and its port is not one of a simulation server.
        format!("/127.0.0.1/{}/status", fleet.session.port),
        format!("/{port}/"),
        // What is for administrators alone.
        format!("/127.0.0.2/{port}/drain"),
        format!("/127.0.0.2//{port}/drain"),
        format!("/127.0.0.2/{port}/%64rain"),
    ] {
        let answer = fleet.browser.get(&path).await;
        assert!([400, 403, 404].contains(&answer.status.as_u16()), "{path}: {}", answer.status);
        assert!(!answer.text().contains("secret"), "{path}");
        let url = format!("wss://{}{path}", fleet.browser.host);
        assert!(fleet.browser.try_open(&url, &[]).await.is_err(), "{path}");
    }
}
