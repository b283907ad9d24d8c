//! Streams through the simulation servers, behind each web server with our rules: one port of each machine is enough.

use super::fleet::Fleet;
use super::rules::Rules;
use crate::support::until;

async fn streams_come_through_the_simulation_server(rules: Rules) {
    // The relay reaches Webots on the loopback of its machine.
    let relay = |server: crate::support::program::Builder| {
        server.set("streaming", "relay").env("DEMO_SIMULATOR_BIND", "127.0.0.1")
    };
    let fleet = Fleet::start_with(rules, relay).await;
    let browser = &fleet.browser;
    for server in [&fleet.here, &fleet.there] {
        let (client, stream) = fleet.simulate(browser, server).await;
        let beginning = format!("{}/stream/", fleet.wss(server));
        let token = stream
            .strip_prefix(&beginning)
            .unwrap_or_else(|| panic!("{stream}"))
            .to_owned();
        let mut viewer = browser.open(&format!("{stream}/")).await.with_scene().await;
        viewer.send("real-time:-1").await;
        viewer.until("application/json:").await;
        let of = |path: &str| format!("/{}/stream/{token}{path}", server.port);
        let file = browser.get(&of("/worlds/textures/old%20wood.png?x=1")).await;
        assert_eq!((file.status.as_u16(), file.text().as_str()), (200, "a picture"));
        assert_eq!(file.header("content-security-policy"), Some("sandbox allow-scripts"));
        client.leave().await;
        viewer.closed().await;
        until("the token is gone", async || {
            browser.get(&of("/worlds/textures/old%20wood.png")).await.status == 404
        })
        .await;
        // No log contains the token; other requests are logged.
        let known = format!("GET /{}/status", server.port);
        browser.get(&format!("/{}/status", server.port)).await;
        until("the request is logged", async || {
            fleet.web.access_log().contains(&known)
        })
        .await;
        assert!(!fleet.web.access_log().contains(&token), "{}", fleet.web.access_log());
    }
}

through_both!(streams_come_through_the_simulation_server);
