//! Which ports of the machine are reachable from outside, what arrives there, and which client a limit counts.

use std::net::TcpListener;
use std::sync::mpsc::channel;

use serde_json::json;

use super::browser::Browser;
use super::fleet::Fleet;
use super::rules::Rules;
use super::users::oauth2_proxy;
use super::web_server::Kind;
use crate::support::http::PASSWORD;
use crate::support::listener::listen;
use crate::support::{Builder, until};

/// A service of the machine that is not part of the fleet, such as the administration page of a database. It runs until
/// the test program ends.
pub fn private_service() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    listen(listener, |_| Some((200, "secret")));
    port
}

/// Checks on one fleet where requests arrive, and which client they are attributed to.
async fn requests_lead_to_the_fleet_and_nowhere_else(rules: Rules) {
    let keys = |server: Builder| {
        server
            .set("trustedProxies", json!(["127.0.0.1"]))
            .set("maxClientsPerAddress", 2)
    };
    let fleet = Fleet::start_with(rules, keys).await;
    only_the_fleet_is_reachable(&fleet).await;
    an_editor_is_at_the_port_of_its_webots_and_500_more(&fleet).await;
    pages_are_sent_on_to_https_and_the_bare_name(&fleet.browser).await;
    paths_arrive(&fleet, rules).await;
    limits_are_for_each_client(&fleet).await;
}

through_both!(requests_lead_to_the_fleet_and_nowhere_else);

async fn only_the_fleet_is_reachable(fleet: &Fleet) {
    let private = private_service();
    let here = fleet.here.port;
    let plain = ["22", "5432", "1", "80", "443"].map(|port| format!("/{port}/"));
    let session = fleet.session.port;
    let tricks = [
        format!("/{private}/"),
        format!("//{private}/"),
        format!("/{here}/../{private}/"),
        format!("/{here}/%2e%2e/{private}/"),
        format!("/{here}/..%2f{private}/"),
        format!("/{here}@127.0.0.1:{private}/"),
        format!("/{here}%40127.0.0.1:{private}/"),
        format!("/{here}:{private}/"),
        format!("/0{private}/"),
        format!("/{here}0/"),
        format!("/{session}/x"),
        format!("/{session}/../{private}/"),
        format!("/{session}0/status"),
        format!("/assets/../{private}/"),
        "/server-status".to_owned(),
        // For administrators only.
        format!("/{here}/drain"),
        format!("/{here}//drain?x"),
        format!("/{here}/%64rain"),
        format!("/{}/drain", fleet.there.port),
    ];
    for path in plain.iter().chain(&tricks) {
        fleet.browser.finds_nothing(path).await;
    }
}

async fn an_editor_is_at_the_port_of_its_webots_and_500_more(fleet: &Fleet) {
    let editor = fleet.here.port + 1 + 500;
    listen(TcpListener::bind(("127.0.0.1", editor)).unwrap(), |request| {
        Some(if request.path() == "/a%20b?c" {
            (200, "editor")
        } else {
            (404, "")
        })
    });
    let answer = fleet.browser.get(&format!("/{editor}/a%20b?c")).await;
    assert_eq!((answer.status.as_u16(), answer.text().as_str()), (200, "editor"));
    // A participant's programs control the editor, so it must not share the origin of the administrator's pages.
    assert_eq!(answer.header("content-security-policy"), Some("sandbox allow-scripts"));
    // The simulation server itself has no editor.
    assert_eq!(fleet.browser.get(&format!("/{}/", editor - 1)).await.status, 404);
}

/// The path requested, and the path that arrives through Apache and through nginx; `None` if they refuse it.
const PATHS: [(&str, Option<&str>, Option<&str>); 16] = [
    (
        "/textures/my%20file.png",
        Some("/textures/my%20file.png"),
        Some("/textures/my%20file.png"),
    ),
    (
        "/%C3%BC+%2B.png?x=a%20b&y=%2F",
        Some("/%C3%BC++.png?x=a%20b&y=%2F"),
        Some("/%C3%BC++.png?x=a%20b&y=%2F"),
    ),
    ("/a%252fb.png", Some("/a%252fb.png"), Some("/a%252fb.png")),
    // Apache rejects an encoded question mark as an attack.
    ("/a%3Fb.png", None, Some("/a%3Fb.png")),
    // An encoded slash is decoded or refused.
    ("/a%2Fb.png", None, Some("/a/b.png")),
    // Webots joins any path to the project's folder.
    ("/a/../b.png", None, None),
    ("/a/%2e%2e/b.png", None, None),
    ("/%2e%2e/b.png", None, None),
    ("/a/.%2E/b.png", None, None),
    ("/%252e%252e/b.png", None, None),
    ("/a/.%25252E/b.png", None, None),
    ("/a.b.png?x=..", Some("/a.b.png?x=.."), Some("/a.b.png?x=..")),
    ("/a/..%2F..%2Fb.png", None, None),
    // Encoded line ends stay part of the name.
    (
        "/a%0D%0AX:%20y.png",
        Some("/a%0D%0AX:%20y.png"),
        Some("/a%0D%0AX:%20y.png"),
    ),
    ("/a%00.png", None, None),
    ("//a.png", Some("/a.png"), Some("/a.png")),
];

/// File names with blanks and non-ASCII letters arrive at Webots, and no path leaves its port.
async fn paths_arrive(fleet: &Fleet, rules: Rules) {
    let port = fleet.here.port + 2;
    let (told, asked) = channel();
    // After the end of the test the channel is closed.
    listen(TcpListener::bind(("127.0.0.1", port)).unwrap(), move |request| {
        told.send(request.path().to_owned()).ok().map(|()| (200, "file"))
    });
    for (path, apache, nginx) in PATHS {
        let wanted = if rules.kind() == Kind::Apache { apache } else { nginx };
        let answer = fleet.browser.get(&format!("/{port}{path}")).await;
        if wanted.is_some() {
            assert_eq!(
                (answer.status.as_u16(), answer.text().as_str()),
                (200, "file"),
                "{path}"
            );
        } else {
            assert!(
                [400, 403, 404].contains(&answer.status.as_u16()),
                "{path}: {}",
                answer.status
            );
        }
        assert_eq!(asked.try_recv().ok().as_deref(), wanted, "{path}");
    }
}

/// Limits and logs use the clients' addresses as the web server sends them; they can't be forged.
async fn limits_are_for_each_client(fleet: &Fleet) {
    let forged = [("x-forwarded-for", "203.0.113.9"), ("forwarded", "for=203.0.113.9")];
    let refused = async |browser: &Browser, url: &str, headers: &[(&'static str, &str)]| match browser
        .try_open(url, headers)
        .await
        .map_err(|error| *error)
    {
        Err(tokio_tungstenite::tungstenite::Error::Http(answer)) => assert_eq!(answer.status(), 429, "{url}"),
        other => panic!("{url}: {:?}", other.err()),
    };
    let door = format!("wss://{}/session", fleet.browser.host);
    for url in [
        door,
        format!("{}/client", fleet.wss(&fleet.here)),
        format!("{}/client", fleet.wss(&fleet.there)),
    ] {
        let many = fleet.browser.at("127.0.0.5");
        let first = many.open(&url).await;
        let _second = many.open(&url).await;
        refused(&many, &url, &[]).await;
        refused(&many, &url, &forged).await;
        let _other = fleet.browser.at("127.0.0.6").open(&url).await;
        first.leave().await;
        until("there is room again", async || many.try_open(&url, &[]).await.is_ok()).await;
    }
    for server in [&fleet.here, &fleet.there] {
        assert!(server.log().contains("client 127.0.0.5: connected"));
        assert!(!server.log().contains("203.0.113.9"));
    }
}

/// A browser sends the administrator's password and the sign-in cookie to every path of their host. Webots receives neither,
/// and no name of a user.
async fn no_simulation_gets_a_secret(rules: Rules) {
    let fleet = Fleet::start_with(rules, |server| server.set("adminPassword", PASSWORD)).await;
    let visitor = fleet.browser.at("127.0.0.9");
    let webots = fleet.here.port + 1;
    listen(TcpListener::bind(("127.0.0.1", webots)).unwrap(), |request| {
        let head = request.head.to_lowercase();
        let secrets = ["authorization", "cookie", "x-forwarded-user", "anna", "203.0.113.9"];
        Some((
            200,
            if secrets.iter().any(|secret| head.contains(secret)) {
                "told"
            } else {
                "nothing"
            },
        ))
    });
    let secrets = [
        ("authorization", "Basic YWRtaW46b3BlbiBzZXNhbWU="),
        ("cookie", "_oauth2_proxy=anna"),
    ];
    let forged = [("x-forwarded-for", "203.0.113.9"), ("forwarded", "for=203.0.113.9")];
    let secrets = [secrets, forged].concat();
    let url = |port: u16| format!("https://{}/{port}/", fleet.browser.host);
    assert_eq!(visitor.ask(&url(webots), &secrets).await.text(), "nothing");
    // The server itself receives the password: without it, it would answer 401.
    let output = format!("{}output?id=none", url(fleet.here.port));
    assert_eq!(visitor.ask(&output, &secrets).await.status, 404);
}

#[actix_rt::test]
async fn no_simulation_gets_a_secret_through_apache() {
    no_simulation_gets_a_secret(Rules::ApacheWithUsers).await;
}

#[actix_rt::test]
async fn no_simulation_gets_a_secret_through_nginx() {
    no_simulation_gets_a_secret(Rules::NginxWithUsers(oauth2_proxy())).await;
}

async fn pages_are_sent_on_to_https_and_the_bare_name(browser: &Browser) {
    let plain = format!("http://localhost:{}", browser.plain);
    let secure = format!("https://{}", browser.host);
    let www = ("Host", "www.localhost");
    let table = [(&plain, ("Host", "localhost")), (&plain, www), (&secure, www)];
    // The path is kept as it was sent; no part of it becomes a header, another host or a query.
    let paths = [
        "/",
        "/a%20b/%C3%BC+&?a=b&c=%20&d=%0d%0a",
        "/x%0D%0ASet-Cookie:%20a=b?y=%0d%0aSet-Cookie:%20a=b",
        "/a%3Fb%23c?d",
        "/.well-known/other?x",
    ];
    for (server, host) in table {
        for path in paths {
            let answer = browser.ask(&format!("{server}{path}"), &[host]).await;
            assert_eq!(answer.status, 301, "{server} {host:?} {path}");
            let location = answer.header("location").unwrap_or_default();
            let wanted = format!("https://localhost{path}");
            // Hexadecimal digits may be in either case.
            assert_eq!(location.to_lowercase(), wanted.to_lowercase(), "{server} {host:?}");
            assert_eq!(answer.header("set-cookie"), None, "{server} {host:?} {path}");
        }
        // No path redirects to another host.
        let answer = browser.ask(&format!("{server}//other.example/"), &[host]).await;
        assert!(
            answer.header("location").unwrap().starts_with("https://localhost/"),
            "{server} {host:?}"
        );
    }
    let question = format!("{plain}/.well-known/acme-challenge/token");
    assert_eq!(
        browser.ask(&question, &[]).await.status,
        404,
        "certbot's questions are answered here"
    );
}
