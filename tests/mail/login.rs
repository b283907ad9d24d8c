//! Passwords and encryption: a password goes to the right server only.

use serde_json::json;
use webots_fleet::session::mail::{NoticeKind, test_mail};

use super::own_process::trusted_authority;
use super::{LOGIN, config, nothing_unexpected, notice, start, with, with_password};
use crate::support::smtp::Smtp;

#[actix_rt::test]
async fn with_a_password_starttls_comes_before_the_login() {
    let Some(authority) = trusted_authority("with_a_password_starttls_comes_before_the_login") else { return };
    let options = [LOGIN, &["--tls", "starttls", "--authority", &authority]].concat();
    let mut smtp = Smtp::start(&options).await;
    for host in ["127.0.0.1", "localhost"] {
        let mailer = start(smtp.port, &with(&with_password("s3cret"), &json!({"mailServer": host})));
        mailer.send(notice("sim", NoticeKind::NotResponding)).await.unwrap();
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
    start(smtp.port, &keys).send(notice("sim", NoticeKind::NotResponding)).await.unwrap();
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
    let words = format!("127.0.0.1:{}: 535 5.7.8 ", smtp.port);
    assert!(error.starts_with(&words), "{error}");
    assert!(!error.contains("guess"), "{error}");
    smtp.wait_for("closed").await;
    assert_eq!(smtp.commands(), ["EHLO", "STARTTLS", "EHLO*", "AUTH*"]);
}

#[actix_rt::test]
async fn without_starttls_the_password_is_kept() {
    let mut smtp = Smtp::start(LOGIN).await;
    let error = test_mail(&config(smtp.port, &with_password("s3cret"))).await.unwrap_err().to_string();
    assert!(error.contains("STARTTLS is not supported on this server"), "{error}");
    smtp.wait_for("closed").await;
    assert_eq!(smtp.commands(), ["EHLO"]);
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
