//! Certificates of simulation servers: signed by a lab's own authority, and untrusted ones.

use std::net::TcpListener;
use std::path::Path;

use rcgen::CertificateParams;
use serde_json::Value;

use super::until_states;
use crate::support::authority::{Authority, Certificate};
use crate::support::listener::serve;
use crate::support::program::{Builder, Server, session_server};

/// A simulation server behind a web server with this certificate, as session servers know it.
fn simulation_server(certificate: &Certificate) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    serve(listener, Some(certificate.server()), |request| {
        let (status, content) = if request.path() == "/2000/load" {
            ("200 OK", "12.5")
        } else {
            ("404 Not Found", "")
        };
        Some((status.to_owned(), content.into()))
    });
    format!("localhost:{port}/2000")
}

/// A session server that trusts the certificates in a file.
fn watching(servers: &[String], trusted: &Path) -> Builder {
    let builder = session_server(servers).set("ssl", true).set("portRewrite", true);
    builder.env("SSL_CERT_FILE", trusted.to_str().unwrap())
}

/// Waits until the first simulation server is up and the others are down; returns the errors of these.
async fn errors_after_the_first(session: &Server, count: usize) -> Vec<String> {
    until_states(session, &[vec!["up"], vec!["down"; count]].concat()).await;
    let servers = session.status().await["servers"].as_array().unwrap().clone();
    assert_eq!(servers[0]["load"], 12.5);
    let error = |server: &Value| server["error"].as_str().unwrap().to_owned();
    servers.iter().skip(1).map(error).collect()
}

#[actix_rt::test]
async fn a_certificate_that_is_not_trusted_is_named_with_the_reason() {
    let lab = Authority::new();
    let other = Authority::new();
    let dated = |from: i32, until: i32| {
        move |params: &mut CertificateParams| {
            params.not_before = rcgen::date_time_ymd(from, 1, 1);
            params.not_after = rcgen::date_time_ymd(until, 1, 1);
        }
    };
    let untrusted = "no connection: its certificate is not trusted: ";
    let table = [
        (other.issue(&["localhost"]), "UnknownIssuer"),
        (lab.issue_as(&["localhost"], dated(2010, 2011)), "certificate expired"),
        (
            lab.issue_as(&["localhost"], dated(2400, 2401)),
            "certificate not valid yet",
        ),
        (
            lab.issue(&["lab.example"]),
            "certificate not valid for name \"localhost\"",
        ),
    ];
    let mut servers = vec![simulation_server(&lab.issue(&["localhost"]))];
    servers.extend(table.iter().map(|(certificate, _)| simulation_server(certificate)));
    let plain = session_server(&[]).start().await;
    servers.push(format!("localhost:{}/2000", plain.port));
    let session = watching(&servers, &lab.file()).start().await;
    let errors = errors_after_the_first(&session, 5).await;
    let page = session.monitor().await;
    let log = session.log();
    for (error, (_, words)) in errors.iter().zip(&table) {
        // The time of the probe follows.
        let words = format!("{untrusted}{words}");
        assert!(error.starts_with(&words), "{error:?} is not {words:?}");
        assert!(log.contains(&words), "{words:?} is not in the log");
    }
    assert!(
        page.matches("its certificate is not trusted").count() >= table.len(),
        "{page}"
    );
    assert_eq!(errors[4], "no connection: it does not speak https there");
}

#[actix_rt::test]
async fn a_self_signed_certificate_in_the_trust_store_is_trusted() {
    let folder = tempfile::tempdir().unwrap();
    let signed = |name: &str, signs_others| Certificate::self_signed(folder.path(), name, signs_others);
    let own = signed("own", false);
    let other = signed("other", false);
    let authority = signed("authority", true);
    let trusted = [&own, &authority].map(|certificate| std::fs::read_to_string(&certificate.chain).unwrap());
    std::fs::write(folder.path().join("trusted.pem"), trusted.concat()).unwrap();
    let servers = [&own, &other, &authority].map(simulation_server);
    let session = watching(&servers, &folder.path().join("trusted.pem")).start().await;
    // Not trusted: another certificate for the same name, and one that may sign others, as `openssl req -x509` makes.
    let errors = errors_after_the_first(&session, 2).await;
    for (error, words) in errors
        .iter()
        .zip(["its certificate is not trusted", "CaUsedAsEndEntity"])
    {
        assert!(error.contains(words), "{error}");
    }
}

#[actix_rt::test]
async fn authorities_that_cant_be_read_cost_only_their_servers() {
    let folder = tempfile::tempdir().unwrap();
    let lab = Authority::new();
    let broken = folder.path().join("broken.pem");
    let good = std::fs::read_to_string(lab.file()).unwrap();
    let text = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n{}-----BEGIN CERTIFICATE-----\n*\n\
                -----END CERTIFICATE-----\n";
    std::fs::write(&broken, text.replace("{}", &good)).unwrap();
    let servers = [simulation_server(&lab.issue(&["localhost"]))];
    for (trusted, state, words) in [
        (&*broken, "up", "can't be"),
        (Path::new("/nowhere.pem"), "down", "no certificate authority is known"),
    ] {
        let session = watching(&servers, trusted)
            .env("SSL_CERT_DIR", "/nowhere")
            .start()
            .await;
        until_states(&session, &[state]).await;
        assert!(session.log().contains(words), "{}", session.log());
    }
}
