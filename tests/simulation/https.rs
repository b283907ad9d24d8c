//! Repositories over HTTPS, as from a real Git host: git's own server behind TLS.

use std::io::Write;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};

use super::opened::{cached, reader, world_text};
use crate::support::authority::Authority;
use crate::support::git::git;
use crate::support::listener::{Request, serve};
use crate::support::{Builder, Forge, Webots, arm, arm_at, is_told, simulation_server, world};

/// A forge that is reachable only over HTTPS.
struct Https {
    forge: Forge,
    port: u16,
    authority: Authority,
}

impl Https {
    /// Serves the forge's repositories. `/lab/dotted` is found only as `/lab/dotted.git`, paths that begin with
    /// `/lab/private` need a password, `/lab/away` redirects to `elsewhere`, `/lab/old-NAME` to `/lab/NAME`, and
    /// `/lab/old-OWNER--NAME` to `/OWNER/NAME`.
    fn new(forge: Forge, elsewhere: String) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let authority = Authority::new();
        let root = forge.path().to_owned();
        let certificate = authority.issue(&["127.0.0.1"]).server();
        serve(listener, Some(certificate), move |request| {
            answer(request, &root, &elsewhere)
        });
        Self { forge, port, authority }
    }

    /// A simulation server that fetches all repositories from this forge.
    fn server(&self, webots: &Webots) -> Builder {
        let mirrors = serde_json::json!({"https://github.com/": format!("https://127.0.0.1:{}/", self.port)});
        simulation_server(&webots.path(), self.forge.path(), 2).set("gitMirrors", mirrors)
    }
}

fn answer(request: &Request, root: &Path, elsewhere: &str) -> Option<(String, Vec<u8>)> {
    let target = request.path();
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    // Git hosts ignore case.
    let lowercase = path.to_lowercase();
    let path = lowercase.as_str();
    let is_known = request.header("authorization") == "Basic dTpw";
    let moved = |location: String| Some((format!("301 Moved Permanently\r\nLocation: {location}"), Vec::new()));
    if path.starts_with("/lab/private") && !is_known {
        return Some((
            "401 Unauthorized\r\nWWW-Authenticate: Basic realm=\"x\"".to_owned(),
            Vec::new(),
        ));
    }
    if path.starts_with("/lab/away") {
        return Some((format!("302 Found\r\nLocation: {elsewhere}{target}"), Vec::new()));
    }
    if let Some(rest) = target.strip_prefix("/lab/dotted/") {
        // As GitLab does.
        return moved(format!("/lab/dotted.git/{rest}"));
    }
    if let Some(name) = target.strip_prefix("/lab/old-") {
        return moved(
            name.split_once("--")
                .map_or(format!("/lab/{name}"), |(owner, name)| format!("/{owner}/{name}")),
        );
    }
    let method = request.head.split(' ').next()?;
    let mut backend = Command::new("git");
    backend
        .arg("http-backend")
        .env("GIT_PROJECT_ROOT", root)
        .env("GIT_HTTP_EXPORT_ALL", "1");
    backend.envs([("REQUEST_METHOD", method), ("PATH_INFO", path), ("QUERY_STRING", query)]);
    backend.env("CONTENT_TYPE", request.header("content-type"));
    backend.env("CONTENT_LENGTH", request.content.len().to_string());
    backend.env("HTTP_CONTENT_ENCODING", request.header("content-encoding"));
    backend
        .env("GIT_PROTOCOL", request.header("git-protocol"))
        .env("REMOTE_ADDR", "127.0.0.1");
    let mut backend = backend
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut input = backend.stdin.take().unwrap();
    let body = request.content.clone();
    let fed = std::thread::spawn(move || input.write_all(&body));
    let output = backend.wait_with_output().unwrap().stdout;
    fed.join().unwrap().ok();
    let end = output.windows(4).position(|four| four == b"\r\n\r\n")?;
    let head = String::from_utf8_lossy(&output[..end]).into_owned();
    let status = head
        .lines()
        .find_map(|line| line.strip_prefix("Status: "))
        .unwrap_or("200 OK");
    Some((format!("{status}\r\n{head}"), output[end + 4..].to_vec()))
}

#[actix_rt::test]
async fn a_forge_is_asked_over_https_and_followed_nowhere_else() {
    let forge = Forge::new();
    let webots = reader();
    let old = forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("old"))]);
    forge.commit("lab/arm", "main", &[("worlds/a.wbt", &world_text("new"))]);
    forge.commit("lab/dotted.git", "main", &[("worlds/a.wbt", &world_text("dotted"))]);
    for hidden in ["lab/secret", "other/arm"] {
        forge.commit(hidden, "main", &[("worlds/a.wbt", &world_text("hidden"))]);
    }
    git(
        &forge.path().join("lab/arm"),
        &["config", "uploadpack.allowFilter", "true"],
    );
    let plain = TcpListener::bind("127.0.0.1:0").unwrap();
    plain.set_nonblocking(true).unwrap();
    let https = Https::new(forge, format!("https://{}", plain.local_addr().unwrap()));
    let server = https
        .server(&webots)
        .env("GIT_SSL_CAINFO", https.authority.file().to_str().unwrap());
    let server = server
        .set(
            "blockedRepositories",
            serde_json::json!(["https://github.com/lab/secret"]),
        )
        .start()
        .await;
    let missing = "does not exist or is not public";
    let table = [
        (arm(), "opened [new]"),
        (arm_at(&old), "opened [old]"),
        (arm(), "opened [new]"),
        (
            "https://www.GitHub.com/LAB/Arm.git/blob/main/worlds/a.wbt".to_owned(),
            "opened [new]",
        ),
        (world("lab/none", "main", "worlds/a.wbt"), missing),
        // git asks no user for a password.
        (world("lab/private", "main", "worlds/a.wbt"), missing),
        // Redirects to other hosts are not followed.
        (
            world("lab/away", "main", "worlds/a.wbt"),
            "https://github.com/lab/away has moved to another host",
        ),
        // A repository that has moved within its host is found, also after several moves, and so are its commits.
        (world("lab/old-arm", "main", "worlds/a.wbt"), "opened [new]"),
        (world("lab/old-old-old-arm", "main", "worlds/a.wbt"), "opened [new]"),
        (world("lab/dotted", "main", "worlds/a.wbt"), "opened [dotted]"),
        (world("lab/old-arm", &old, "worlds/a.wbt"), "opened [old]"),
        (
            world("lab/old-none", "main", "worlds/a.wbt"),
            "https://github.com/lab/none does not exist",
        ),
        // It is not found if its new name is not allowed, or if it is redirected too often.
        (
            world("lab/old-lab--secret", "main", "worlds/a.wbt"),
            "from blocked repository: https://github.com/lab/secret",
        ),
        (
            world("lab/old-other--arm", "main", "worlds/a.wbt"),
            "and https://github.com/other/arm is not one of them",
        ),
        (
            world("lab/old-private", "main", "worlds/a.wbt"),
            "https://github.com/lab/private does not exist",
        ),
        (
            world(&format!("lab/{}arm", "old-".repeat(9)), "main", "worlds/a.wbt"),
            "has moved again and again",
        ),
    ];
    for (url, words) in table {
        is_told(&server, &url, words).await;
    }
    assert!(plain.accept().is_err(), "a redirect was followed");
    let cached: Vec<_> = cached(&server)
        .into_iter()
        .filter(|folder| folder.join("HEAD").is_file())
        .collect();
    assert_eq!(
        cached.len(),
        3,
        "two repositories and the history of one, in whatever spelling: {cached:?}"
    );
    // Certificates of unknown authorities are refused.
    let server = https.server(&webots).start().await;
    is_told(&server, &arm(), "certificate").await;
}

#[actix_rt::test]
async fn git_uses_the_administrators_settings_only() {
    let forge = Forge::new();
    let webots = reader();
    let home = tempfile::tempdir().unwrap();
    forge.commit("lab/private", "main", &[("worlds/a.wbt", &world_text("private"))]);
    let https = Https::new(forge, String::new());
    let settings = "[credential]\n\thelper = \"!f() { echo username=u; echo password=p; }; f\"\n";
    let ours = home.path().join("an administrator's");
    std::fs::write(&ours, settings).unwrap();
    std::fs::write(home.path().join(".gitconfig"), settings).unwrap();
    let url = world("lab/private", "main", "worlds/a.wbt");
    let start = || {
        let builder = https.server(&webots).env("HOME", home.path().to_str().unwrap());
        builder.env("GIT_SSL_CAINFO", https.authority.file().to_str().unwrap())
    };
    is_told(&start().start().await, &url, "does not exist or is not public").await;
    is_told(
        &start().set("gitConfig", ours.to_str().unwrap()).start().await,
        &url,
        "opened [private]",
    )
    .await;
}
