//! Certificates of a lab's own authority, and those that can't be trusted.

use rcgen::CertificateParams;
use serde_json::Value;

use super::web_server::{Kind, WebServer};
use crate::support::authority::{Authority, Certificate};
use crate::support::program::{Builder, Server, session_server};
use crate::support::smtp::Smtp;
use crate::support::{http, ports, until};

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
    let server = async || http::get(&session.url("/status")).await.json()["servers"][0].clone();
    until(&format!("the simulation server is {state}"), async || server().await["state"] == state).await;
    server().await
}

/// What the session server says of a server with this certificate, when it trusts this authority: the same in its
/// answers, its log, its page and its mail.
async fn verdict(certificate: &Certificate, trusted: &Authority) -> String {
    let (_web, port) = web_server(certificate).await;
    let mut smtp = Smtp::start(&[]).await;
    let session = watcher(&format!("localhost:{port}/2000")).env("SSL_CERT_FILE", trusted.file().to_str().unwrap());
    let session = session.mails_to(smtp.port).set("timing.gather", 0.1).start().await;
    let error = page_of_the_server(&session, "down").await["error"].as_str().unwrap().to_owned();
    assert!(session.log().contains(&error), "{error} is not in the log");
    assert!(http::get(&session.url("/monitor")).await.text().contains("its certificate is not trusted"));
    let mail = smtp.mail().await;
    let told = mail.field("text").split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(told.contains(&error), "{error} is not in the mail: {told}");
    error.strip_prefix("no connection: its certificate is not trusted: ").unwrap_or(&error).to_owned()
}

#[actix_rt::test]
async fn a_lab_s_own_authority_is_trusted_when_it_is_named() {
    let lab = Authority::new();
    let (_web, port) = web_server(&lab.issue(&["localhost"])).await;
    let address = format!("localhost:{port}/2000");
    let session = watcher(&address).env("SSL_CERT_FILE", lab.file().to_str().unwrap()).start().await;
    assert_eq!(page_of_the_server(&session, "up").await["load"], 12.5);
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
        (lab.issue(&["localhost"]), &other, "it comes from an authority that is not known here"),
        (lab.issue_as(&["localhost"], dated(2010, 2011)), &lab, "it expired on 2011-01-01T00:00:00Z"),
        (lab.issue_as(&["localhost"], dated(2400, 2401)), &lab, "certificate not valid yet"),
        (lab.issue(&["lab.example"]), &lab, "certificate not valid for name \"localhost\""),
    ];
    for (certificate, trusted, words) in &table {
        let said = verdict(certificate, trusted).await;
        assert!(said.starts_with(words), "{said:?} is not {words:?}");
    }
}

/// A certificate for a name that has signed itself. What `openssl req -x509` makes may sign others, too.
fn self_signed(folder: &std::path::Path, name: &str, signs_others: bool) -> Certificate {
    let files = Certificate { chain: folder.join(format!("{name}.pem")), key: folder.join(format!("{name}.key")) };
    let mut command = std::process::Command::new("openssl");
    command.args(["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "30", "-subj", &format!("/CN={name}")]);
    if !signs_others {
        command.args(["-addext", "basicConstraints=critical,CA:FALSE"]);
    }
    let output = command
        .args(["-addext", &format!("subjectAltName=DNS:{name}"), "-out"])
        .args([files.chain.as_os_str(), "-keyout".as_ref(), files.key.as_os_str()])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    files
}

#[actix_rt::test]
async fn a_certificate_that_has_signed_itself_is_trusted_where_it_is_in_the_trust_store() {
    let folder = tempfile::tempdir().unwrap();
    let watch = async |certificate: &Certificate, store: &std::path::Path, state: &str| {
        let (_web, port) = web_server(certificate).await;
        let server = watcher(&format!("localhost:{port}/2000")).env("SSL_CERT_FILE", store.to_str().unwrap());
        page_of_the_server(&server.start().await, state).await
    };
    let own = self_signed(folder.path(), "localhost", false);
    assert_eq!(watch(&own, &own.chain, "up").await["load"], 12.5);
    // Another one for the same name is not that one, nor is one that may sign others.
    let others = tempfile::tempdir().unwrap();
    let error = watch(&own, &self_signed(others.path(), "localhost", false).chain, "down").await["error"].to_string();
    assert!(error.contains("its certificate is not trusted"), "{error}");
    let authority = self_signed(others.path(), "localhost", true);
    let error = watch(&authority, &authority.chain, "down").await["error"].to_string();
    assert!(error.contains("CaUsedAsEndEntity"), "{error}");
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
