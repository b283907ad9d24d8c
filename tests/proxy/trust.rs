//! Certificates of a lab's own authority, and those that can't be trusted.

use std::path::Path;

use rcgen::CertificateParams;
use serde_json::Value;

use super::web_server::{Kind, WebServer};
use crate::support::authority::{Authority, Certificate};
use crate::support::program::{Builder, Server, session_server};
use crate::support::smtp::Smtp;
use crate::support::{ports, until};

/// A web server with this certificate and nothing behind it.
async fn web_server(certificate: &Certificate) -> (WebServer, u16) {
    let ports = (ports::block(1), ports::block(1));
    let site = format!(
        "server {{ listen 127.0.0.1:{} ssl; ssl_certificate {}; ssl_certificate_key {};\n\
         location /2000/load {{ return 200 12.5; }} location / {{ return 404; }} }}\n",
        ports.1,
        certificate.chain.display(),
        certificate.key.display()
    );
    (WebServer::start(Kind::Nginx, ports, &site, super::fleet::IDLE).await, ports.1)
}

fn watcher(address: &str) -> Builder {
    session_server(&[address.to_owned()]).set("ssl", true).set("portRewrite", true)
}

async fn page_of_the_server(session: &Server, state: &str) -> Value {
    let server = async || session.status().await["servers"][0].clone();
    until(&format!("the simulation server is {state}"), async || server().await["state"] == state).await;
    server().await
}

/// What `openssl req -x509` makes for a name: a certificate that has signed itself and may sign others.
fn self_signed(folder: &Path, name: &str) -> Certificate {
    let files = Certificate { chain: folder.join(format!("{name}.pem")), key: folder.join(format!("{name}.key")) };
    let output = std::process::Command::new("openssl")
        .args(["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "30", "-subj", &format!("/CN={name}")])
        .args(["-addext", &format!("subjectAltName=DNS:{name}"), "-out"])
        .args([files.chain.as_os_str(), "-keyout".as_ref(), files.key.as_os_str()])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    files
}

/// One that has signed itself long ago.
fn expired(folder: &Path) -> Certificate {
    let mut params = CertificateParams::new(["localhost".to_owned()]).unwrap();
    params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
    params.not_after = rcgen::date_time_ymd(2011, 1, 1);
    let key = rcgen::KeyPair::generate().unwrap();
    let expired = Certificate { chain: folder.join("expired.pem"), key: folder.join("expired.key") };
    std::fs::write(&expired.chain, params.self_signed(&key).unwrap().pem()).unwrap();
    std::fs::write(&expired.key, key.serialize_pem()).unwrap();
    expired
}

#[actix_rt::test]
async fn a_certificate_is_trusted_or_named_with_the_reason_in_answers_log_page_and_mail() {
    let (lab, other, careless) = (Authority::new(), Authority::new(), Authority::new());
    let is_authority = |params: &mut CertificateParams| {
        params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
    };
    let dated = |from: i32, until: i32| {
        move |params: &mut CertificateParams| {
            params.not_before = rcgen::date_time_ymd(from, 1, 1);
            params.not_after = rcgen::date_time_ymd(until, 1, 1);
        }
    };
    let (folder, others) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let [own, named] = ["localhost", "lab.example"].map(|name| self_signed(folder.path(), name));
    let (another, expired) = (self_signed(others.path(), "localhost"), expired(folder.path()));
    let an_authority = Some("it is that of an authority (CA:TRUE) and not itself known here");
    let of_another_name = Some("it is for lab.example, not for localhost");
    let table = [
        (&lab.issue(&["localhost"]), lab.file(), None),
        (&lab.issue(&["localhost"]), other.file(), Some("it comes from an authority that is not known here")),
        (&lab.issue_as(&["localhost"], dated(2010, 2011)), lab.file(), Some("it expired on 2011-01-01T00:00:00Z")),
        (
            &lab.issue_as(&["localhost"], dated(2400, 2401)),
            lab.file(),
            Some("it is valid only from 2400-01-01T00:00:00Z"),
        ),
        (&lab.issue(&["lab.example"]), lab.file(), of_another_name),
        (&careless.issue_as(&["localhost"], is_authority), careless.file(), an_authority),
        // One that has signed itself is trusted where it is in the trust store; another one for the same name is not that one.
        (&own, own.chain.clone(), None),
        (&own, another.chain.clone(), an_authority),
        (&named, named.chain.clone(), of_another_name),
        (&expired, expired.chain.clone(), Some("it expired on 2011-01-01")),
    ];
    for (certificate, store, wrong) in table {
        let (_web, port) = web_server(certificate).await;
        let mut smtp = Smtp::start(&[]).await;
        let session = watcher(&format!("localhost:{port}/2000")).env("SSL_CERT_FILE", store.to_str().unwrap());
        let session = session.mails_to(smtp.port).set("timing.gather", 0.1).start().await;
        let Some(words) = wrong else {
            assert_eq!(page_of_the_server(&session, "up").await["load"], 12.5);
            continue;
        };
        let error = page_of_the_server(&session, "down").await["error"].as_str().unwrap().to_owned();
        let reason = error.strip_prefix("no connection: its certificate is not trusted: ");
        assert!(reason.is_some_and(|reason| reason.starts_with(words)), "{error:?} is not {words:?}");
        assert!(session.log().contains(&error), "{error} is not in the log");
        assert!(session.monitor().await.contains("its certificate is not trusted"));
        let mail = smtp.mail().await;
        let told = mail.field("text").split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(told.contains(&error), "{error} is not in the mail: {told}");
    }
}

#[actix_rt::test]
async fn authorities_that_cant_be_read_are_told_and_cost_only_their_servers() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("broken.pem");
    let lab = Authority::new();
    let good = std::fs::read_to_string(lab.file()).unwrap();
    let broken = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n";
    std::fs::write(&file, format!("{broken}{good}-----BEGIN CERTIFICATE-----\n*\n-----END CERTIFICATE-----\n"))
        .unwrap();
    let (_web, port) = web_server(&lab.issue(&["localhost"])).await;
    let address = format!("localhost:{port}/2000");
    let session = watcher(&address).env("SSL_CERT_FILE", file.to_str().unwrap()).start().await;
    page_of_the_server(&session, "up").await;
    assert!(session.log().contains("can't be"), "{}", session.log());
    drop(session);
    let session = watcher(&address).env("SSL_CERT_FILE", "/nowhere.pem").env("SSL_CERT_DIR", "/nowhere").start().await;
    page_of_the_server(&session, "down").await;
    assert!(session.log().contains("no certificate authority is known"), "{}", session.log());
}

#[actix_rt::test]
async fn a_server_without_https_is_named_as_such() {
    let plain = crate::support::program::session_server(&[]).start().await;
    let session = watcher(&format!("localhost:{}/2000", plain.port)).start().await;
    let error = page_of_the_server(&session, "down").await["error"].clone();
    assert_eq!(error, "no connection: it does not speak https there");
}
