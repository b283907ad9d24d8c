//! From the first click to the end of a simulation, through each web server with each set of rules. Whatever URLs the servers
//! hand out lead through the web server, from wherever they were read.

use tokio::net::TcpStream;

use super::fleet::{Fleet, arm};
use super::rules::Rules;
use crate::support::smtp::Smtp;
use crate::support::until;

async fn the_whole_way(rules: Rules) {
    let mut smtp = Smtp::start(&[]).await;
    let port = smtp.port;
    let fleet = Fleet::start_with(rules, |server| server.mails_to(port)).await;
    let browser = &fleet.browser;
    let at_the_door = |path: &str| rules.session_path(fleet.session.port, path);

    // Pages.
    let page = browser.get(&at_the_door("/monitor")).await;
    assert_eq!(page.status, 200);
    let status = browser.get(&at_the_door("/status")).await.json();
    let named: Vec<_> = status["servers"].as_array().unwrap().iter().map(|one| one["monitor"].clone()).collect();
    for server in [&fleet.here, &fleet.there] {
        let monitor = format!("https://{}/{}/monitor", browser.host, server.port);
        assert!(page.text().contains(&monitor), "{}", page.text());
        assert!(named.len() == 2 && named.contains(&monitor.clone().into()), "{named:?}");
        assert_eq!(browser.ask(&monitor, &[]).await.status, 200);
        let load = browser.get(&format!("/{}/load", server.port)).await.text();
        assert!(load.parse::<f64>().is_ok(), "{load}");
    }
    until("the door is open", async || browser.get(&at_the_door("/request")).await.text() == "1").await;

    // The door.
    let mut door = browser.connect(&at_the_door("/")).await;
    door.until("1").await;
    let mut session = browser.connect(&at_the_door("/session")).await;
    session.until("1").await;
    let both = [fleet.wss(&fleet.here), fleet.wss(&fleet.there)];
    let question = at_the_door(&format!("/session?url={}", arm()));
    until("a page is given a simulation server", async || both.contains(&browser.get(&question).await.text())).await;
    session.send(&arm()).await;
    let given = session.until("wss").await;
    assert!(both.contains(&given), "{given}");

    // A simulation on each machine.
    for (server, address) in [(&fleet.here, "127.0.0.1"), (&fleet.there, "127.0.0.2")] {
        let (client, stream) = fleet.simulate(browser, server).await;
        assert_eq!(stream, format!("wss://{}/{}", browser.host, server.port + 1));
        let mut viewer = browser.open(&format!("{stream}/")).await.with_scene().await;
        let file = browser.get(&format!("/{}/worlds/textures/old%20wood.png?x=1", server.port + 1)).await;
        assert_eq!((file.status.as_u16(), file.text().as_str()), (200, "a picture"));
        viewer.send("real-time:-1").await;
        viewer.until("application/json:").await;
        client.leave().await;
        viewer.closed().await;
        until("Webots has ended", async || TcpStream::connect((address, server.port + 1)).await.is_err()).await;
    }
    door.leave().await;

    // The log, and a mail.
    let door = format!("https://{}/{}", browser.host, fleet.session.port);
    let line = format!("listens on port {}: {door}", fleet.session.port);
    assert!(fleet.session.log().contains(&line), "{}", fleet.session.log());
    let lost = format!("{}/{}", browser.host, fleet.there.port);
    drop(fleet.there);
    // Before there was a web server, none of them answered.
    let mail = loop {
        let mail = smtp.mail().await;
        if mail.subject() == format!("Simulation server not responding: {lost}") {
            break mail;
        }
    };
    let link = mail.field("text").split_whitespace().find(|word| word.starts_with("http"));
    assert_eq!(link, Some(format!("{door}/monitor").as_str()), "{mail:?}");
    assert_eq!(browser.ask(link.unwrap(), &[]).await.status, 200);
}

through_both!(the_whole_way);

#[actix_rt::test]
async fn through_apache_with_the_documents_rules() {
    the_whole_way(Rules::Documents).await;
}
