//! Mail servers that refuse, hang or are not there.

use std::time::Duration;

use ::log::Level;
use serde_json::json;
use webots_fleet::session::mail::{self, NoticeKind};

use super::log::{logged, wait_for_log};
use super::{loaded, notice, start, test_mail};
use crate::support::ports::dead_port;
use crate::support::smtp::Smtp;
use crate::support::stopwatch::Stopwatch;

#[actix_rt::test]
async fn a_test_mail_says_how_it_went() {
    let refused = [
        (&["--refuse", "recipient"], "550 5.1.1 no such user here"),
        (&["--refuse", "mail"], "451 4.3.0 try again later"),
        (&["--login", "fleet:s3cret"], "530 5.7.0 Authentication required"),
    ];
    for (options, words) in refused {
        let smtp = Smtp::start(options).await;
        let error = test_mail(&loaded(smtp.port, &json!({}))).await.unwrap_err();
        assert_eq!(error, format!("127.0.0.1:{}: {words}", smtp.port));
    }
    let (_reserved, dead) = dead_port();
    let error = test_mail(&loaded(dead, &json!({}))).await.unwrap_err();
    assert!(error.starts_with(&format!("127.0.0.1:{dead}: Connection refused")), "{error}");
    // A label of 64 letters can't be in any name server, so that none is asked.
    let nobody = format!("{}.example.org", "a".repeat(64));
    let error = test_mail(&loaded(25, &json!({"mailServer": nobody}))).await.unwrap_err();
    assert!(error.starts_with(&format!("{nobody}:25: failed to lookup address information")), "{error}");

    let mut smtp = Smtp::start(&[]).await;
    let said = test_mail(&loaded(smtp.port, &json!({}))).await.unwrap();
    assert_eq!(said, format!("127.0.0.1:{} took a test: 2.0.0 OK: queued", smtp.port));
    let mail = smtp.mail().await;
    assert_eq!(mail.subject(), "Test of the session server's notifications");
    assert!(mail.field("text").contains("Nothing has happened"), "{mail:?}");
}

#[actix_rt::test]
async fn without_one_of_the_three_keys_mails_are_off() {
    for key in ["administrator", "mailServer", "mailSender"] {
        let mut config = loaded(25, &json!({}));
        match key {
            "administrator" => config.administrator = None,
            "mailServer" => config.mail_server = None,
            _ => config.mail_sender = None,
        }
        assert!(mail::start(&config).is_empty(), "there is a mailer without {key}");
        let error = test_mail(&config).await.unwrap_err();
        assert_eq!(error, format!("notifications are off: {key} is not set"));
    }
}

#[actix_rt::test]
async fn a_mail_arrives_once_the_server_is_there() {
    let (reserved, port) = dead_port();
    let mailer = start(port, &json!({}));
    mailer.send(notice("a", NoticeKind::NotResponding)).unwrap();
    let failures = wait_for_log(Level::Warn, port, 2).await;
    assert!(failures[0].contains("Connection refused"), "{failures:?}");
    mailer.send(notice("b", NoticeKind::NotResponding)).unwrap();
    mailer.send(notice("a", NoticeKind::WorkingAgain)).unwrap();
    wait_for_log(Level::Warn, port, 4).await;
    drop(reserved);
    let mut smtp = Smtp::start(&["--port", &port.to_string()]).await;
    let mut text = smtp.mail().await.field("text").to_owned();
    // The end of the first failure may become due with the others or after them.
    while !text.contains("a:2000: working again") {
        text.push_str(smtp.mail().await.field("text"));
    }
    assert_eq!(text.matches("b:2000: not responding").count(), 1, "{text}");
    assert_eq!(logged(Level::Error, port), [""; 0]);
}

#[actix_rt::test]
async fn a_mail_is_given_up_with_one_line() {
    let (reserved, port) = dead_port();
    let mailer = start(port, &json!({"timing": {"mailPatience": 0.5}}));
    mailer.send(notice("lost", NoticeKind::NotResponding)).unwrap();
    let lines = wait_for_log(Level::Error, port, 1).await;
    assert!(lines[0].starts_with("mail given up (Simulation server not responding: lost:2000): "), "{lines:?}");
    drop(reserved);
    let mut smtp = Smtp::start(&["--port", &port.to_string()]).await;
    mailer.send(notice("new", NoticeKind::NotResponding)).unwrap();
    assert_eq!(smtp.mail().await.subject(), "Simulation server not responding: new:2000");
    assert_eq!(logged(Level::Error, port).len(), 1);
}

#[actix_rt::test]
async fn a_silent_server_holds_up_nobody_and_leaves_nothing_open() {
    let mut smtp = Smtp::start(&["--hang", "greeting"]).await;
    let mailer = start(smtp.port, &json!({"timing": {"mailAnswer": 3, "mailPatience": 4}}));
    mailer.send(notice("sim", NoticeKind::NotResponding)).unwrap();
    smtp.wait_for("opened").await;
    let stopwatch = Stopwatch::start();
    let asked = stopwatch.lap();
    mailer.send(notice("other", NoticeKind::NotResponding)).unwrap();
    assert!(asked.elapsed() < Duration::from_millis(500), "a notice was taken after {:?}", asked.elapsed());
    let lines = wait_for_log(Level::Warn, smtp.port, 1).await;
    assert!(lines[0].ends_with("no answer within 3 s"), "{lines:?}");
    wait_for_log(Level::Error, smtp.port, 2).await;
    let opened = smtp.count("opened");
    smtp.wait_for_times("closed", opened).await;
}
