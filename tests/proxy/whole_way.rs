//! From the first click to the end of a simulation, through each web server with each set of rules. All URLs that the servers
//! send lead through the web server.

use tokio::net::TcpStream;

use super::fleet::{Fleet, arm};
use super::rules::Rules;
use crate::support::until;

/// Returns the fleet for further checks.
pub async fn the_whole_way(rules: Rules) -> Fleet {
    let fleet = Fleet::start(rules).await;
    let browser = &fleet.browser;
    let at_the_door = |path: &str| rules.session_path(fleet.session.port, path);

    // Pages with their assets. The servers log the URLs of their pages.
    let port = format!("/{}", fleet.session.port);
    let door = format!(
        "https://{}{}/monitor",
        browser.host,
        if rules.is_door() { "" } else { &port }
    );
    assert!(fleet.session.log().contains(&door), "{}", fleet.session.log());
    let page = browser.ask(&door, &[]).await.text();
    let status = browser.get(&at_the_door("/status")).await.json();
    for server in [&fleet.here, &fleet.there] {
        let path = fleet.path(server, server.port);
        let monitor = format!("https://{}{path}/monitor", browser.host);
        assert!(page.contains(&monitor), "{page}");
        assert!(server.log().contains(&monitor), "{}", server.log());
        assert!(
            status["servers"]
                .as_array()
                .unwrap()
                .iter()
                .any(|one| one["monitor"] == *monitor),
            "{status}"
        );
        let answer = browser.ask(&monitor, &[]).await;
        let policy = answer.header("content-security-policy").unwrap();
        assert!(
            answer.status == 200 && policy.starts_with("default-src 'none'") && !policy.contains("sandbox"),
            "{policy}"
        );
        let load = browser.get(&format!("{path}/load")).await.text();
        assert!(load.parse::<f64>().is_ok(), "{load}");
        assert_eq!(browser.get(&format!("{path}/assets/style.css")).await.status, 200);
    }
    assert_eq!(browser.get(&at_the_door("/monitor")).await.status, 200);
    assert_eq!(browser.get(&at_the_door("/assets/style.css")).await.status, 200);
    assert_eq!(browser.get(&at_the_door("/viewer")).await.status, 200);
    until("the door is open", async || {
        browser.get(&at_the_door("/request")).await.text() == "1"
    })
    .await;

    // The session server.
    let mut door = browser.connect(&at_the_door("/")).await;
    door.until("1").await;
    let mut session = browser.connect(&at_the_door("/session")).await;
    session.until("1").await;
    let both = [fleet.wss(&fleet.here), fleet.wss(&fleet.there)];
    let question = at_the_door(&format!("/session?url={}", arm()));
    until("a page is given a simulation server", async || {
        both.contains(&browser.get(&question).await.text())
    })
    .await;
    session.send(&arm()).await;
    let given = session.until("wss").await;
    assert!(both.contains(&given), "{given}");

    // A simulation on each machine; the web client derives the address of files from that of the stream.
    for server in [&fleet.here, &fleet.there] {
        let (client, stream) = fleet.simulate(browser, server).await;
        let path = fleet.path(server, server.port + 1);
        assert_eq!(stream, format!("wss://{}{path}", browser.host));
        let mut viewer = browser.open(&format!("{stream}/")).await.with_scene().await;
        let file = browser.get(&format!("{path}/worlds/textures/old%20wood.png?x=1")).await;
        assert_eq!((file.status.as_u16(), file.text().as_str()), (200, "a picture"));
        // Files from Webots are sandboxed, except with the documents' rules.
        let policy = (rules != Rules::Documents).then_some("sandbox allow-scripts");
        assert_eq!(file.header("content-security-policy"), policy);
        viewer.send("real-time:-1").await;
        viewer.until("application/json:").await;
        client.leave().await;
        viewer.closed().await;
        let webots = (fleet.machine(server), server.port + 1);
        until("Webots has ended", async || TcpStream::connect(webots).await.is_err()).await;
    }
    fleet
}

through_both!(the_whole_way);

#[actix_rt::test]
async fn through_apache_with_the_documents_rules() {
    the_whole_way(Rules::Documents).await;
}
