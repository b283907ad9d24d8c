//! From a failure to a chat message: the built program, a stand-in that fails, a real web server for the webhook.

use serde_json::json;

use super::stand_in::{Manner, StandIn};
use super::{addresses, until_states};
use crate::support::authority::Authority;
use crate::support::http;
use crate::support::program::{Builder, Server, session_server};
use crate::support::receiver::Receiver;
use crate::support::smtp::Smtp;
use crate::support::until;

/// A secret in the webhook's URL; only the configuration may show it.
const SECRET: &str = "T0PSECRET";

fn with_webhook(servers: &[StandIn], scheme: &str, port: u16) -> Builder {
    let url = format!("{scheme}://localhost:{port}/services/{SECRET}?key={SECRET}");
    let timing = json!({"answer": 4, "gather": 0.5, "flapping": 0.5, "mailRetry": 0.05, "mailAnswer": 5});
    session_server(&addresses(servers))
        .set("webhook", url)
        .set("timing", timing)
}

/// Three servers that fail.
fn fleet() -> [StandIn; 3] {
    [(); 3].map(|()| StandIn::start(Manner::Reset))
}

fn says_nothing_secret(session: &Server) {
    assert!(!session.log().contains(SECRET), "{}", session.log());
}

#[actix_rt::test]
async fn the_notices_of_a_mail_are_one_message_and_need_no_mail() {
    let servers = fleet();
    let receiver = Receiver::start(None);
    let session = with_webhook(&servers, "http", receiver.port).start().await;
    let text = receiver.texts(1).await.remove(0);
    assert!(text.starts_with("Simulation servers: 3 not responding\n"), "{text}");
    for server in addresses(&servers) {
        assert!(text.contains(&format!("{server}: not responding")), "{text}");
    }
    assert!(
        text.contains(&format!("http://localhost:{}/monitor", session.port)),
        "{text}"
    );
    let posted = receiver.posted().remove(0);
    assert_eq!(posted.line, format!("POST /services/{SECRET}?key={SECRET} HTTP/1.1"));
    assert_eq!(posted.body.as_object().unwrap().len(), 1);
    // A server's problem text must not become a mention, a link or a second line in a chat.
    servers[0].set(Manner::idle(7.0, 10));
    until_states(&session, &["up", "down", "down"]).await;
    servers[0].set(Manner::Status(
        json!({"load": 100, "problem": "<!channel> & <https://evil.example|x>\nhello"}),
    ));
    until("its words are told", async || {
        receiver
            .posted()
            .iter()
            .any(|one| one.body.to_string().contains("channel"))
    })
    .await;
    for text in receiver.texts(2).await {
        assert!(!text.contains(['<', '>', '&']) && !text.contains("\nhello"), "{text}");
    }
    says_nothing_secret(&session);
    for path in ["/status", "/monitor", "/metrics"] {
        assert!(!http::get(&session.url(path)).await.text().contains(SECRET), "{path}");
    }
    until("it is logged", async || {
        session.log().contains("webhook sent by localhost:")
    })
    .await;
}

#[actix_rt::test]
async fn a_webhook_and_a_mail_are_retried_independently() {
    let servers = fleet();
    let receiver = Receiver::start(None);
    let other = Receiver::start(None);
    receiver.answer("503 Busy");
    let mut smtp = Smtp::start(&[]).await;
    let session = with_webhook(&servers, "http", receiver.port)
        .mails_to(smtp.port)
        .start()
        .await;
    // The mail does not wait for the webhook.
    assert_eq!(smtp.mail().await.subject(), "Simulation servers: 3 not responding");
    receiver.texts(3).await;
    until("it is logged", async || {
        session.log().contains("webhook not sent, it is tried again")
    })
    .await;
    assert!(session.log().contains("503 Service Unavailable"), "{}", session.log());
    // Redirects are not followed: no other server receives the notices.
    receiver.answer(&format!("307 Elsewhere\r\nLocation: http://127.0.0.1:{}/", other.port));
    until("it is logged", async || {
        session.log().contains("307 Temporary Redirect")
    })
    .await;
    receiver.answer("204 Taken");
    until("it is sent", async || session.log().contains("webhook sent by")).await;
    assert!(
        receiver
            .texts(4)
            .await
            .last()
            .unwrap()
            .starts_with("Simulation servers: 3 not responding")
    );
    assert!(other.posted().is_empty());
    says_nothing_secret(&session);
}

#[actix_rt::test]
async fn a_messenger_whose_certificate_is_not_trusted_is_told_nothing() {
    let lab = Authority::new();
    let other = Authority::new();
    let receiver = Receiver::start(Some(&lab.issue(&["localhost"])));
    for (authority, trusted) in [(&other, false), (&lab, true)] {
        let servers = fleet();
        let builder = with_webhook(&servers, "https", receiver.port);
        let session = builder
            .env("SSL_CERT_FILE", authority.file().to_str().unwrap())
            .start()
            .await;
        if trusted {
            receiver.texts(1).await;
        } else {
            let words = "its certificate is not trusted";
            until("it is logged", async || session.log().contains(words)).await;
            assert!(receiver.posted().is_empty());
        }
        says_nothing_secret(&session);
    }
}

#[actix_rt::test]
async fn the_webhook_can_be_tried_and_is_never_shown() {
    let receiver = Receiver::start(None);
    let says = async |option: &str, webhook: &str| {
        let (code, said) = super::mail::says(option, &json!({ "webhook": webhook }), "/dev/null").await;
        assert!(!said.contains(SECRET), "{webhook}: {said}");
        (code, said)
    };
    let url = format!("http://127.0.0.1:{}/{SECRET}", receiver.port);
    let sent = format!("127.0.0.1:{} took a test: 200 OK\n", receiver.port);
    assert_eq!(says("--test-mail", &url).await, (Some(0), sent));
    assert!(receiver.texts(1).await[0].contains("Nothing has happened"));
    receiver.answer("404 Gone");
    let (code, said) = says("--test-mail", &url).await;
    assert!(code == Some(1) && said.contains("404 Not Found"), "{said}");
    let (code, said) = says("--check", &url).await;
    assert!(code == Some(0) && said.contains("\"webhook\": \"********\""), "{said}");
    for wrong in [SECRET, &format!("ftp://x/{SECRET}"), &format!("https:///{SECRET} x")] {
        let (code, said) = says("--check", wrong).await;
        assert!(
            code == Some(2) && said.contains("webhook: it is no URL of a web server"),
            "{wrong}: {said}"
        );
    }
}
