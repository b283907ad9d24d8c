//! Built images: a project's own Dockerfile, what it may not do, and what happens if a build fails.

use webots_fleet::simulation::container::ResourceOwner;

use super::daemon::{
    self, alone, ask, containers, docker, dockerfile, of_service, own_images, refused, running, server, server_built,
    server_with,
};
use super::image::NAME;
use super::registry::Registry;
use crate::support::{Client, WORLD, arm, arm_at, is_told, skip, until};

#[actix_rt::test]
async fn a_projects_dockerfile_is_built_once_for_all_clients() {
    let Some(_docker) = docker().await else { return };
    let dockerfile = format!(
        "FROM {NAME}\nARG PROJECT_PATH\nRUN mkdir -p $PROJECT_PATH\nCOPY . $PROJECT_PATH\nRUN sleep 2 && cp \
         $PROJECT_PATH/controllers/c/c.py $PROJECT_PATH/controllers/c/built\nHEALTHCHECK --interval=1ms CMD true\n"
    );
    let compose = ("docker-compose.yml", "services: {webots: {privileged: true}}\n");
    let server = server(2).start().await;
    server.forge().commit(
        "lab/arm",
        "main",
        &[("Dockerfile", &dockerfile), compose, (".env", "PORT=1\n")],
    );
    let mut one = Client::start(&server, &arm()).await;
    let mut two = Client::start(&server, &arm()).await;
    for client in [&mut one, &mut two] {
        client.patiently("webots:").await;
        let heard = client.heard.join("\n");
        assert!(heard.contains("loading: Step 5/9 : COPY . $PROJECT_PATH"), "{heard}");
    }
    assert_eq!(own_images(&server).len(), 1);
    for container in of_service(&server, "webots") {
        let built = ask(&[
            "exec",
            &container,
            "cat",
            "/usr/local/webots-project/controllers/c/built",
        ]);
        assert_eq!(built, "print('original')");
        // It may write into its project and into `/tmp`.
        ask(&["exec", &container, "touch", "/usr/local/webots-project/new", "/tmp/new"]);
        // Health checks of the image, which would cost CPU time, are off.
        assert_eq!(
            ask(&["inspect", "--format", "{{json .State.Health}}", &container]),
            "null"
        );
    }
    // The next simulation need not wait for a build.
    one.leave().await;
    until("one is gone", async || containers(&server).len() == 1).await;
    let mut next = Client::start(&server, &arm()).await;
    next.patiently("webots:").await;
    assert!(
        !next.heard.iter().any(|text| text.contains("COPY .")),
        "{:?}",
        next.heard
    );
}

#[actix_rt::test]
async fn an_image_is_built_again_when_the_one_below_it_has_changed() {
    let Some(_docker) = docker().await else { return };
    const BASE: &str = "webots-fleet.test/base";
    let dockerfile = format!("FROM {BASE}\nCOPY . /usr/local/webots-project\n");
    let server = server_with(&[("Dockerfile", &dockerfile)]).start().await;
    for version in ["one", "two"] {
        super::daemon::build_from(&format!("FROM {NAME}\nRUN echo {version} >/usr/local/version\n"), BASE);
        let mut client = Client::start(&server, &arm()).await;
        client.patiently("webots:").await;
        assert_eq!(
            ask(&["exec", &of_service(&server, "webots")[0], "cat", "/usr/local/version"]),
            version
        );
        client.leave().await;
        until("its container is gone", async || containers(&server).is_empty()).await;
    }
}

#[actix_rt::test]
async fn a_makefile_is_run_in_the_default_image() {
    let Some(_docker) = docker().await else { return };
    let (server, _client) = running(server_with(&[("Makefile", "all:\n\tcp controllers/c/c.py made\n")])).await;
    let made = ask(&[
        "exec",
        &of_service(&server, "webots")[0],
        "cat",
        "/usr/local/webots-project/made",
    ]);
    assert_eq!(made, "print('original')");
}

#[actix_rt::test]
async fn what_can_not_be_built_is_told_in_words_and_leaves_nothing() {
    let Some(_docker) = docker().await else { return };
    let table = [
        (
            dockerfile("RUN echo 'gcc: not found' && exit 3"),
            "The image of this project can't be built. Its last output: The command",
        ),
        // The build ends with the code of a shell that does not find a program, and `docker` is there.
        (
            dockerfile("RUN no-such-program"),
            "The image of this project can't be built. Its last output: The command",
        ),
        (
            "FROM webots-fleet.test/nothing:1\n".to_owned(),
            "webots-fleet.test/nothing:1",
        ),
        (
            format!("FROM {NAME}\nADD http://127.0.0.1/secret /x\n"),
            "line 2, `ADD http://127.0.0.1/secret x`: ADD may",
        ),
        (
            format!("FROM {NAME}\n"),
            "webots-project can't be copied out of the image of this project: its Dockerfile has to COPY",
        ),
        (dockerfile("VOLUME /data"), "line 3, `VOLUME data`: a volume"),
        (
            "FROM webots-fleet.test/volume\nCOPY . /usr/local/webots-project\n".to_owned(),
            "The image that it begins with has `VOLUME",
        ),
        (
            dockerfile("RUN rm -r /usr/local/webots-project/worlds"),
            "has no worlds/a.wbt",
        ),
        ("no Dockerfile at all\n".to_owned(), "can't be built"),
    ];
    super::daemon::build_from(&format!("FROM {NAME}\nVOLUME [\"/a:b\"]\n"), "webots-fleet.test/volume");
    let server = server(1).start().await;
    for (dockerfile, words) in table {
        server.forge().commit("lab/arm", "main", &[("Dockerfile", &dockerfile)]);
        is_told(&server, &arm(), words).await;
        until("nothing is left", async || containers(&server).is_empty()).await;
    }
}

#[actix_rt::test]
async fn a_version_without_an_image_is_told_in_words() {
    let Some(_docker) = docker().await else { return };
    // A registry that refuses connections.
    let image = serde_json::json!({"image": "127.0.0.1:1/webots:{version}"});
    let server = server_with(&[("worlds/a.wbt", &WORLD.replace("R2025a", "R2022b"))]).set("container", image);
    is_told(&server.start().await, &arm(), "127.0.0.1:1/webots:R2022b").await;
}

#[actix_rt::test]
async fn a_client_that_leaves_in_the_middle_of_a_build_ends_it() {
    let Some(_docker) = docker().await else { return };
    let long = format!("FROM {NAME}\nLABEL test.long=yes\nRUN sleep 1000\n");
    let server = server_with(&[("Dockerfile", &long)]).start().await;
    let mut client = Client::start(&server, &arm()).await;
    client.patiently("loading: Step 4/6 : RUN sleep 1000").await;
    let builds = async || {
        ask(&["ps", "--all", "--quiet", "--filter", "label=test.long=yes"])
            .lines()
            .count()
    };
    until("it is built", async || builds().await == 1).await;
    client.leave().await;
    until("the build is gone", async || builds().await == 0).await;
    // The slot is free again.
    server
        .forge()
        .commit("lab/arm", "main", &[("Dockerfile", &dockerfile(""))]);
    Client::start(&server, &arm()).await.patiently("webots:").await;
}

#[actix_rt::test]
async fn builds_without_end_by_one_address_leave_a_builder_to_others() {
    let Some(_docker) = docker().await else { return };
    let server = server(4)
        .set("trustedProxies", serde_json::json!(["127.0.0.1"]))
        .set("maxPlacesPerAddress", 3);
    for branch in ["a", "b", "c"] {
        let endless = format!("FROM {NAME}\nLABEL test.branch={branch}\nRUN sleep 1000\n");
        server.forge().commit("lab/arm", branch, &[("Dockerfile", &endless)]);
    }
    let files = [("Dockerfile", &*dockerfile("RUN true"))];
    server.forge().commit("lab/arm", "main", &files);
    let server = server.start().await;
    let mut endless = Vec::new();
    for (branch, progress) in [("a", "Step 4/6"), ("b", "Step 4/6"), ("c", "waiting for other images")] {
        let mut client = Client::start_from(&server, "192.0.2.2", &arm_at(branch)).await;
        client.patiently(&format!("loading: {progress}")).await;
        endless.push(client);
    }
    let mut other = Client::start_from(&server, "192.0.2.3", &arm()).await;
    other.patiently("webots:").await;
}

#[actix_rt::test]
async fn an_image_that_is_too_large_is_told_and_removed() {
    let Some(_docker) = docker().await else { return };
    let base: u64 = ask(&["image", "inspect", "--format", "{{.Size}}", NAME])
        .parse()
        .unwrap();
    let server = server(1);
    for (branch, size) in [("small", "10M"), ("large", "40M")] {
        let line = format!("RUN head -c {size} /dev/zero >/usr/local/file");
        server
            .forge()
            .commit("lab/arm", branch, &[("Dockerfile", &dockerfile(&line))]);
    }
    let server = server.start().await;
    let mut client = Client::start(&server, &arm_at("large")).await;
    client.patiently("webots:").await;
    client.leave().await;
    server.rewrite_config(|config| config["container"] = serde_json::json!({ "imageSize": (base >> 20) + 20 }));
    let (succeeds, told) = server.upgrade().await;
    assert!(succeeds, "{told}");
    // First the one that is there, and then a new one, of which Docker has kept the layers.
    for _ in 0..2 {
        let (told, code) = refused(&server, &arm_at("large")).await;
        assert!(told.contains("container.imageSize"), "{told}");
        assert_eq!((code, own_images(&server).len()), (Some(1000), 0));
    }
    Client::start(&server, &arm_at("small"))
        .await
        .patiently("webots:")
        .await;
    assert_eq!(own_images(&server).len(), 1);
}

#[actix_rt::test]
async fn on_a_quiet_machine_of_several_builds_the_one_that_fills_the_disk_ends() {
    let Some(_docker) = alone().await else { return };
    let disk = nix::sys::statvfs::statvfs(daemon::folder().as_path()).unwrap();
    let free = (disk.blocks_available() * disk.fragment_size()) >> 20;
    if free < 5000 {
        return skip("a disk with less than 5 GB of room");
    }
    // Nobody else may write as much meanwhile.
    let server = server(2).set("diskReserve", free - 1000);
    // The modest one goes on until the other has ended.
    for (branch, line) in [
        ("greedy", "RUN fallocate -l 1500M /file && sleep 60"),
        (
            "modest",
            "LABEL test.modest=yes\nRUN fallocate -l 20M /file && until [ -e /done ]; do sleep 0.1; done",
        ),
    ] {
        server
            .forge()
            .commit("lab/arm", branch, &[("Dockerfile", &dockerfile(line))]);
    }
    let server = server.start().await;
    let mut modest = Client::start(&server, &arm_at("modest")).await;
    modest.patiently("loading: Step 5/7").await;
    let mut greedy = Client::start(&server, &arm_at("greedy")).await;
    greedy.patiently("loading: Error:").await;
    assert_eq!(greedy.reason()["code"], "image-too-large");
    assert_eq!(greedy.closed().await, Some(1000));
    assert_eq!(server.status().await["failedStarts"], 0);
    let build = ask(&["ps", "--quiet", "--filter", "label=test.modest=yes"]);
    assert!(!build.is_empty(), "the modest one was ended too");
    ask(&["exec", &build, "touch", "/done"]);
    modest.patiently("webots:").await;
}

#[actix_rt::test]
async fn above_their_size_images_are_removed_that_were_not_used_for_longest() {
    let Some(_docker) = docker().await else { return };
    // A project is copied out of its image, and the home is made readable: less than 1 MiB.
    let server = server(2).set("container", serde_json::json!({ "imagesSize": 50 }));
    for branch in ["a", "b", "c"] {
        let line = format!("RUN head -c 20M /dev/zero >/usr/local/{branch}");
        server
            .forge()
            .commit("lab/arm", branch, &[("Dockerfile", &dockerfile(&line))]);
    }
    let server = server.start().await;
    let images = || own_images(&server);
    // Of the first two the first is used again, and a container uses the last.
    let mut seen = Vec::new();
    for branch in ["a", "b", "a"] {
        let mut client = Client::start(&server, &arm_at(branch)).await;
        client.patiently("webots:").await;
        seen.extend(images().into_iter().find(|id| !seen.contains(id)));
        client.leave().await;
        until("its container is gone", async || containers(&server).is_empty()).await;
    }
    assert_eq!(images().len(), 2, "two fit");
    let mut last = Client::start(&server, &arm_at("c")).await;
    last.patiently("webots:").await;
    until("there are two again", async || images().len() == 2).await;
    assert!(images().contains(&seen[0]) && !images().contains(&seen[1]), "{seen:?}");
}

#[actix_rt::test]
async fn an_image_that_a_build_has_pulled_is_removed_too() {
    let Some(_docker) = docker().await else { return };
    let registry = Registry::start();
    // Its tag is `latest`.
    let base = format!("127.0.0.1:{}/base", registry.port);
    let folder = tempfile::tempdir().unwrap();
    let line = format!("FROM {base}\nRUN true\n");
    let builder = server_with(&[("Dockerfile", &line)]).folder(folder.path());
    let mut server = builder.start().await;
    // The base is empty, so that its first step fails.
    let (told, _) = refused(&server, &arm()).await;
    assert!(told.contains("can't be built"), "{told}");
    let is_there = || !ask(&["image", "ls", "--quiet", &base]).is_empty();
    assert!(is_there());
    server.stops().await;
    drop(server);
    let full = server_with(&[]).folder(folder.path()).set("diskReserve", 100_000_000);
    let server = full.start().await;
    until("the base is gone", async || !is_there()).await;
    until("it is told", async || server.log().contains("removed the image")).await;
}

#[actix_rt::test]
async fn a_build_that_takes_too_long_is_ended_and_told() {
    let Some(_docker) = docker().await else { return };
    is_told(
        &server_built("RUN sleep 1000").set("timing.build", 3).start().await,
        &arm(),
        "timing.build",
    )
    .await;
}

#[actix_rt::test]
async fn images_of_ours_that_are_old_are_removed_and_no_others() {
    let Some(_docker) = docker().await else { return };
    let (folder, owner, used) = images(
        &[("old", true), ("others", false), ("running", true)],
        "running",
        "-6 years",
    );
    let (_server, client) = running(server(1).folder(folder.path())).await;
    // The end of a simulation triggers a search for unused images.
    client.leave().await;
    until("the old one is gone", async || !is_there("old")).await;
    assert!(is_there("others") && is_there("running"));
    assert_eq!(
        ask(&["image", "ls", "--quiet", &format!("webots-fleet/{owner}")])
            .lines()
            .count(),
        1
    );
    ask(&["rm", &used]);
}

#[actix_rt::test]
async fn a_full_disk_is_freed_of_images_that_no_container_uses() {
    let Some(_docker) = docker().await else { return };
    let (folder, _, used) = images(
        &[("unused", true), ("of-others", false), ("used", true)],
        "used",
        "-2 hours",
    );
    // No disk has this much room.
    let full = server(1).folder(folder.path()).set("diskReserve", 100_000_000);
    let _server = full.start().await;
    until("the one that nobody uses is gone", async || !is_there("unused")).await;
    assert!(["of-others", "used"].iter().all(|tag| is_there(tag)));
    ask(&["rm", &used]);
}

/// Images built at this time by the server of a folder, or by another server, and a container of one of them. Returns
/// the folder, the server's name as an owner, and the container.
fn images(tags: &[(&str, bool)], used: &str, created: &str) -> (tempfile::TempDir, String, String) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("cache")).unwrap();
    let owner = ResourceOwner::of(&folder.path().join("cache")).0;
    for (tag, is_own) in tags {
        load(
            folder.path(),
            tag,
            if *is_own { &owner } else { "000000000000" },
            created,
        );
        assert!(is_there(tag));
    }
    let label = "com.docker.compose.project=webots-fleet.test";
    let container = ask(&["create", "--label", label, "--network", "none", &image(used), "true"]);
    (folder, owner, container)
}

fn image(tag: &str) -> String {
    format!("webots-fleet.test/{tag}:1")
}

pub fn is_there(tag: &str) -> bool {
    !ask(&["image", "ls", "--quiet", &image(tag)]).is_empty()
}

/// Loads an image into the daemon, as if a server had built it at this time, as `date` reads it.
pub fn load(folder: &std::path::Path, tag: &str, owner: &str, created: &str) {
    let time = std::process::Command::new("date")
        .args(["--utc", "+%FT%TZ", "--date", created])
        .output()
        .unwrap();
    let name = image(tag);
    // Projects give their images labels of any size.
    let created = String::from_utf8(time.stdout).unwrap().trim().to_owned();
    let files = folder.join("image");
    std::fs::create_dir_all(&files).unwrap();
    std::fs::write(files.join("layer.tar"), [0; 1024]).unwrap();
    // The digest of the layer: two blocks of zeros.
    let layer = "sha256:5f70bf18a086007016e948b04aed3b82103a36bea41755b6cddfaf10ace3c6ef";
    let config = serde_json::json!({
        "architecture": "amd64", "os": "linux", "created": created, "author": name,
        "config": {"Labels": {"webots-fleet.owner": owner, "large": "x".repeat(1 << 20)}}, "rootfs": {"type": "layers", "diff_ids": [layer]},
    });
    std::fs::write(files.join("config.json"), config.to_string()).unwrap();
    let manifest = serde_json::json!([{"Config": "config.json", "RepoTags": [name], "Layers": ["layer.tar"]}]);
    std::fs::write(files.join("manifest.json"), manifest.to_string()).unwrap();
    let tar = folder.join("image.tar");
    let archive = ["manifest.json", "config.json", "layer.tar"];
    let made = std::process::Command::new("tar")
        .arg("-C")
        .arg(&files)
        .arg("-cf")
        .arg(&tar)
        .args(archive)
        .status();
    assert!(made.unwrap().success());
    ask(&["load", "--input", tar.to_str().unwrap()]);
}
