//! Passwords and encryption: a password goes to the right server only.

use std::process::Command;

use serde_json::{Value, json};

use super::{LOGIN, config};
use crate::support::smtp::Smtp;

/// What `--test-mail` prints with these keys, where only the authority of the SMTP server is trusted, or none.
async fn tested(smtp: &Smtp, keys: &Value, authority: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("config.json");
    std::fs::write(&file, config(smtp.port, keys).to_string()).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_session-server"));
    command.arg(file).arg("--test-mail").env("SSL_CERT_FILE", authority);
    let output = actix_rt::task::spawn_blocking(move || command.output().unwrap()).await.unwrap();
    String::from_utf8([output.stdout, output.stderr].concat()).unwrap()
}

#[actix_rt::test]
async fn a_password_goes_over_an_encrypted_connection_to_a_trusted_server_only() {
    const TRUSTED: &str = "--authority";
    let folder = tempfile::tempdir().unwrap();
    let authority = folder.path().join("authority.pem").to_str().unwrap().to_owned();
    let (right, wrong) = (json!({"mailSenderPassword": "s3cret"}), json!({"mailSenderPassword": "guess"}));
    let implicit = json!({"mailSenderPassword": "s3cret", "mailServerImplicitTls": true});
    let by_name = json!({"mailSenderPassword": "s3cret", "mailServer": "localhost"});
    let sent = " took a test";
    let untrusted = "certificate is not trusted";
    let table: [(&[&str], &Value, &str, &[&str]); 8] = [
        (
            &["--tls", "starttls", TRUSTED],
            &right,
            sent,
            &["EHLO", "STARTTLS", "EHLO*", "AUTH*", "MAIL*", "RCPT*", "DATA*", "QUIT*"],
        ),
        (
            &["--tls", "starttls", TRUSTED],
            &by_name,
            sent,
            &["EHLO", "STARTTLS", "EHLO*", "AUTH*", "MAIL*", "RCPT*", "DATA*", "QUIT*"],
        ),
        (&["--tls", "implicit", TRUSTED], &implicit, sent, &["EHLO*", "AUTH*", "MAIL*", "RCPT*", "DATA*", "QUIT*"]),
        (&["--tls", "starttls", TRUSTED], &wrong, ": 535 5.7.8 ", &["EHLO", "STARTTLS", "EHLO*", "AUTH*"]),
        (&[], &right, "STARTTLS is not supported on this server", &["EHLO"]),
        (&["--tls", "starttls"], &right, untrusted, &["EHLO", "STARTTLS"]),
        (&["--tls", "implicit"], &implicit, untrusted, &[]),
        (
            &["--tls", "starttls", "--names", "other.example.org", TRUSTED],
            &right,
            "not valid for name",
            &["EHLO", "STARTTLS"],
        ),
    ];
    for (options, keys, words, commands) in table {
        let trusted: &[&str] = if options.contains(&TRUSTED) { &[&authority] } else { &[] };
        let mut smtp = Smtp::start(&[LOGIN, options, trusted].concat()).await;
        let said = tested(&smtp, keys, if trusted.is_empty() { "/dev/null" } else { &authority }).await;
        assert!(said.contains(words) && !said.contains("guess"), "{options:?}: {said}");
        // Python's asyncio doesn't tell of a connection whose encryption fails from the first byte.
        if !commands.is_empty() {
            smtp.wait_for("closed").await;
        }
        assert_eq!(smtp.commands(), commands, "{options:?}");
    }
}
