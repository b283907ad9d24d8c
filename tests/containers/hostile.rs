//! What a project tries with symlinks, memory, folders and devices in its images.

use super::daemon::{
    alone, as_ordinary, ask, check, docker, dockerfile, of_service, refused, running, server, server_built,
};
use super::image::NAME;
use crate::support::{Client, arm, arm_at, is_told, sentences, until};

#[actix_rt::test]
async fn a_link_in_an_image_leads_no_build_to_files_of_the_machine() {
    let Some(_docker) = docker().await else { return };
    let outside = tempfile::tempdir().unwrap();
    std::fs::write(outside.path().join("secret"), "xyz").unwrap();
    let link = format!(
        "WORKDIR /usr/local/webots-project\nRUN rm -r controllers && ln -s {} controllers",
        outside.path().display()
    );
    let controller = format!("FROM {NAME}\nCOPY . /stolen\nRUN cat /stolen/secret && false\n");
    let yml = "dockerCompose: \"competition:webots-project/controllers/c\"\n";
    let server = server_built(&link);
    server.forge().commit(
        "lab/arm",
        "main",
        &[("webots.yml", yml), ("controllers/Dockerfile", &controller)],
    );
    is_told(&server.start().await, &arm(), "The project has no folder controllers").await;
}

#[actix_rt::test]
async fn a_build_has_no_more_memory_than_a_simulation() {
    let Some(_docker) = docker().await else { return };
    // It would end by itself at 200 MB.
    let server = server_built("RUN perl -e 'my @a; push @a, \"x\" x 1000000 for 1..200'").set("limits.memory", 64);
    let (told, _) = refused(&server.start().await, &arm()).await;
    assert!(told.contains("can't be built") && told.contains("137"), "{told}");
}

#[actix_rt::test]
async fn folders_and_devices_of_an_image_are_its_projects_fault() {
    let Some(_docker) = docker().await else { return };
    let server = server(1);
    let folder = tempfile::tempdir().unwrap();
    let replaced = |folder| (format!("rm -rf {folder} && touch {folder}"), "");
    // An ordinary user can't copy a device out of the image.
    let device = ("mknod /usr/local/webots-project/zero c 1 5".to_owned(), "not permitted");
    let all = [replaced("/tmp"), replaced("/run"), replaced("/var/tmp"), device];
    for (branch, (line, _)) in ["a", "b", "c", "d"].into_iter().zip(&all) {
        server.forge().commit(
            "lab/arm",
            branch,
            &[("Dockerfile", &dockerfile(&format!("RUN {line}")))],
        );
    }
    let server = as_ordinary(server, folder.path()).start().await;
    for (branch, (line, words)) in ["a", "b", "c", "d"].into_iter().zip(all) {
        let (told, code) = refused(&server, &arm_at(branch)).await;
        assert_eq!(code, Some(1000), "{line}: {told}");
        assert_eq!(server.status().await["failedStarts"], 0, "{line}: {told}");
        assert!(
            told.contains(words) && !told.contains(server.folder.to_str().unwrap()),
            "{line}: {told}"
        );
    }
}

#[actix_rt::test]
async fn a_device_made_by_a_dockerfile_opens_nothing() {
    let Some(_docker) = docker().await else { return };
    // The memory of the machine, a disk that may exist, and `/dev/zero`.
    let devices = "RUN cd /usr/local/webots-project && mknod mem c 1 1 && mknod disk b 254 0 && mknod controllers/zero c 1 5 \
                   && chmod 666 mem disk controllers/zero";
    let (server, _client) = running(server_built(devices)).await;
    let webots = &of_service(&server, "webots")[0];
    for device in ["mem", "disk"] {
        let read = format!("head -c 1 /usr/local/webots-project/{device} 2>&1 || true");
        let told = ask(&["exec", webots, "sh", "-c", &read]);
        assert!(
            told.contains("not permitted") || told.contains("denied"),
            "{device}: {told}"
        );
    }
}

#[actix_rt::test]
async fn what_a_dockerfile_prints_blames_neither_docker_nor_the_server() {
    let Some(_docker) = docker().await else { return };
    let server = server(1).start().await;
    let mut lists: Vec<String> = sentences::all()
        .chunks(500)
        .map(|list| list.join("\n") + "\n")
        .collect();
    // The last line decides what Docker prints as the reason.
    let last = [
        "Cannot connect to the Docker daemon at unix:///var/run/docker.sock",
        "Step 1/1 : FROM nothing",
    ];
    lists.extend(last.map(|line| format!("{line}\n")));
    for list in lists {
        let dockerfile = dockerfile("COPY list /list\nRUN cat /list; cat /list >&2; exit 1");
        server
            .forge()
            .commit("lab/arm", "main", &[("Dockerfile", &dockerfile), ("list", &list)]);
        let (told, code) = refused(&server, &arm()).await;
        assert!(told.contains("The image of this project can't be built"), "{told}");
        assert_eq!(code, Some(1000), "{told}");
    }
    assert_eq!(server.status().await["failedStarts"], 0);
}

#[actix_rt::test]
async fn a_network_that_the_packet_filter_does_not_match_is_refused() {
    let Some(_docker) = alone().await else { return };
    let remove = || ask(&["network", "rm", "webots-fleet"]);
    if ask(&["network", "ls", "--format", "{{.Name}}"]).contains("webots-fleet") {
        // Those of other tests end with their servers.
        let users = ["ps", "--quiet", "--filter", "network=webots-fleet"];
        until("no container uses it", async || ask(&users).is_empty()).await;
        remove();
    }
    ask(&["network", "create", "webots-fleet"]);
    let server = server(1).start().await;
    let (told, code) = refused(&server, &arm()).await;
    let checked = check(&server);
    // The other tests need the right one, whatever this one finds.
    remove();
    let words = "The Docker network webots-fleet on this simulation server has another interface";
    assert!(told.contains(words) && told.contains("docker network rm"), "{told}");
    assert_eq!(code, Some(1013));
    assert!(checked.contains(&format!("warning: docker: {words}")), "{checked}");
    Client::start(&server, &arm()).await.patiently("webots:").await;
}
