//! From a failure to a mail: the built program, a stand-in that fails, a real SMTP server. `tests/python.sh` prepares it.

use serde_json::json;

use super::stand_in::{Manner, StandIn};
use super::{addresses, until_states};
use crate::support::program::{Server, session_server};
use crate::support::smtp::Smtp;

async fn start(servers: &[StandIn], smtp: &Smtp) -> Server {
    let timing = json!({"answer": 4, "gather": 0.5, "flapping": 0.5});
    session_server(&addresses(servers)).mails_to(smtp.port).set("timing", timing).start().await
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
    let session = start(&servers, &smtp).await;
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
async fn a_full_server_and_its_room_and_one_that_was_never_there_are_mailed() {
    for (manner, event) in [
        (Manner::idle(97.0, 10), "Simulation server reached maximum load"),
        (Manner::Reset, "Simulation server not responding"),
    ] {
        let mut smtp = Smtp::start(&[]).await;
        let servers = [StandIn::start(manner)];
        let _session = start(&servers, &smtp).await;
        let address = servers[0].address();
        assert_eq!(smtp.mail().await.subject(), format!("{event}: {address}"));
        if event.contains("load") {
            servers[0].set(Manner::idle(7.0, 10));
            assert_eq!(smtp.mail().await.subject(), format!("Simulation server available again: {address}"));
        }
    }
}
