//! Mails to the administrator, through a real SMTP server (aiosmtpd) on loopback. `tests/python.sh` prepares it.

mod log;
mod own_process;

use std::time::{Duration, Instant, SystemTime};

use ::log::Level;
use actix::Addr;
use serde_json::{Value, json};
use webots_fleet::session::config::SessionConfig;
use webots_fleet::session::mail::{self, Event, Mailer, Notice, test_mail};
use webots_fleet::shared::config::{Configuration, load};
use webots_fleet::shared::domain::Load;

use self::log::{keep_log, logged, wait_for_log};
use self::own_process::trusted_authority;
use crate::support::SOON;
use crate::support::ports::dead_port;
use crate::support::smtp::Smtp;

const LOGIN: &[&str] = &["--login", "fleet:s3cret"];

/// A configuration for mails to this port of this machine; `more` replaces and adds keys.
fn config(port: u16, more: &Value) -> SessionConfig {
    let mut keys = json!({
        "server": "session.example.org",
        "ssl": true,
        "port": 1999,
        "simulationServers": [],
        "administrator": "Admin <admin@example.org>",
        "mailServer": "127.0.0.1",
        "mailServerPort": port,
        "mailSender": "fleet@example.org",
        "timing": {"gather": 0.1, "flapping": 0.6, "mailRetry": 0.1, "mailPatience": 60, "mailAnswer": 10},
    });
    for (key, value) in more.as_object().unwrap() {
        match (keys.get_mut(key), value) {
            (Some(Value::Object(old)), Value::Object(new)) => old.extend(new.clone()),
            _ => keys[key] = value.clone(),
        }
    }
    let mut config: SessionConfig = serde_json::from_value(keys).unwrap();
    assert_eq!(config.complete(std::path::Path::new("main.json")).unwrap(), [""; 0]);
    config
}

fn with_password(password: &str) -> Value {
    json!({"mailSenderUser": "fleet", "mailSenderPassword": password})
}

fn with(keys: &Value, more: &Value) -> Value {
    let mut keys = keys.as_object().unwrap().clone();
    keys.extend(more.as_object().unwrap().clone());
    Value::Object(keys)
}

fn start(port: u16, more: &Value) -> Addr<Mailer> {
    keep_log();
    mail::start(&config(port, more)).expect("mails are on")
}

fn notice(host: &str, event: Event) -> Notice {
    let server = format!("{host}:2000");
    let error = (event == Event::NotResponding).then(|| "connection refused".to_owned());
    Notice { server, event, load: Load::try_from(97.25).ok(), error, at: SystemTime::now() }
}

fn nothing_unexpected(port: u16) {
    assert_eq!((logged(Level::Warn, port), logged(Level::Error, port)), (vec![], vec![]));
}

#[actix_rt::test]
async fn a_notice_becomes_a_mail_in_text_and_html() {
    let mut smtp = Smtp::start(&[]).await;
    let mailer = start(smtp.port, &json!({}));
    mailer.send(notice("sim1.example.org", Event::NotResponding)).await.unwrap();
    let mail = smtp.mail().await;
    assert_eq!(mail.field("from"), "fleet@example.org");
    assert_eq!(mail.recipients(), ["admin@example.org"]);
    assert_eq!(mail.header("To"), ["Admin <admin@example.org>"]);
    assert_eq!(mail.header("Auto-Submitted"), ["auto-generated"]);
    assert_eq!((mail.header("Date").len(), mail.header("Message-ID").len()), (1, 1));
    assert_eq!(mail.subject(), "Simulation server not responding: sim1.example.org:2000");
    let year = jiff::Timestamp::now().strftime("%Y-").to_string();
    for body in [mail.field("text"), mail.field("html")] {
        let parts = ["sim1.example.org:2000", "not responding", "97.2%", "connection refused", year.as_str()];
        for part in parts.into_iter().chain(["https://session.example.org/1999/monitor"]) {
            assert!(body.contains(part), "no {part:?} in {body}");
        }
    }
    wait_for_log(Level::Info, smtp.port, 1).await;
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn each_event_has_its_subject() {
    let mut smtp = Smtp::start(&[]).await;
    let mailer = start(smtp.port, &json!({}));
    for (host, event, subject) in [
        ("a", Event::NotResponding, "Simulation server not responding: a:2000"),
        ("b", Event::WorkingAgain, "Simulation server working again: b:2000"),
        ("c", Event::MaximumLoad, "Simulation server reached maximum load: c:2000"),
        ("d", Event::AvailableAgain, "Simulation server available again: d:2000"),
        ("dns+e", Event::LookupFails, "Lookup of simulation servers failing: dns+e:2000"),
        ("dns+f", Event::LookupWorks, "Lookup of simulation servers working again: dns+f:2000"),
    ] {
        mailer.send(notice(host, event)).await.unwrap();
        assert_eq!(smtp.mail().await.subject(), subject);
    }
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn a_thousand_servers_that_fail_together_are_one_mail() {
    let mut smtp = Smtp::start(&[]).await;
    let mailer = start(smtp.port, &json!({"timing": {"gather": 3}}));
    for number in 0..1_000 {
        mailer.do_send(notice(&format!("sim{number}"), Event::NotResponding));
    }
    let mail = smtp.mail().await;
    assert_eq!(mail.subject(), "1000 simulation servers not responding");
    for server in ["sim0:2000", "sim500:2000", "sim999:2000"] {
        assert!(mail.field("text").contains(server), "no {server}");
    }
    // The next mail is the next notice's: nothing else was on its way.
    mailer.send(notice("other", Event::MaximumLoad)).await.unwrap();
    assert_eq!(smtp.mail().await.subject(), "Simulation server reached maximum load: other:2000");
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn a_flapping_server_is_one_mail_in_its_time_with_a_count() {
    let mut smtp = Smtp::start(&[]).await;
    let mailer = start(smtp.port, &json!({"timing": {"flapping": 2}}));
    let first = Instant::now();
    mailer.send(notice("sim", Event::NotResponding)).await.unwrap();
    assert_eq!(smtp.mail().await.subject(), "Simulation server not responding: sim:2000");
    for turn in 0..9 {
        let event = if turn % 2 == 0 { Event::WorkingAgain } else { Event::NotResponding };
        mailer.do_send(notice("sim", event));
    }
    let mail = smtp.mail().await;
    assert!(first.elapsed() > Duration::from_secs(2), "the second mail came after {:?}", first.elapsed());
    assert_eq!(mail.subject(), "Simulation server working again: sim:2000");
    for body in [mail.field("text"), mail.field("html")] {
        assert!(body.contains("8 earlier notices about this server were held back"), "{body}");
        assert!(body.contains("connection refused"), "no last error in {body}");
    }
    assert_eq!(smtp.count("mail"), 2);
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn nothing_from_outside_gets_into_the_headers_or_the_html() {
    let mut smtp = Smtp::start(&[]).await;
    let mailer = start(smtp.port, &json!({}));
    let mut evil = notice("sim\r\nBcc: thief@example.com\r\n\r\nbody", Event::NotResponding);
    evil.error = Some("<script>alert(1)</script>\r\n.\r\nRCPT TO:<thief@example.com>\u{1b}[2J".to_owned());
    mailer.send(evil).await.unwrap();
    let mail = smtp.mail().await;
    assert_eq!(mail.recipients(), ["admin@example.org"]);
    assert!(mail.header("Bcc").is_empty(), "{mail:?}");
    assert_eq!(mail.subject(), "Simulation server not responding: sim  Bcc: thief@example.com    body:2000");
    assert!(!mail.field("html").contains("<script>"), "{mail:?}");
    assert!(!mail.field("text").contains('\u{1b}'), "{mail:?}");
    wait_for_log(Level::Info, smtp.port, 1).await;
    assert_eq!(smtp.commands(), ["EHLO", "MAIL", "RCPT", "DATA", "QUIT"]);
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn with_a_password_starttls_comes_before_the_login() {
    let Some(authority) = trusted_authority("with_a_password_starttls_comes_before_the_login") else { return };
    let options = [LOGIN, &["--tls", "starttls", "--authority", &authority]].concat();
    let mut smtp = Smtp::start(&options).await;
    for host in ["127.0.0.1", "localhost"] {
        let mailer = start(smtp.port, &with(&with_password("s3cret"), &json!({"mailServer": host})));
        mailer.send(notice("sim", Event::NotResponding)).await.unwrap();
        assert!(smtp.mail().await.is_encrypted());
        smtp.wait_for("closed").await;
        assert_eq!(smtp.commands(), ["EHLO", "STARTTLS", "EHLO*", "AUTH*", "MAIL*", "RCPT*", "DATA*", "QUIT*"]);
        smtp.told.clear();
    }
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn a_server_may_encrypt_from_the_first_byte() {
    let Some(authority) = trusted_authority("a_server_may_encrypt_from_the_first_byte") else { return };
    let options = [LOGIN, &["--tls", "implicit", "--authority", &authority]].concat();
    let mut smtp = Smtp::start(&options).await;
    let keys = with(&with_password("s3cret"), &json!({"mailServerImplicitTls": true}));
    start(smtp.port, &keys).send(notice("sim", Event::NotResponding)).await.unwrap();
    assert!(smtp.mail().await.is_encrypted());
    smtp.wait_for("closed").await;
    assert_eq!(smtp.commands(), ["EHLO*", "AUTH*", "MAIL*", "RCPT*", "DATA*", "QUIT*"]);
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn a_wrong_password_is_said_in_words_and_not_sent_in_plain() {
    let Some(authority) = trusted_authority("a_wrong_password_is_said_in_words_and_not_sent_in_plain") else { return };
    let options = [LOGIN, &["--tls", "starttls", "--authority", &authority]].concat();
    let mut smtp = Smtp::start(&options).await;
    let error = test_mail(&config(smtp.port, &with_password("guess"))).await.unwrap_err().to_string();
    let words = format!("127.0.0.1:{}: wrong user or password, logging in as fleet: 535 5.7.8 ", smtp.port);
    assert!(error.starts_with(&words), "{error}");
    assert!(!error.contains("guess"), "{error}");
    smtp.wait_for("closed").await;
    assert_eq!(smtp.commands(), ["EHLO", "STARTTLS", "EHLO*", "AUTH*", "QUIT*"]);
}

#[actix_rt::test]
async fn without_starttls_the_password_is_kept() {
    let mut smtp = Smtp::start(LOGIN).await;
    let error = test_mail(&config(smtp.port, &with_password("s3cret"))).await.unwrap_err().to_string();
    assert!(error.contains("offers no STARTTLS"), "{error}");
    smtp.wait_for("closed").await;
    assert_eq!(smtp.commands(), ["EHLO", "QUIT"]);
}

#[actix_rt::test]
async fn an_unknown_authority_does_not_get_the_password() {
    for tls in ["starttls", "implicit"] {
        let mut smtp = Smtp::start(&[LOGIN, &["--tls", tls]].concat()).await;
        let keys = with(&with_password("s3cret"), &json!({"mailServerImplicitTls": tls == "implicit"}));
        let error = test_mail(&config(smtp.port, &keys)).await.unwrap_err().to_string();
        assert!(error.contains("certificate is not trusted") && error.contains("UnknownIssuer"), "{error}");
        // Python's asyncio doesn't tell of a connection whose encryption fails from the first byte.
        let expected: &[&str] = if tls == "starttls" { &["EHLO", "STARTTLS"] } else { &[] };
        if tls == "starttls" {
            smtp.wait_for("closed").await;
        }
        assert_eq!(smtp.commands(), expected);
    }
}

#[actix_rt::test]
async fn a_certificate_for_another_name_is_not_trusted() {
    let Some(authority) = trusted_authority("a_certificate_for_another_name_is_not_trusted") else { return };
    let other = ["--tls", "starttls", "--authority", &authority, "--names", "other.example.org"];
    let mut smtp = Smtp::start(&[LOGIN, &other].concat()).await;
    let error = test_mail(&config(smtp.port, &with_password("s3cret"))).await.unwrap_err().to_string();
    assert!(error.contains("certificate is not trusted") && error.contains("not valid for name"), "{error}");
    smtp.wait_for("closed").await;
    assert_eq!(smtp.commands(), ["EHLO", "STARTTLS"]);
}

#[actix_rt::test]
async fn what_a_server_refuses_is_named() {
    for (options, words) in [
        (&["--refuse", "recipient"], "refuses the recipient admin@example.org: 550 5.1.1 no such user here"),
        (&["--refuse", "mail"], "refuses the mail: 451 4.3.0 try again later"),
        (&["--login", "fleet:s3cret"], "refuses the sender fleet@example.org: 530 5.7.0 Authentication required"),
    ] {
        let smtp = Smtp::start(options).await;
        let error = test_mail(&config(smtp.port, &json!({}))).await.unwrap_err().to_string();
        assert_eq!(error, format!("127.0.0.1:{}: {words}", smtp.port));
    }
}

#[actix_rt::test]
async fn a_test_mail_says_how_it_went() {
    let mut smtp = Smtp::start(&[]).await;
    let said = test_mail(&config(smtp.port, &json!({}))).await.unwrap();
    let port = smtp.port;
    let words = format!("127.0.0.1:{port} (not encrypted) took a mail for admin@example.org: 2.0.0 OK: queued");
    assert_eq!(said, words);
    let mail = smtp.mail().await;
    assert_eq!(mail.subject(), "Test of the session server's notifications");
    assert!(mail.field("text").contains("Nothing has happened"), "{mail:?}");
}

#[actix_rt::test]
async fn a_dead_host_is_named() {
    let (_reserved, dead) = dead_port();
    let error = test_mail(&config(dead, &json!({}))).await.unwrap_err().to_string();
    assert!(error.starts_with(&format!("127.0.0.1:{dead}: can't connect: Connection refused")), "{error}");
    // A label of 64 letters can't be in any name server, so that none is asked.
    let nobody = format!("{}.example.org", "a".repeat(64));
    let error = test_mail(&config(25, &json!({"mailServer": nobody}))).await.unwrap_err().to_string();
    assert!(error.starts_with(&format!("{nobody}:25: the name can't be resolved: ")), "{error}");
}

#[actix_rt::test]
async fn a_mail_arrives_once_the_server_is_there() {
    let (reserved, port) = dead_port();
    let mailer = start(port, &json!({}));
    mailer.send(notice("a", Event::NotResponding)).await.unwrap();
    let failures = wait_for_log(Level::Warn, port, 2).await;
    assert!(failures[0].contains("Connection refused"), "{failures:?}");
    mailer.send(notice("b", Event::NotResponding)).await.unwrap();
    mailer.send(notice("a", Event::WorkingAgain)).await.unwrap();
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
    mailer.send(notice("lost", Event::NotResponding)).await.unwrap();
    let lines = wait_for_log(Level::Error, port, 1).await;
    assert!(lines[0].starts_with("mail given up after 0.5 s (lost:2000 not responding): "), "{lines:?}");
    drop(reserved);
    let mut smtp = Smtp::start(&["--port", &port.to_string()]).await;
    mailer.send(notice("new", Event::NotResponding)).await.unwrap();
    assert_eq!(smtp.mail().await.subject(), "Simulation server not responding: new:2000");
    assert_eq!(logged(Level::Error, port).len(), 1);
}

#[actix_rt::test]
async fn what_is_refused_for_good_is_tried_seldom_and_given_up() {
    let mut smtp = Smtp::start(&["--refuse", "recipient"]).await;
    let mailer = start(smtp.port, &json!({"timing": {"mailRetry": 0.01, "mailPatience": 1.2}}));
    mailer.send(notice("sim", Event::NotResponding)).await.unwrap();
    let lines = wait_for_log(Level::Error, smtp.port, 1).await;
    assert!(lines[0].contains("refuses the recipient"), "{lines:?}");
    let tries = smtp.count("opened");
    assert!((2..=8).contains(&tries), "{tries} tries; every 0.2 s for 1.2 s was asked for");
}

#[actix_rt::test]
async fn a_silent_server_holds_up_nobody_and_leaves_nothing_open() {
    let mut smtp = Smtp::start(&["--hang", "greeting"]).await;
    let mailer = start(smtp.port, &json!({"timing": {"mailAnswer": 1, "mailPatience": 1.5}}));
    mailer.send(notice("sim", Event::NotResponding)).await.unwrap();
    smtp.wait_for("opened").await;
    let asked = Instant::now();
    mailer.send(notice("other", Event::NotResponding)).await.unwrap();
    assert!(asked.elapsed() < Duration::from_millis(500), "a notice was taken after {:?}", asked.elapsed());
    let lines = wait_for_log(Level::Warn, smtp.port, 1).await;
    assert!(lines[0].ends_with("no answer within 1 s"), "{lines:?}");
    wait_for_log(Level::Error, smtp.port, 2).await;
    let opened = smtp.count("opened");
    smtp.wait_for_times("closed", opened).await;
}

#[actix_rt::test]
async fn a_server_that_sends_a_line_without_an_end_is_cut_off() {
    use tokio::io::AsyncWriteExt;
    let listener = tokio::net::TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let flood = actix_rt::spawn(async move {
        let (mut connection, _) = listener.accept().await.unwrap();
        let mut sent = 0;
        while connection.write_all(&[b'2'; 64 * 1024]).await.is_ok() {
            sent += 64 * 1024;
        }
        sent
    });
    let error = test_mail(&config(port, &json!({}))).await.unwrap_err().to_string();
    let words = "the connection broke: it sends more than 1024 KiB";
    assert_eq!(error, format!("127.0.0.1:{port}: {words}"));
    let sent = tokio::time::timeout(SOON, flood).await.expect("the connection is closed").unwrap();
    // What the system keeps of a connection comes on top.
    assert!(sent < 32 * 1024 * 1024, "{sent} bytes were taken");
}

#[actix_rt::test]
async fn a_server_that_is_silent_at_the_end_has_the_mail_once() {
    let mut smtp = Smtp::start(&["--hang", "quit"]).await;
    let mailer = start(smtp.port, &json!({"timing": {"mailAnswer": 0.5}}));
    mailer.send(notice("sim", Event::NotResponding)).await.unwrap();
    smtp.mail().await;
    wait_for_log(Level::Info, smtp.port, 1).await;
    smtp.wait_for("closed").await;
    mailer.send(notice("other", Event::NotResponding)).await.unwrap();
    assert_eq!(smtp.mail().await.subject(), "Simulation server not responding: other:2000");
    nothing_unexpected(smtp.port);
}

#[actix_rt::test]
async fn without_one_of_the_three_keys_mails_are_off() {
    for key in ["administrator", "mailServer", "mailSender"] {
        let mut config = config(25, &json!({}));
        match key {
            "administrator" => config.administrator = None,
            "mailServer" => config.mail_server = None,
            _ => config.mail_sender = None,
        }
        assert!(mail::start(&config).is_none(), "there is a mailer without {key}");
        let error = test_mail(&config).await.unwrap_err().to_string();
        assert_eq!(error, format!("notifications are off: {key} is not set"));
    }
}

#[test]
fn a_wrong_address_is_a_fault_of_the_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("wrong.json");
    for (key, value) in [
        ("administrator", "nobody"),
        ("administrator", "a@example.org\r\nBcc: b@example.org"),
        ("mailSender", "a@example.org, b@example.org"),
        ("mailServer", "smtp.example.org:587"),
    ] {
        let keys = json!({"server": "localhost", "port": 1999, "simulationServers": [], key: value});
        std::fs::write(&file, keys.to_string()).unwrap();
        let error = load::<SessionConfig>(&file).unwrap_err().to_string();
        assert!(error.starts_with(&format!("{}: {key}: {value:?} is no ", file.display())), "{error}");
    }
    let keys =
        json!({"server": "localhost", "port": 1999, "simulationServers": [], "administrator": "", "mailSender": null});
    std::fs::write(&file, keys.to_string()).unwrap();
    assert_eq!(load::<SessionConfig>(&file).unwrap().warnings, [""; 0]);
}
