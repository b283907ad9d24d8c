//! A server that can't start simulations reports that and gets no clients; one with limitations reports them too.

use serde_json::Value;

use crate::support::{
    Client, Forge, Server, Webots, arm, demo_server, http, is_told, make_program, session_server, simulation_server,
    until,
};

/// Whether the session server considers its only simulation server working; on a busy machine it may be full.
async fn works(session: &Server) -> bool {
    ["up", "full"].contains(&session.status().await["servers"][0]["state"].as_str().unwrap())
}

#[actix_rt::test]
async fn a_server_without_webots_is_not_offered() {
    let forge = Forge::with_arm();
    let webots = Webots::launcher();
    let server = simulation_server(&webots.path(), forge.path(), 1).start().await;
    let session = session_server(&[server.address()]).start().await;
    until("it works", async || works(&session).await).await;
    let away = webots.path().with_file_name("away");
    std::fs::rename(webots.path(), &away).unwrap();
    until("it does not work", async || !works(&session).await).await;
    assert_eq!(http::get(&session.url("/request")).await.text(), "0");
    let (status, text) = server.health().await;
    assert!(
        status == 503 && text.contains("has no Webots that it can run at"),
        "{status} {text}"
    );
    assert_eq!(http::get(&server.url("/load")).await.text(), "100");
    let page: Value = server.status().await;
    assert!(
        page["problem"]
            .as_str()
            .unwrap()
            .contains("has no Webots that it can run at"),
        "{page}"
    );
    assert!(
        server.log().contains("no simulation can be started"),
        "{}",
        server.log()
    );
    until("the session server tells why", async || {
        session.log().contains("can start no simulation")
    })
    .await;
    std::fs::rename(&away, webots.path()).unwrap();
    until("it works again", async || works(&session).await).await;
    assert_eq!(server.health().await, (200, "ok".to_owned()));
}

#[actix_rt::test]
async fn a_display_that_is_missing_is_a_problem_for_webots_itself() {
    let webots = Webots::launcher();
    let home = webots.path().parent().unwrap().to_str().unwrap().to_owned();
    let itself = || {
        demo_server(1)
            .set("webots", Value::Null)
            .set("webotsHome", home.as_str())
    };
    let server = itself().set("display", ":59").start().await;
    until("it is told", async || server.health().await.0 == 503).await;
    assert!(server.health().await.1.contains("no display answers at :59"));
    is_told(&server, &arm(), "no display answers at :59").await;
    // The display of each GPU is required.
    let displays = serde_json::json!([":59000", ":59001"]);
    let server = itself().set("gpus", "spread").set("displays", displays).start().await;
    until("the first is missing", async || {
        server.health().await.1.contains("no display answers at :59000")
    })
    .await;
}

/// A Docker whose first answers to `docker version` are these; after them it answers.
async fn with_docker(first_answers: &[&str]) -> (Server, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    for (number, answer) in first_answers.iter().enumerate() {
        std::fs::write(folder.path().join(format!("answer{number}")), answer).unwrap();
    }
    let program = "[ \"$1\" = version ] || exit 0\ncd \"$(dirname \"$0\")\"\nfor answer in answer*; do\n\
                   [ -f $answer ] || break\nmv $answer given-$answer\n. ./given-$answer\ndone";
    make_program(&folder.path().join("docker"), program);
    let path = format!("{}:{}", folder.path().display(), std::env::var("PATH").unwrap());
    let server = demo_server(1).set("isolation", "container").set("webots", Value::Null);
    (server.env("PATH", &path).start().await, folder)
}

#[actix_rt::test]
async fn one_late_answer_of_docker_refuses_nobody_and_two_do() {
    const REFUSES: &str = "no simulation can be started: Docker does not answer";
    for once in ["exec sleep 1000", "exit 1"] {
        let (server, _docker) = with_docker(&[once]).await;
        assert_eq!(server.health().await, (200, "ok".to_owned()), "{once}");
        assert!(!server.log().contains(REFUSES), "{once}: {}", server.log());
    }
    let (server, _docker) = with_docker(&["exit 1", "exit 1"]).await;
    assert!(server.log().contains(REFUSES), "{}", server.log());
    until("it is asked again", async || server.health().await.0 == 200).await;
}

#[actix_rt::test]
async fn a_docker_that_stops_when_it_is_asked_for_an_image_is_told_as_such() {
    let folder = tempfile::tempdir().unwrap();
    // Only a stub stops at a given command. From then on it answers no more, and notes what it is asked.
    let program = "cd \"$(dirname \"$0\")\"\n[ \"$1 $2\" != 'network inspect' ] || exit 1\n\
                   [ \"$1 $2\" != 'image inspect' ] || touch stopped\n[ -f stopped ] || exit 0\necho \"$*\" >>asked\nexit 1";
    make_program(&folder.path().join("docker"), program);
    let path = format!("{}:{}", folder.path().display(), std::env::var("PATH").unwrap());
    let server = demo_server(1).set("isolation", "container").set("webots", Value::Null);
    let server = server.env("PATH", &path).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.until("loading: Error: ").await;
    assert_eq!(client.reason()["code"], "docker-unavailable");
    // What is taken for an image that is not there is pulled, and removed one day.
    let asked = std::fs::read_to_string(folder.path().join("asked")).unwrap();
    assert!(!asked.contains("pull"), "{asked}");
}

#[actix_rt::test]
async fn the_limit_of_open_files_is_raised_as_needed() {
    let server = demo_server(10)
        .set("maxClients", 300)
        .before("ulimit -Sn 256")
        .start()
        .await;
    let limits = procfs::process::Process::new(server.pid()).unwrap().limits().unwrap();
    let procfs::process::LimitValue::Value(soft) = limits.max_open_files.soft_limit else {
        panic!("{limits:?}")
    };
    assert_eq!(soft, 128 + 10 * 8 + 300 * 2);
    let few = demo_server(10).files(300).start().await;
    assert!(
        few.log()
            .contains("300 files may be open, which is enough for 46 clients"),
        "{}",
        few.log()
    );
    let said = demo_server(1).files(128).refused(1).await;
    assert!(
        said.starts_with("error: 128 files may be open, which is not enough for 1 places"),
        "{said}"
    );
}
