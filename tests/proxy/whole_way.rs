//! From the first click to the end of a simulation, through each web server with each set of rules.

use tokio::net::TcpStream;

use super::fleet::{Fleet, arm};
use super::rules::Rules;
use crate::support::until;

async fn the_whole_way(rules: Rules) {
    let fleet = Fleet::start(rules).await;
    let browser = &fleet.browser;
    let at_the_door = |path: &str| rules.session_path(fleet.session.port, path);

    // Pages.
    let page = browser.get(&at_the_door("/monitor")).await;
    assert_eq!(page.status, 200);
    for server in [&fleet.here, &fleet.there] {
        assert!(page.text().contains(&format!("https://{}/{}/monitor", browser.host, server.port)), "{}", page.text());
        assert_eq!(browser.get(&format!("/{}/monitor", server.port)).await.status, 200);
        let load = browser.get(&format!("/{}/load", server.port)).await.text();
        assert!(load.parse::<f64>().is_ok(), "{load}");
    }
    assert_eq!(browser.get(&at_the_door("/status")).await.json()["servers"].as_array().unwrap().len(), 2);
    until("the door is open", async || browser.get(&at_the_door("/request")).await.text() == "1").await;

    // The door.
    let mut door = browser.connect(&at_the_door("/")).await;
    door.until("1").await;
    let mut session = browser.connect(&at_the_door("/session")).await;
    session.until("1").await;
    let both = [fleet.wss(&fleet.here), fleet.wss(&fleet.there)];
    let question = at_the_door(&format!("/session?url={}", arm()));
    until("a page is given a simulation server", async || both.contains(&browser.get(&question).await.text())).await;
    session.send(&arm()).await;
    let given = session.until("wss").await;
    assert!(both.contains(&given), "{given}");

    // A simulation on each machine.
    for (server, address) in [(&fleet.here, "127.0.0.1"), (&fleet.there, "127.0.0.2")] {
        let (client, stream) = fleet.simulate(browser, server).await;
        assert_eq!(stream, format!("wss://{}/{}", browser.host, server.port + 1));
        let mut viewer = browser.open(&format!("{stream}/")).await;
        viewer.send("x3d").await;
        viewer.until("scene load completed").await;
        let file = browser.get(&format!("/{}/worlds/textures/old%20wood.png?x=1", server.port + 1)).await;
        assert_eq!((file.status.as_u16(), file.text().as_str()), (200, "a picture"));
        viewer.send("real-time:-1").await;
        viewer.until("application/json:").await;
        client.leave().await;
        viewer.closed().await;
        until("Webots has ended", async || TcpStream::connect((address, server.port + 1)).await.is_err()).await;
    }
    door.leave().await;
}

through_both!(the_whole_way);

#[actix_rt::test]
async fn through_apache_with_the_documents_rules() {
    the_whole_way(Rules::Documents).await;
}
