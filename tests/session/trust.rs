//! Certificates of simulation servers: of a lab's own authority, and those that can't be trusted.

use std::net::TcpListener;
use std::path::Path;

use rcgen::CertificateParams;
use serde_json::Value;

use crate::support::authority::{Authority, Certificate};
use crate::support::listener::serve;
use crate::support::program::{Builder, Server, session_server};
use crate::support::smtp::Smtp;
use crate::support::until;

/// A session server that reaches a simulation server through a web server at this port.
fn watcher(port: u16) -> Builder {
    session_server(&[format!("localhost:{port}/2000")]).set("ssl", true).set("portRewrite", true)
}

/// The same, where the web server has this certificate, and the certificates of a file are trusted.
fn watching(certificate: &Certificate, trusted: &Path) -> Builder {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    serve(listener, Some(certificate.server()), |request| {
        let (status, content) = if request.path() == "/2000/load" { ("200 OK", "12.5") } else { ("404 Not Found", "") };
        Some((status.to_owned(), content.into()))
    });
    watcher(port).env("SSL_CERT_FILE", trusted.to_str().unwrap())
}

/// What is told of the simulation server, once it is in this state.
async fn until_it_is(session: &Server, state: &str) -> Value {
    let server = async || session.status().await["servers"][0].clone();
    until(&format!("the simulation server is {state}"), async || server().await["state"] == state).await;
    server().await
}

/// What the session server says of a server with this certificate, when it trusts this authority: the same in its
/// answers, its log, its page and its mail.
async fn verdict(certificate: &Certificate, trusted: &Authority) -> String {
    let mut smtp = Smtp::start(&[]).await;
    let session = watching(certificate, &trusted.file()).mails_to(smtp.port).set("timing.gather", 0.1).start().await;
    let error = until_it_is(&session, "down").await["error"].as_str().unwrap().to_owned();
    assert!(session.log().contains(&error), "{error} is not in the log");
    assert!(session.monitor().await.contains("its certificate is not trusted"));
    let mail = smtp.mail().await;
    let told = mail.field("text").split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(told.contains(&error), "{error} is not in the mail: {told}");
    error.strip_prefix("no connection: its certificate is not trusted: ").unwrap_or(&error).to_owned()
}

#[actix_rt::test]
async fn a_certificate_that_is_not_trusted_is_named_with_the_reason() {
    let (lab, other) = (Authority::new(), Authority::new());
    let dated = |from: i32, until: i32| {
        move |params: &mut CertificateParams| {
            params.not_before = rcgen::date_time_ymd(from, 1, 1);
            params.not_after = rcgen::date_time_ymd(until, 1, 1);
        }
    };
    let table = [
        (lab.issue(&["localhost"]), &other, "UnknownIssuer"),
        (lab.issue_as(&["localhost"], dated(2010, 2011)), &lab, "certificate expired"),
        (lab.issue_as(&["localhost"], dated(2400, 2401)), &lab, "certificate not valid yet"),
        (lab.issue(&["lab.example"]), &lab, "certificate not valid for name \"localhost\""),
    ];
    for (certificate, trusted, words) in &table {
        let said = verdict(certificate, trusted).await;
        assert!(said.starts_with(words), "{said:?} is not {words:?}");
    }
}

#[actix_rt::test]
async fn a_certificate_that_has_signed_itself_is_trusted_where_it_is_in_the_trust_store() {
    let folder = tempfile::tempdir().unwrap();
    let signed = |name: &str, signs_others| Certificate::self_signed(folder.path(), name, signs_others);
    let (own, other, authority) = (signed("own", false), signed("other", false), signed("authority", true));
    let watch = async |certificate: &Certificate, trusted: &Certificate, state: &str| {
        until_it_is(&watching(certificate, &trusted.chain).start().await, state).await
    };
    assert_eq!(watch(&own, &own, "up").await["load"], 12.5);
    // Another one for the same name is not that one, nor is one that may sign others, as those of `openssl req -x509` may.
    for (certificate, trusted, words) in
        [(&own, &other, "its certificate is not trusted"), (&authority, &authority, "CaUsedAsEndEntity")]
    {
        let error = watch(certificate, trusted, "down").await["error"].to_string();
        assert!(error.contains(words), "{error}");
    }
}

#[actix_rt::test]
async fn a_lab_s_own_authority_is_trusted_and_authorities_that_cant_be_read_cost_only_their_servers() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("broken.pem");
    let lab = Authority::new();
    let certificate = lab.issue(&["localhost"]);
    let good = std::fs::read_to_string(lab.file()).unwrap();
    let broken = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n";
    std::fs::write(&file, format!("{broken}{good}-----BEGIN CERTIFICATE-----\n*\n-----END CERTIFICATE-----\n"))
        .unwrap();
    let nowhere = Path::new("/nowhere.pem");
    for (trusted, state, words) in [
        (&*lab.file(), "up", "listens on"),
        (&file, "up", "can't be"),
        (nowhere, "down", "no certificate authority is known"),
    ] {
        let builder = watching(&certificate, trusted);
        let builder = if trusted == nowhere { builder.env("SSL_CERT_DIR", "/nowhere") } else { builder };
        let session = builder.start().await;
        let server = until_it_is(&session, state).await;
        assert!(state == "down" || server["load"] == 12.5, "{server}");
        assert!(session.log().contains(words), "{}", session.log());
    }
}

#[actix_rt::test]
async fn a_server_without_https_is_named_as_such() {
    let plain = session_server(&[]).start().await;
    let session = watcher(plain.port).start().await;
    let error = until_it_is(&session, "down").await["error"].clone();
    assert_eq!(error, "no connection: it does not speak https there");
}
