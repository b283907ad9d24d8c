//! How a server chooses its level, and how it reports it.

use serde_json::json;

use crate::support::{self, Builder, Client, Webots, arm, demo_server, server_of};

/// A folder with git and a shell, and with this script as bubblewrap if there is one.
fn programs(bubblewrap: Option<&str>) -> tempfile::TempDir {
    let folder = support::programs(&["git", "bash", "env", "sh", "sleep", "rm", "prlimit"]);
    if let Some(script) = bubblewrap {
        let failing = Webots::script(script);
        std::fs::copy(failing.path(), folder.path().join("bwrap")).unwrap();
    }
    folder
}

fn with(builder: Builder, programs: &tempfile::TempDir, isolation: &str) -> Builder {
    builder
        .env("PATH", programs.path().to_str().unwrap())
        .set("isolation", isolation)
}

#[actix_rt::test]
async fn a_required_level_that_is_missing_refuses_the_start() {
    let none = programs(None);
    let ends = programs(Some("exit 1"));
    let denied = programs(Some("echo 'bwrap: setting up uid map: Permission denied' >&2; exit 1"));
    let hangs = programs(Some("exec sleep 1000"));
    let sandbox = |programs| with(demo_server(1), programs, "sandbox");
    let closed = |programs| with(demo_server(1).set("sandbox.network", "closed"), programs, "auto");
    let begin = "error: isolation is \"sandbox\", but bubblewrap";
    let mut table = vec![
        (
            sandbox(&none),
            begin,
            "the package bubblewrap has it; \"none\" runs worlds without it",
        ),
        (sandbox(&denied), begin, "uid map: Permission denied): user namespaces"),
        (sandbox(&hangs), begin, "did not end within 5 seconds"),
        (
            closed(&none),
            "error: ",
            "closed\", but bubblewrap (bwrap) is not there",
        ),
        (
            closed(&ends),
            "error: ",
            "closed\", but bubblewrap makes no sandbox here",
        ),
        (
            with(demo_server(1), &none, "container"),
            "error: isolation is \"container\", but docker is not there; ",
            "on Debian and Ubuntu the package docker.io has it",
        ),
    ];
    if nix::unistd::getuid().is_root() {
        let words = "closed\", but pasta gives none to root, run the server as a user of its own; \"shared\"";
        table.push((demo_server(1).set("sandbox.network", "closed"), "error: ", words));
    }
    for (builder, begin, words) in table {
        let told = builder.refused(1).await;
        assert!(told.starts_with(begin) && told.contains(words), "{told}");
    }
}

#[actix_rt::test]
async fn auto_warns_where_no_sandbox_works() {
    let programs = programs(Some("echo 'bwrap: No permissions' >&2; exit 1"));
    let server = with(demo_server(1), &programs, "auto").start().await;
    let words = "bubblewrap makes no sandbox here (bwrap: No permissions)";
    let log = server.log();
    assert!(
        log.lines()
            .any(|line| line.contains("WARN") && line.contains("(isolation: none)") && line.contains(words)),
        "{log}"
    );
    let page = server.monitor().await;
    assert!(
        page.contains(words) && page.contains("may do whatever this server may"),
        "{page}"
    );
    assert_eq!(server.status().await["isolation"], "none");
    Client::ready(&server).await;
}

#[actix_rt::test]
async fn a_sandbox_is_what_a_machine_has_by_itself() {
    needs!("bwrap");
    let server = demo_server(1).start().await;
    assert_eq!(server.status().await["isolation"], "sandbox");
    let page = server.monitor().await;
    assert!(page.contains("<dt>Isolation</dt><dd>sandbox</dd>"), "{page}");
    let log = server.log();
    // Warnings about what the machine of the tests may lack.
    let known = [
        "only bubblewrap from 0.8 on",
        "network of simulations: shared with this machine: ",
    ];
    let is_known = |line: &&str| known.iter().any(|words| line.contains(words));
    assert_eq!(
        log.lines()
            .filter(|line| line.contains("WARN"))
            .find(|line| !is_known(line)),
        None
    );
}

#[actix_rt::test]
async fn limits_that_a_machine_can_not_enforce_are_reported() {
    let lines = [
        "limits.memory does not hold: systemd has not delegated control groups with the controller memory",
        "limits.cores does not hold: systemd has not delegated control groups with the controller cpu",
    ];
    let told = |text: &str, mark: &str| -> Vec<String> {
        let marked = text.lines().filter(|line| line.contains(mark)).map(str::to_owned);
        marked
            .filter(|line| lines.iter().any(|words| line.contains(words)))
            .collect()
    };
    let limited = demo_server(1)
        .set("isolation", "none")
        .set("limits.memory", 1000)
        .set("limits.cores", 1);
    let server = limited.start().await;
    assert_eq!(told(&server.log(), "WARN").len(), 2, "{}", server.log());
    let check = || {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_simulation-server"));
        let output = command
            .arg("--check")
            .arg(server.folder.join("config.json"))
            .output()
            .unwrap();
        String::from_utf8([output.stdout, output.stderr].concat()).unwrap()
    };
    let text = check();
    assert_eq!(told(&text, "warning: limits: ").len(), 2, "{text}");
    server.rewrite_config(|config| config["limits"] = json!({}));
    let text = check();
    assert_eq!(told(&text, "warning: limits: "), [""; 0], "{text}");
}

#[actix_rt::test]
async fn a_webots_that_is_never_ready_names_level_and_keys() {
    needs!("bwrap");
    for (isolation, is_told) in [("sandbox", true), ("none", false)] {
        let webots = Webots::script("echo 'no module named arm'; exit 1");
        let server = server_of(webots, 1).set("isolation", isolation).start().await;
        let told = Client::start(&server, &arm()).await.until("loading: Error:").await;
        assert!(told.contains("no module named arm"), "{told}");
        assert_eq!(
            told.contains("It ran in a sandbox") && told.contains("sandbox.readable"),
            is_told,
            "{told}"
        );
    }
}
