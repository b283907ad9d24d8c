//! What a project may request in its webots.yml, an editor or a competition, and what administrators may relax.

use serde_json::json;

use super::daemon::{ORDINARY, as_ordinary, ask, containers, docker, of_service, running, server, server_with};
use super::image::NAME;
use crate::support::{Client, WORLD, arm, is_told, until};

#[actix_rt::test]
async fn a_project_has_an_editor_on_the_port_of_webots_plus_500() {
    let Some(_docker) = docker().await else { return };
    let yml = "publish: true\ntype: demo\ndockerCompose:theia:webots-project/controllers/c/\n";
    let (server, client) = running(server_with(&[("webots.yml", yml)])).await;
    let told: Vec<_> = client
        .heard
        .iter()
        .filter(|text| !text.starts_with("loading:") && !text.starts_with("progress:"))
        .skip(1)
        .take(3)
        .collect();
    assert_eq!(told, ["ide: enable", "type:demo\n", "shutdownTimeout: 7200"]);
    let editor = ("127.0.0.1", server.port + 501);
    until("the editor listens", async || {
        tokio::net::TcpStream::connect(editor).await.is_ok()
    })
    .await;
    let theia = &of_service(&server, "theia")[0];
    assert_eq!(
        ask(&["exec", theia, "cat", "/home/project/webots-project/c.py"]),
        "print('original')"
    );
    ask(&[
        "exec",
        theia,
        "sh",
        "-c",
        "echo edited >/home/project/webots-project/c.py",
    ]);
    let webots = &of_service(&server, "webots")[0];
    assert_eq!(
        ask(&["exec", webots, "cat", "/usr/local/webots-project/controllers/c/c.py"]),
        "edited"
    );
    client.leave().await;
    until("both are gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn an_editor_shows_no_folder_outside_of_the_project() {
    let Some(_docker) = docker().await else { return };
    let server = server(1).start().await;
    let work = server.forge().work_tree("lab/arm", "main");
    // As a line of its own, the second part of the name would set where the project is.
    let folder = work.join("controllers/x\nPROJECT=/etc");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("file"), "").unwrap();
    for (target, words) in [
        ("/etc", "The project has no folder controllers/edit"),
        ("x\nPROJECT=/etc", "line break"),
    ] {
        std::fs::remove_file(work.join("controllers/edit")).ok();
        std::os::unix::fs::symlink(target, work.join("controllers/edit")).unwrap();
        std::fs::write(
            work.join("webots.yml"),
            "dockerCompose: \"theia:webots-project/controllers/edit\"\n",
        )
        .unwrap();
        server.forge().commit_work_tree("lab/arm", "main");
        is_told(&server, &arm(), words).await;
    }
}

/// Like the Dockerfiles of real competitions: a default port that their server replaces, and a shell entry point.
const COMPETITION: [(&str, &str); 4] = [
    (
        "Dockerfile",
        "FROM {NAME}\nRUN mkdir -p /usr/local/webots-project\nCOPY . /usr/local/webots-project\n",
    ),
    (
        "controllers/Dockerfile",
        "FROM {NAME}\nCOPY . /usr/local/webots-project/controllers\nENV PORT=1234\nARG WEBOTS_CONTROLLER_URL\nENV \
         WEBOTS_CONTROLLER_URL=${WEBOTS_CONTROLLER_URL}\nWORKDIR /usr/local/webots-project/controllers/participant\nENTRYPOINT \
         /usr/local/webots/webots-controller --robot-name=\"${WEBOTS_CONTROLLER_URL}\" --port=\"${PORT}\" participant.py\n",
    ),
    ("controllers/participant/participant.py", "print(1)\n"),
    (
        "webots.yml",
        "publish: true\ntype: competition\ndockerCompose: competition:webots-project/controllers/participant/\n",
    ),
];

#[actix_rt::test]
async fn a_participant_connects_and_runs_edited_code_after_a_reset() {
    let Some(_docker) = docker().await else { return };
    let files = COMPETITION.map(|(path, text)| (path, text.replace("{NAME}", NAME)));
    let world = format!("{WORLD}Robot {{ name \"participant\" controller \"participant\" }}\n");
    let files = files
        .iter()
        .map(|(path, text)| (*path, text.as_str()))
        .chain([("worlds/a.wbt", world.as_str())]);
    let (server, client) = running(server_with(&files.collect::<Vec<_>>())).await;
    let port = server.port + 1;
    let webots = of_service(&server, "webots")[0].clone();
    let connected = || -> Vec<serde_json::Value> {
        let folder = format!("/tmp/webots/webots/{port}/ipc/participant");
        let told = ask(&[
            "exec",
            &webots,
            "sh",
            "-c",
            &format!("cat {folder}/connected 2>/dev/null || true"),
        ]);
        told.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    };
    until("the participant is connected", async || connected().len() == 1).await;
    let seen = connected().remove(0);
    for (key, value) in [
        (
            "arguments",
            json!(["--robot-name=participant", format!("--port={port}"), "participant.py"]),
        ),
        ("PORT", port.to_string().into()),
        ("WEBOTS_STDOUT_REDIRECT", "1".into()),
        ("WEBOTS_STDERR_REDIRECT", "1".into()),
        ("WEBOTS_CONTROLLER_URL", "participant".into()),
        ("folder", "/usr/local/webots-project/controllers/participant".into()),
        ("uid", nix::unistd::getuid().as_raw().into()),
        ("USER", "webots".into()),
        ("HOME", "/tmp/home".into()),
        ("terminal", true.into()),
        ("source", "print(1)\n".into()),
    ] {
        assert_eq!(seen[key], value, "{key}");
    }
    // The editor changes the program, and a viewer resets the simulation.
    let theia = &of_service(&server, "theia")[0];
    ask(&[
        "exec",
        theia,
        "sh",
        "-c",
        "echo 'print(2)' >/home/project/webots-project/participant.py",
    ]);
    let mut viewer = Client::connect(&format!("ws://127.0.0.1:{port}/")).await;
    viewer.send("w3d").await;
    viewer.until("model:").await;
    viewer.send("reset").await;
    until("it is connected again", async || connected().len() == 2).await;
    assert_eq!(connected().remove(1)["source"], "print(2)\n");
    assert_eq!(of_service(&server, "webots")[0], webots);
    drop(viewer);
    client.leave().await;
    until("all three are gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn what_an_image_keeps_at_home_is_found_and_can_be_changed() {
    let Some(_docker) = docker().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let (server, client) = running(as_ordinary(server(1), folder.path())).await;
    let webots = of_service(&server, "webots")[0].clone();
    let inside = |command: &str| ask(&["exec", &webots, "sh", "-c", command]);
    assert_eq!(inside("id -u"), ORDINARY.to_string());
    assert_eq!(
        inside("cat ~/.cache/Cyberbotics/Webots/assets/*"),
        "an asset of the image"
    );
    assert!(inside("cat ~/.config/Cyberbotics/Webots-R2025a.conf").contains("cacheSize=1024"));
    inside("echo x >~/.cache/Cyberbotics/Webots/assets/new && echo y >>~/.config/Cyberbotics/Webots-R2025a.conf");
    // The image itself stays unchanged.
    assert!(inside("touch /usr/local/new 2>&1 || true").contains("Read-only file system"));
    assert_eq!(inside("cat /proc/1/comm"), "docker-init");
    // The server must remove the files that it writes.
    inside("mkdir -p /usr/local/webots-project/deep && touch /usr/local/webots-project/deep/new");
    client.leave().await;
    until("all is gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn what_an_administrator_relaxes_counts_and_the_rest_stays() {
    let Some(_docker) = docker().await else { return };
    let settings = json!({ "newPrivileges": true, "capabilities": ["SYS_PTRACE"] });
    let (server, _client) = running(server(1).set("container", settings)).await;
    let webots = &of_service(&server, "webots")[0];
    let format =
        "{{.HostConfig.Privileged}} {{.HostConfig.ReadonlyRootfs}} {{.HostConfig.CapAdd}} {{.HostConfig.SecurityOpt}}";
    assert_eq!(
        ask(&["inspect", "--format", format, webots]),
        "false true [SYS_PTRACE] [no-new-privileges:false]"
    );
}
