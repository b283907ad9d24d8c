//! What a project may ask for in its webots.yml: an editor, a competition; and the administrator's templates.

use std::time::Duration;

use super::daemon::{ask, containers, docker, of_service, server};
use super::image::NAME;
use crate::support::client::Client;
use crate::support::git::{Forge, WORLD, arm};
use crate::support::until;

/// How long a build may take on a busy machine.
const BUILT: Duration = Duration::from_secs(90);

fn port_of(address: &str) -> u16 {
    address.rsplit(':').next().unwrap().parse().unwrap()
}

#[actix_rt::test]
async fn a_project_has_an_editor_on_the_port_of_webots_plus_500() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let yml = "publish: true\ntype: demo\ndockerCompose:theia:webots-project/controllers/c/\n";
    forge.commit("lab/arm", "main", &[("webots.yml", yml)]);
    let server = server(forge.path(), 1).start().await;
    let mut client = Client::start(&server, &arm()).await;
    let address = client.patiently("webots:", BUILT).await;
    let told: Vec<_> = client.heard.iter().filter(|text| !text.starts_with("loading:")).take(3).cloned().collect();
    assert_eq!(told, ["ide: enable", "type:demo\n", "shutdownTimeout: 7200"]);
    let editor = ("127.0.0.1", port_of(&address) + 500);
    until("the editor listens", async || tokio::net::TcpStream::connect(editor).await.is_ok()).await;
    let theia = &of_service(&server, "theia")[0];
    assert_eq!(ask(&["exec", theia, "cat", "/home/project/webots-project/c.py"]), "print('original')");
    ask(&["exec", theia, "sh", "-c", "echo edited >/home/project/webots-project/c.py"]);
    let webots = &of_service(&server, "webots")[0];
    assert_eq!(ask(&["exec", webots, "cat", "/usr/local/webots-project/controllers/c/c.py"]), "edited");
    client.leave().await;
    until("both are gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn a_folder_that_leads_out_of_the_project_is_not_shown_to_an_editor() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let work = forge.work_tree("lab/arm", "main");
    std::os::unix::fs::symlink("/etc", work.join("controllers/out")).unwrap();
    std::fs::write(work.join("webots.yml"), "dockerCompose: \"theia:webots-project/controllers/out\"\n").unwrap();
    forge.commit_work_tree("lab/arm", "main");
    let server = server(forge.path(), 1).start().await;
    let told = Client::start(&server, &arm()).await.patiently("loading: Error:", BUILT).await;
    assert!(told.contains("The project has no folder controllers/out"), "{told}");
}

#[actix_rt::test]
async fn a_competition_runs_the_participants_controller_beside_and_starts_it_anew_at_a_reset() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    // It says each start, and when it was.
    let controller = format!(
        "FROM {NAME}\nARG PROJECT_PATH\nARG WEBOTS_CONTROLLER_URL\nENV URL=$WEBOTS_CONTROLLER_URL\nCOPY . \
         $PROJECT_PATH/controllers\nCMD [\"sh\", \"-c\", \"echo $URL >>/tmp/webots/starts; exec sleep 1000\"]\n"
    );
    // A Webots that is reset by a file.
    let webots = "#!/bin/sh\nwhile :; do echo .; if [ -e /tmp/webots/reset ]; then rm /tmp/webots/reset; echo reset; fi; \
                  sleep 0.2; done\n";
    forge.commit(
        "lab/arm",
        "main",
        &[
            ("worlds/a.wbt", &format!("{WORLD}Robot {{ controller \"participant\" }}\n")),
            ("controllers/participant/participant.py", "print(1)\n"),
            ("controllers/Dockerfile", &controller),
            ("fake", webots),
            ("Dockerfile", &format!("FROM {NAME}\nCOPY . /usr/local/webots-project\nRUN cp /usr/local/webots-project/fake /usr/bin/webots && chmod 755 /usr/bin/webots\n")),
            ("webots.yaml", "type: competition\ndockerCompose:competition:webots-project/controllers/participant\n"),
        ],
    );
    let server = server(forge.path(), 1).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("webots:", BUILT).await;
    let webots = of_service(&server, "webots")[0].clone();
    let inside = |command: &str| ask(&["exec", &webots, "sh", "-c", command]);
    assert!(inside("cat /usr/local/webots-project/worlds/a.wbt").contains("controller \"<extern>\""));
    assert!(
        inside("ls /usr/local/webots-project /usr/local/webots-project/controllers")
            .matches("remote_controller_launcher.py")
            .count()
            == 2
    );
    until("the controller has started", async || inside("cat /tmp/webots/starts 2>/dev/null || true") == "participant")
        .await;
    let theia = &of_service(&server, "theia")[0];
    assert_eq!(ask(&["exec", theia, "cat", "/home/project/webots-project/participant.py"]), "print(1)");
    inside("touch /tmp/webots/reset");
    until("it has started again", async || inside("cat /tmp/webots/starts") == "participant\nparticipant").await;
    assert_eq!(of_service(&server, "webots")[0], webots);
    client.leave().await;
    until("all three are gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn resets_without_end_start_a_controller_once_a_second_at_most() {
    let Some(_docker) = docker().await else { return };
    let forge = Forge::with_arm();
    let controller = format!(
        "FROM {NAME}\nCOPY . /usr/local/webots-project/controllers\nCMD [\"sh\", \"-c\", \"echo x >>/tmp/webots/starts; exec sleep 1000\"]\n"
    );
    let webots = "#!/bin/sh\necho .\nwhile :; do echo reset; done\n";
    forge.commit(
        "lab/arm",
        "main",
        &[
            ("controllers/participant/participant.py", "print(1)\n"),
            ("controllers/Dockerfile", &controller),
            ("fake", webots),
            ("Dockerfile", &format!("FROM {NAME}\nCOPY . /usr/local/webots-project\nRUN cp /usr/local/webots-project/fake /usr/bin/webots && chmod 755 /usr/bin/webots\n")),
            ("webots.yml", "dockerCompose: \"competition:webots-project/controllers/participant\"\n"),
        ],
    );
    let server = server(forge.path(), 1).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("webots:", BUILT).await;
    let begin = std::time::Instant::now();
    let webots = of_service(&server, "webots")[0].clone();
    let starts = || ask(&["exec", &webots, "sh", "-c", "cat /tmp/webots/starts || true"]).lines().count();
    until("it has been started again and again", async || starts() >= 4).await;
    let count = starts();
    assert!(begin.elapsed() >= Duration::from_secs(count as u64 - 2), "{count} starts in {:?}", begin.elapsed());
    assert!(server.log().len() < 100_000);
}

#[actix_rt::test]
async fn an_administrators_template_counts_and_what_protects_stays() {
    let Some(_docker) = docker().await else { return };
    let (forge, templates) = (Forge::with_arm(), tempfile::tempdir().unwrap());
    let template = "services:\n  webots:\n    image: ${IMAGE}\n    command: sh -c 'touch /tmp/mine && exec ${WEBOTS}'\n    \
                    privileged: true\n    read_only: false\n    ports: [\"${BIND}:${PORT}:${PORT}\"]\n    volumes: \
                    [\"${PROJECT}:${PROJECT_PATH}\"]\n";
    std::fs::write(templates.path().join("docker-compose-default.yml"), template).unwrap();
    let settings =
        serde_json::json!({ "templates": templates.path(), "newPrivileges": true, "capabilities": ["SYS_PTRACE"] });
    let server = server(forge.path(), 1).set("container", settings).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("webots:", BUILT).await;
    let webots = &of_service(&server, "webots")[0];
    ask(&["exec", webots, "ls", "/tmp/mine"]);
    let format =
        "{{.HostConfig.Privileged}} {{.HostConfig.ReadonlyRootfs}} {{.HostConfig.CapAdd}} {{.HostConfig.SecurityOpt}}";
    assert_eq!(ask(&["inspect", "--format", format, webots]), "false true [SYS_PTRACE] [no-new-privileges:false]");
}
