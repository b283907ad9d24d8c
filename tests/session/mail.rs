//! From a failure to a mail: the built program, a stand-in that fails, a real SMTP server. `tests/python.sh` prepares it.

use std::collections::BTreeSet;

use serde_json::{Value, json};
use tokio::io::AsyncWriteExt;

use super::stand_in::{Manner, StandIn};
use super::{addresses, times_logged, until_states};
use crate::support::ports::dead_port;
use crate::support::program::{Builder, session_server};
use crate::support::smtp::Smtp;
use crate::support::{http, until};

fn mailing(servers: &[String], port: u16) -> Builder {
    let timing = json!({"answer": 2, "gather": 0.5, "flapping": 0.5, "mailRetry": 0.1, "mailAnswer": 10});
    session_server(servers).mails_to(port).set("timing", timing)
}

/// Appends received mails to `text` until it contains `words`.
async fn read_until(smtp: &mut Smtp, text: &mut String, words: &str) {
    while !text.contains(words) {
        let mail = smtp.mail().await;
        assert_eq!(
            (mail.field("from"), mail.recipients()),
            ("fleet@example.org", vec!["admin@example.org"])
        );
        assert_eq!(
            (mail.header("To"), mail.header("Auto-Submitted")),
            (vec!["admin@example.org"], vec!["auto-generated"])
        );
        assert_eq!((mail.header("Date").len(), mail.header("Message-ID").len()), (1, 1));
        assert!(mail.header("Content-Type")[0].starts_with("text/plain"), "{mail:?}");
        text.push_str(&mail.field("text").replace("\r\n", "\n"));
    }
}

#[actix_rt::test]
async fn every_kind_of_failure_is_mailed_and_so_is_its_end() {
    const DOWN: [&str; 2] = ["not responding", "working again"];
    const FULL: [&str; 2] = ["reached maximum load", "available again"];
    let evil = json!({"load": 100, "problem": "no display at :0\r\n.\r\nRCPT TO:<thief@example.com>\u{1b}[2J"});
    let failures = [
        (Manner::Reset, DOWN, "Reason:     no-answer"),
        (Manner::Reset, DOWN, "no connection"),
        (Manner::Hang, DOWN, "no answer within 2 s"),
        (Manner::Drip, DOWN, "no answer within 2 s"),
        (Manner::Body(500, Vec::new()), DOWN, "status 500"),
        (
            Manner::Status(json!({"load": "much"})),
            DOWN,
            "an answer that makes no sense",
        ),
        (Manner::Status(evil), DOWN, "no display at :0"),
        (Manner::idle(97.0, 10), FULL, "97.0%"),
        (Manner::status(7.0, 10, 10), FULL, "10 in 10 places"),
    ];
    let mut smtp = Smtp::start(&[]).await;
    let servers: Vec<StandIn> = failures.iter().map(|_| StandIn::start(Manner::idle(7.0, 10))).collect();
    let session = mailing(&addresses(&servers), smtp.port).start().await;
    until_states(&session, &["up"; 9]).await;
    for (server, (manner, ..)) in servers.iter().zip(&failures) {
        server.set(manner.clone());
    }
    for is_over in [false, true] {
        let mut text = String::new();
        for (server, (manner, events, words)) in servers.iter().zip(&failures) {
            let told = format!("{}: {}", server.address(), events[usize::from(is_over)]);
            read_until(&mut smtp, &mut text, &told).await;
            let entry = text.split(&told).nth(1).unwrap().split("\n\n").next().unwrap();
            assert!(
                entry.contains(words) || (is_over && *events == FULL),
                "{manner:?}: {entry}"
            );
            assert!(entry.contains("7.0%"), "the last known load of {manner:?}: {entry}");
        }
        assert!(
            text.contains(&format!("http://localhost:{}/monitor", session.port)),
            "{text}"
        );
        assert!(!text.contains("\nRCPT TO") && !text.contains('\u{1b}'), "{text}");
        for server in &servers {
            server.set(Manner::idle(7.0, 10));
        }
    }
    until("it is logged", async || {
        session.log().contains("mail sent by 127.0.0.1:")
    })
    .await;
}

#[actix_rt::test]
async fn a_thousand_servers_that_fail_together_are_one_mail() {
    let servers: Vec<String> = (1..=1000).map(|port| format!("127.0.0.1:{port}")).collect();
    let mut smtp = Smtp::start(&[]).await;
    let _session = mailing(&servers, smtp.port)
        .set("loadRefresh", 600)
        .set("timing.gather", 8)
        .start()
        .await;
    let mail = smtp.mail().await;
    assert_eq!(mail.subject(), "Simulation servers: 1000 not responding");
    let told = mail
        .field("text")
        .lines()
        .filter_map(|line| line.strip_suffix(": not responding"));
    assert_eq!(
        told.collect::<BTreeSet<_>>(),
        servers.iter().map(String::as_str).collect()
    );
}

#[actix_rt::test]
async fn a_mail_arrives_once_the_server_is_there() {
    let (reserved, port) = dead_port();
    let servers = [StandIn::start(Manner::Reset)];
    let session = mailing(&addresses(&servers), port).start().await;
    let tries = async |count: usize| {
        until("it is tried", async || {
            times_logged(&session, "mail not sent, it is tried again") >= count
        })
        .await;
    };
    tries(2).await;
    assert!(session.log().contains("Connection refused"), "{}", session.log());
    servers[0].set(Manner::idle(7.0, 10));
    tries(3).await;
    drop(reserved);
    let mut smtp = Smtp::start(&["--port", &port.to_string()]).await;
    read_until(
        &mut smtp,
        &mut String::new(),
        &format!("{}: working again", servers[0].address()),
    )
    .await;
    assert_eq!(times_logged(&session, "mail given up"), 0);
}

#[actix_rt::test]
async fn a_mail_is_given_up_with_one_line() {
    let (reserved, port) = dead_port();
    let servers = [StandIn::start(Manner::Reset)];
    let session = mailing(&addresses(&servers), port)
        .set("timing.mailPatience", 0.5)
        .start()
        .await;
    let address = servers[0].address();
    let line = format!("mail given up (Simulation server not responding: {address}): ");
    until("it is given up", async || session.log().contains(&line)).await;
    drop(reserved);
    let mut smtp = Smtp::start(&["--port", &port.to_string()]).await;
    servers[0].set(Manner::idle(7.0, 10));
    assert_eq!(
        smtp.mail().await.subject(),
        format!("Simulation server working again: {address}")
    );
    assert_eq!(times_logged(&session, "mail given up"), 1);
}

#[actix_rt::test]
async fn a_silent_server_holds_up_nobody_and_leaves_nothing_open() {
    let mut smtp = Smtp::start(&["--hang", "greeting"]).await;
    let servers = [StandIn::start(Manner::Reset)];
    let builder = mailing(&addresses(&servers), smtp.port)
        .set("timing.mailAnswer", 2)
        .set("timing.mailPatience", 2);
    let session = builder.start().await;
    smtp.wait_for("opened").await;
    servers[0].set(Manner::idle(7.0, 10));
    until_states(&session, &["up"]).await;
    assert_eq!(http::get(&session.url("/session")).await.text(), servers[0].url());
    assert_eq!(
        times_logged(&session, "no answer within 2 s"),
        0,
        "it waited for the mail"
    );
    until("it is given up", async || times_logged(&session, "mail given up") == 1).await;
    assert!(session.log().contains("no answer within 2 s"), "{}", session.log());
    let opened = smtp.count("opened");
    smtp.wait_for_times("closed", opened).await;
}

#[actix_rt::test]
async fn a_line_without_end_fills_no_memory() {
    const MOST: usize = 512 << 20;
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    actix_rt::spawn(async move {
        while let Ok((mut client, _)) = listener.accept().await {
            let line = vec![b'2'; 64 << 10];
            for _ in 0..MOST / line.len() {
                if client.write_all(&line).await.is_err() {
                    break;
                }
            }
        }
    });
    let session = mailing(&addresses(&[StandIn::start(Manner::Reset)]), port)
        .start()
        .await;
    let problem = format!("127.0.0.1:{port}: ");
    until("the mail has failed", async || session.log().contains(&problem)).await;
    let status = procfs::process::Process::new(session.pid()).unwrap().status().unwrap();
    let most = status.vmhwm.unwrap() << 10;
    assert!(most < 128 << 20, "{most} bytes");
    let told = format!("{problem}it has sent more than 65536 bytes");
    assert!(session.log().contains(&told), "{}", session.log());
}

/// The exit code and output of a session server with this option and these keys, which trusts only the authorities in
/// the file `trusted`.
pub async fn says(option: &str, keys: &Value, trusted: &str) -> (Option<i32>, String) {
    let mut config = json!({"port": 1, "ssl": false, "simulationServers": [], "server": "localhost"});
    config
        .as_object_mut()
        .unwrap()
        .extend(keys.as_object().unwrap().clone());
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), config.to_string()).unwrap();
    let mut command = tokio::process::Command::new(env!("CARGO_BIN_EXE_session-server"));
    let output = command
        .arg(file.path())
        .arg(option)
        .env("SSL_CERT_FILE", trusted)
        .output()
        .await
        .unwrap();
    (
        output.status.code(),
        String::from_utf8([output.stdout, output.stderr].concat()).unwrap(),
    )
}

/// Keys that send mail to this port of this machine, and `more`.
fn keys(port: u16, more: &Value) -> Value {
    let mut keys = json!({"administrator": "Admin <admin@example.org>", "mailServer": "127.0.0.1", "mailServerPort": port,
        "mailSender": "fleet@example.org", "mailSenderUser": "fleet"});
    keys.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    keys
}

#[actix_rt::test]
async fn a_test_mail_says_how_it_went() {
    for (options, words) in [
        ("--refuse recipient", "550 5.1.1 no such user here"),
        ("--refuse mail", "451 4.3.0 try again later"),
        ("--login fleet:s3cret", "530 5.7.0 Authentication required"),
    ] {
        let smtp = Smtp::start(&options.split(' ').collect::<Vec<_>>()).await;
        let (code, said) = says("--test-mail", &keys(smtp.port, &json!({})), "/dev/null").await;
        assert!(
            code == Some(1) && said.contains(&format!("127.0.0.1:{}: {words}", smtp.port)),
            "{said}"
        );
    }
    for key in ["administrator", "mailServer", "mailSender"] {
        let (code, said) = says("--test-mail", &keys(25, &json!({ key: null })), "/dev/null").await;
        assert!(
            code == Some(1) && said.contains(&format!("no mail is sent: {key} is not set")),
            "{said}"
        );
    }
    let mut smtp = Smtp::start(&[]).await;
    let (code, said) = says("--test-mail", &keys(smtp.port, &json!({})), "/dev/null").await;
    assert_eq!(
        (code, said),
        (
            Some(0),
            format!("127.0.0.1:{} took a test: 2.0.0 OK: queued\n", smtp.port)
        )
    );
    let mail = smtp.mail().await;
    assert_eq!(mail.subject(), "Test of the session server's notifications");
    assert_eq!(mail.header("To"), ["Admin <admin@example.org>"]);
    assert!(mail.field("text").contains("Nothing has happened"), "{mail:?}");
}

#[actix_rt::test]
async fn a_password_is_sent_to_a_trusted_server_only() {
    let folder = tempfile::tempdir().unwrap();
    let authority = folder.path().join("authority.pem").to_str().unwrap().to_owned();
    let right = json!({"mailSenderPassword": "s3cret"});
    let wrong = json!({"mailSenderPassword": "guess"});
    let implicit = json!({"mailSenderPassword": "s3cret", "mailServerImplicitTls": true});
    let by_name = json!({"mailSenderPassword": "s3cret", "mailServer": "localhost"});
    let sent = " took a test";
    let untrusted = "certificate is not trusted";
    for (options, more, words, commands) in [
        (
            "starttls --authority",
            &right,
            sent,
            "EHLO STARTTLS EHLO* AUTH* MAIL* RCPT* DATA* QUIT*",
        ),
        (
            "starttls --authority",
            &by_name,
            sent,
            "EHLO STARTTLS EHLO* AUTH* MAIL* RCPT* DATA* QUIT*",
        ),
        (
            "implicit --authority",
            &implicit,
            sent,
            "EHLO* AUTH* MAIL* RCPT* DATA* QUIT*",
        ),
        (
            "starttls --authority",
            &wrong,
            ": 535 5.7.8 ",
            "EHLO STARTTLS EHLO* AUTH*",
        ),
        ("none", &right, "STARTTLS is not supported on this server", "EHLO"),
        ("starttls", &right, untrusted, "EHLO STARTTLS"),
        ("implicit", &implicit, untrusted, ""),
        (
            "starttls --names other.example.org --authority",
            &right,
            "not valid for name",
            "EHLO STARTTLS",
        ),
    ] {
        let is_trusted = options.ends_with("--authority");
        let all = ["--login", "fleet:s3cret", "--tls"]
            .into_iter()
            .chain(options.split(' '));
        let mut smtp = Smtp::start(&all.chain(is_trusted.then_some(&*authority)).collect::<Vec<_>>()).await;
        let trusted = if is_trusted { &authority } else { "/dev/null" };
        let (_, said) = says("--test-mail", &keys(smtp.port, more), trusted).await;
        assert!(said.contains(words) && !said.contains("guess"), "{options:?}: {said}");
        // Python's asyncio doesn't report a connection if TLS fails at the first byte.
        if !commands.is_empty() {
            smtp.wait_for("closed").await;
        }
        assert_eq!(smtp.commands().join(" "), commands, "{options:?}");
    }
}
