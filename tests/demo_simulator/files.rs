//! Files over HTTP.

use std::fs;
use std::os::unix::fs::symlink;

use super::simulator::{Simulator, Start, small_project};

async fn started() -> (tempfile::TempDir, Simulator) {
    let project = small_project();
    fs::create_dir(project.path().join("worlds/textures")).unwrap();
    fs::write(project.path().join("worlds/textures/wood.png"), "a picture").unwrap();
    fs::write(project.path().join("index.html"), "<p>hello").unwrap();
    let simulator = Start::paused(&project.path().join("worlds/a.wbt")).playing().await;
    (project, simulator)
}

#[tokio::test]
async fn files_of_the_project_are_given_to_pages_of_any_origin_and_may_be_cached() {
    let (_project, simulator) = started().await;
    let (status, head, body) = simulator.get("/worlds/textures/wood.png?x=1", "").await;
    assert_eq!((status, body.as_str()), (200, "a picture"));
    for header in [
        "\naccess-control-allow-origin: *",
        "\ncache-control: public, max-age=3600",
        "\ncontent-type: image/png",
        "\ncontent-length: 9",
    ] {
        assert!(head.contains(header), "{head}");
    }
    let tag = head.lines().find_map(|line| line.strip_prefix("etag: ")).expect(&head);
    let (status, _, body) = simulator.get("/worlds/textures/wood.png", &format!("If-None-Match: {tag}\r\n")).await;
    assert_eq!((status, body.as_str()), (304, ""));
    assert_eq!(simulator.get("/index.html", "").await.2, "<p>hello");
}

#[tokio::test]
async fn anything_else_is_not_found() {
    let (project, simulator) = started().await;
    let outside = tempfile::tempdir().unwrap();
    fs::write(outside.path().join("secret.png"), "secret").unwrap();
    symlink(outside.path().join("secret.png"), project.path().join("leak.png")).unwrap();
    symlink(outside.path(), project.path().join("leak")).unwrap();
    let name = outside.path().file_name().unwrap().to_str().unwrap();
    for path in [
        "/missing.png",
        "/worlds",
        "/worlds/a.wbt",
        "/leak.png",
        "/leak/secret.png",
        &format!("/../{name}/secret.png"),
        &format!("/%2e%2e/{name}/secret.png"),
        &format!("/..%2f{name}/secret.png"),
        &format!("/worlds/../../{name}/secret.png"),
        &format!("/{}/secret.png", outside.path().display()),
        "/worlds/../index.html",
        "/index.html%00.png",
        "//etc/passwd",
    ] {
        let (status, head, body) = simulator.get(path, "").await;
        assert_eq!(status, 404, "{path}");
        assert!(head.contains("content-type: text/html") && body.contains("404 Not Found"), "{path}: {head} {body}");
    }
}

#[tokio::test]
async fn the_root_is_for_websockets_only() {
    let (_project, simulator) = started().await;
    assert_eq!(simulator.get("/", "").await.0, 400);
    simulator.spectator().await;
}
