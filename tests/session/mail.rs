//! From a failure to a mail: the built program, a stand-in that fails, a real SMTP server. `tests/python.sh` prepares it.

use serde_json::json;

use super::stand_in::{Manner, StandIn};
use super::{addresses, until_states};
use crate::support::git::Forge;
use crate::support::program::{Builder, session_server, simulation_server};
use crate::support::smtp::Smtp;
use crate::support::webots::Webots;

fn with_mails(servers: &[StandIn], smtp: &Smtp) -> Builder {
    of_addresses(&addresses(servers), smtp)
}

fn of_addresses(servers: &[String], smtp: &Smtp) -> Builder {
    session_server(servers)
        .set("administrator", "admin@example.org")
        .set("mailSender", "fleet@example.org")
        .set("mailServer", "127.0.0.1")
        .set("mailServerPort", smtp.port)
        .set("timing", json!({"answer": 4, "gather": 0.5, "flapping": 0.5}))
}

#[actix_rt::test]
async fn every_kind_of_failure_is_mailed_and_so_is_its_end() {
    let failures = [
        (Manner::Reset, "no connection"),
        (Manner::Hang, "no answer within 4 s"),
        (Manner::Drip, "no answer within 4 s"),
        (Manner::Body(500, Vec::new()), "status 500"),
        (Manner::Status(json!({"load": "much"})), "an answer that makes no sense"),
        (Manner::Status(json!({"load": 100, "problem": "no display answers at :0"})), "no display answers at :0"),
    ];
    let mut smtp = Smtp::start(&[]).await;
    let servers: Vec<StandIn> = failures.iter().map(|_| StandIn::start(Manner::idle(7.0, 10))).collect();
    let session = with_mails(&servers, &smtp).start().await;
    until_states(&session, &["up"; 6]).await;
    for (server, (manner, _)) in servers.iter().zip(&failures) {
        server.set(manner.clone());
    }
    let mut text = String::new();
    for (server, (manner, words)) in servers.iter().zip(&failures) {
        let address = server.address();
        while !text.contains(&format!("{address}: not responding")) {
            text.push_str(smtp.mail().await.field("text"));
        }
        let entry = text.split(&format!("{address}: not responding")).nth(1).unwrap();
        let entry = entry.split("responding").next().unwrap();
        assert!(entry.contains(words), "{manner:?}: {entry}");
        assert!(entry.contains("7.0%"), "the last known load of {manner:?}: {entry}");
    }
    assert!(text.contains(&format!("http://localhost:{}/monitor", session.port)), "{text}");
    for server in &servers {
        server.set(Manner::idle(7.0, 10));
    }
    let mut text = String::new();
    for (server, (manner, words)) in servers.iter().zip(&failures) {
        let told = format!("{}: working again", server.address());
        while !text.contains(&told) {
            text.push_str(smtp.mail().await.field("text"));
        }
        let entry = text.split(&told).nth(1).unwrap().split("working again").next().unwrap();
        assert!(entry.contains(words), "the last error of {manner:?}: {entry}");
    }
}

#[actix_rt::test]
async fn a_simulation_server_that_is_not_ready_is_mailed_with_its_reason_and_so_is_its_end() {
    let mut smtp = Smtp::start(&[]).await;
    let (forge, webots) = (Forge::with_arm(), Webots::launcher());
    let server = simulation_server(&webots.path(), forge.path(), 1).start().await;
    let session = of_addresses(&[server.address()], &smtp).set("loadThreshold", 1000).start().await;
    until_states(&session, &["up"]).await;
    let away = webots.path().with_extension("away");
    std::fs::rename(webots.path(), &away).unwrap();
    let mail = smtp.mail().await;
    assert_eq!(mail.subject(), format!("Simulation server not responding: {}", server.address()));
    let text = mail.field("text");
    assert!(text.contains("This simulation server has no Webots that it can run"), "{text}");
    std::fs::rename(&away, webots.path()).unwrap();
    let mail = smtp.mail().await;
    assert_eq!(mail.subject(), format!("Simulation server working again: {}", server.address()));
}

#[actix_rt::test]
async fn a_full_server_is_mailed_and_so_is_its_room() {
    let mut smtp = Smtp::start(&[]).await;
    let servers = [StandIn::start(Manner::idle(97.0, 10))];
    let _session = with_mails(&servers, &smtp).start().await;
    let address = servers[0].address();
    assert_eq!(smtp.mail().await.subject(), format!("Simulation server reached maximum load: {address}"));
    servers[0].set(Manner::idle(7.0, 10));
    assert_eq!(smtp.mail().await.subject(), format!("Simulation server available again: {address}"));
}

#[actix_rt::test]
async fn a_server_that_was_never_there_is_mailed() {
    let mut smtp = Smtp::start(&[]).await;
    let servers = [StandIn::start(Manner::Reset)];
    let session = with_mails(&servers, &smtp).start().await;
    let mail = smtp.mail().await;
    assert_eq!(mail.subject(), format!("Simulation server not responding: {}", servers[0].address()));
    until_states(&session, &["down"]).await;
}
