//! Clients' addresses: they come from the web server, serve limits and logs, and can't be forged.

use super::browser::Browser;
use super::fleet::Fleet;
use super::rules::Rules;
use crate::support::until;

const FORGED: &[(&str, &str)] = &[("x-forwarded-for", "203.0.113.9"), ("forwarded", "for=203.0.113.9")];

async fn limits_are_for_each_client(rules: Rules) {
    // With the documents' rules Apache adds its own line to what the client wrote.
    let forged = if rules == Rules::Documents { &FORGED[..1] } else { FORGED };
    let fleet = Fleet::start_with(rules, |server| {
        server.set("trustedProxies", serde_json::json!(["127.0.0.1"])).set("maxClientsPerAddress", 2)
    })
    .await;
    let door = format!("wss://{}{}", fleet.browser.host, rules.session_path(fleet.session.port, "/session"));
    for url in [door, format!("{}/client", fleet.wss(&fleet.here)), format!("{}/client", fleet.wss(&fleet.there))] {
        let many = fleet.browser.at("127.0.0.5");
        let first = many.open(&url).await;
        let _second = many.open(&url).await;
        assert_eq!(refused(&many, &url, &[]).await, 429, "{url}");
        assert_eq!(refused(&many, &url, forged).await, 429, "{url}");
        let _other = fleet.browser.at("127.0.0.6").open(&url).await;
        first.leave().await;
        until("there is room again", async || many.try_open(&url, &[]).await.is_ok()).await;
    }
    for server in [&fleet.here, &fleet.there] {
        assert!(server.log().contains("client 127.0.0.5: connected"));
        assert!(!server.log().contains("203.0.113.9"));
    }
}

async fn refused(browser: &Browser, url: &str, headers: &[(&'static str, &str)]) -> u16 {
    match browser.try_open(url, headers).await.map_err(|error| *error) {
        Err(tokio_tungstenite::tungstenite::Error::Http(answer)) => answer.status().as_u16(),
        Err(other) => panic!("{url}: {other}"),
        Ok(_) => panic!("{url}: not refused"),
    }
}

through_both!(limits_are_for_each_client);

#[actix_rt::test]
async fn limits_behind_the_documents_rules_are_for_each_client() {
    limits_are_for_each_client(Rules::Documents).await;
}
