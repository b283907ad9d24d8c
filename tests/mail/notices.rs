//! What is mailed: one mail for what belongs together, with its words in plain text.

use std::time::{Duration, Instant};

use ::log::Level;
use serde_json::json;
use webots_fleet::session::mail::NoticeKind;

use super::log::wait_for_log;
use super::{nothing_unexpected, notice, start};
use crate::support::smtp::Smtp;

#[actix_rt::test]
async fn a_notice_becomes_a_mail_in_plain_text() {
    let mut smtp = Smtp::start(&[]).await;
    let mailer = start(smtp.port, &json!({}));
    mailer.send(notice("sim1.example.org", NoticeKind::NotResponding)).unwrap();
    let mail = smtp.mail().await;
    assert_eq!(mail.field("from"), "fleet@example.org");
    assert_eq!(mail.recipients(), ["admin@example.org"]);
    assert_eq!(mail.header("To"), ["Admin <admin@example.org>"]);
    assert_eq!(mail.header("Auto-Submitted"), ["auto-generated"]);
    assert_eq!((mail.header("Date").len(), mail.header("Message-ID").len()), (1, 1));
    assert_eq!(mail.subject(), "Simulation server not responding: sim1.example.org:2000");
    let now = humantime::format_rfc3339(std::time::SystemTime::now()).to_string();
    let year = &now[.."2026-".len()];
    let parts = ["sim1.example.org:2000", "not responding", "97.2%", "connection refused", year];
    for part in parts.into_iter().chain(["https://session.example.org/1999/monitor"]) {
        assert!(mail.field("text").contains(part), "no {part:?} in {mail:?}");
    }
    assert!(mail.header("Content-Type")[0].starts_with("text/plain"), "{mail:?}");
    wait_for_log(Level::Info, smtp.port, 1).await;
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn a_thousand_servers_that_fail_together_are_one_mail() {
    let mut smtp = Smtp::start(&[]).await;
    let mailer = start(smtp.port, &json!({"timing": {"gather": 3}}));
    for number in 0..1_000 {
        mailer.send(notice(&format!("sim{number}"), NoticeKind::NotResponding)).unwrap();
    }
    let mail = smtp.mail().await;
    assert_eq!(mail.subject(), "Simulation servers: 1000 not responding");
    for server in ["sim0:2000", "sim500:2000", "sim999:2000"] {
        assert!(mail.field("text").contains(server), "no {server}");
    }
    // The next mail is the next notice's: nothing else was on its way.
    mailer.send(notice("other", NoticeKind::MaximumLoad)).unwrap();
    assert_eq!(smtp.mail().await.subject(), "Simulation server reached maximum load: other:2000");
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn a_flapping_server_is_one_mail_in_its_time() {
    let mut smtp = Smtp::start(&[]).await;
    let mailer = start(smtp.port, &json!({"timing": {"flapping": 2}}));
    let first = Instant::now();
    mailer.send(notice("sim", NoticeKind::NotResponding)).unwrap();
    assert_eq!(smtp.mail().await.subject(), "Simulation server not responding: sim:2000");
    for turn in 0..9 {
        let event = if turn % 2 == 0 { NoticeKind::WorkingAgain } else { NoticeKind::NotResponding };
        mailer.send(notice("sim", event)).unwrap();
    }
    let mail = smtp.mail().await;
    assert!(first.elapsed() > Duration::from_secs(2), "the second mail came after {:?}", first.elapsed());
    assert_eq!(mail.subject(), "Simulation server working again: sim:2000");
    assert_eq!(smtp.count("mail"), 2);
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn nothing_from_outside_gets_into_the_headers_or_begins_a_line() {
    let mut smtp = Smtp::start(&[]).await;
    let mailer = start(smtp.port, &json!({}));
    let mut evil = notice("sim\r\nBcc: thief@example.com\r\n\r\nbody", NoticeKind::NotResponding);
    evil.error = Some("<script>alert(1)</script>\r\n.\r\nRCPT TO:<thief@example.com>\u{1b}[2J".to_owned());
    mailer.send(evil).unwrap();
    let mail = smtp.mail().await;
    assert_eq!(mail.recipients(), ["admin@example.org"]);
    assert!(mail.header("Bcc").is_empty(), "{mail:?}");
    assert_eq!(mail.subject(), "Simulation server not responding: sim  Bcc: thief@example.com    body:2000");
    assert!(!mail.field("text").contains("\nRCPT TO"), "{mail:?}");
    assert!(!mail.field("text").contains('\u{1b}'), "{mail:?}");
    smtp.wait_for("closed").await;
    assert_eq!(smtp.commands(), ["EHLO", "MAIL", "RCPT", "DATA", "QUIT"]);
    nothing_unexpected(smtp.port);
}
