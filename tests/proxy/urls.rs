//! URLs that the servers hand out: they lead through the web server, from wherever they were read.

use super::fleet::Fleet;
use super::rules::Rules;
use crate::support::http;
use crate::support::smtp::Smtp;
use crate::support::until;

/// The first URL of a text.
fn first_url(text: &str) -> &str {
    text.split_whitespace().find(|word| word.starts_with("http")).unwrap_or_else(|| panic!("no URL in {text}"))
}

async fn urls_lead_through_the_web_server(rules: Rules) {
    let mut smtp = Smtp::start(&[]).await;
    let port = smtp.port;
    let fleet = Fleet::start_with(rules, |server| server.mails_to(port)).await;
    let Fleet { browser, session, here, there, .. } = fleet;

    // A page, and what its parts are told.
    for server in [&here, &there] {
        let monitor = format!("https://{}/{}/monitor", browser.host, server.port);
        assert!(browser.get(&rules.session_path(session.port, "/monitor")).await.text().contains(&monitor));
        let status = browser.get(&rules.session_path(session.port, "/status")).await.json();
        let named: Vec<_> = status["servers"].as_array().unwrap().iter().map(|one| one["monitor"].clone()).collect();
        assert!(named.contains(&monitor.clone().into()), "{named:?}");
        assert_eq!(browser.ask(&monitor, &[]).await.status, 200);
    }
    // An answer.
    let question = format!("{}?url={}", rules.session_path(session.port, "/session"), super::fleet::arm());
    until("a page is given a simulation server", async || browser.get(&question).await.status == 200).await;
    let given = browser.get(&question).await.text();
    assert!(given.starts_with(&format!("wss://{}/", browser.host)), "{given}");
    browser.open(&format!("{given}/client")).await.leave().await;
    // The log, and the first line that is printed.
    let door = format!("https://{}/{}", browser.host, session.port);
    assert!(session.log().contains(&format!("listens on port {}: {door}", session.port)), "{}", session.log());
    assert_eq!(browser.ask(&format!("{door}/monitor"), &[]).await.status, 200);

    // A mail.
    let lost = format!("{}/{}", browser.host, there.port);
    drop(there);
    let mail = loop {
        let mail = smtp.mail().await;
        // Before there was a web server, none of them answered.
        if mail.subject() == format!("Simulation server not responding: {lost}") {
            break mail;
        }
    };
    let body = mail.field("text");
    assert!(body.contains(&format!("{door}/monitor")), "{body}");
    let link = first_url(body);
    assert_eq!(browser.ask(link, &[]).await.status, 200, "{link} in {body}");
    assert_eq!(http::get(&session.url("/health")).await.status, 200);
}

through_both!(urls_lead_through_the_web_server);
