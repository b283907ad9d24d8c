//! What a world's program tries in a container; docs/isolation.md has a row for each.

use super::daemon::{ask, containers, docker, of_service, running, server_running};
use super::image::NAME;
use crate::support::{Builder, arm, is_told, until};

/// Listens on the port of Webots, and answers as a Webots whose world has no such robot: the world is ready.
const READY: &str = r#"
for argument; do [[ $argument != --port=* ]] || port=${argument#--port=}; done
python3 -c '
import socketserver, sys
class Answer(socketserver.BaseRequestHandler):
    def handle(self):
        self.request.recv(100)
        self.request.sendall(b"FAILED")
socketserver.TCPServer(("", int(sys.argv[1])), Answer).serve_forever()' "$port" &
"#;

/// A server whose Webots has a world, does this and then sends heartbeats.
pub fn doing(script: &str) -> Builder {
    server_running(&format!("{READY}\n{script}\nwhile :; do echo .; sleep 0.2; done"))
}

#[actix_rt::test]
async fn a_program_sees_its_image_and_its_project_only() {
    let Some(_docker) = docker().await else { return };
    // compose ignores the server's own environment variables.
    let builder = doing("")
        .env("SECRET", "xyz")
        .env("PORT", "9")
        .env("PROJECT", "/etc")
        .env("BIND", "nobody");
    let (server, _client) = running(builder).await;
    let webots = &of_service(&server, "webots")[0];
    assert_eq!(
        ask(&["exec", webots, "cat", "/usr/local/webots-project/controllers/c/c.py"]),
        "print('original')"
    );
    let inside = |command: &str| ask(&["exec", webots, "bash", "-c", &format!("({command}) 2>&1 || true")]);
    assert!(!inside("env").contains("SECRET"));
    // Processes, folders and devices of the machine.
    let processes = inside("cat /proc/[0-9]*/cmdline | tr '\\0' ' '; echo; ls -d /proc/[0-9]*");
    assert!(!processes.contains("simulation-server"), "{processes}");
    assert!(!inside("ls -R /usr/local /tmp /run").contains("config.json"));
    for (command, words) in [
        ("touch /usr/bin/new", "Read-only file system"),
        ("touch /usr/local/new", "Read-only file system"),
        ("mkdir /data", "Read-only file system"),
        ("echo 1 >/proc/sys/vm/drop_caches", "Read-only file system"),
        ("ls /var/run/docker.sock", "No such file"),
        (
            "cat /proc/self/status | while read a b; do [ \"$a\" = CapEff: ] && echo $b; done",
            "0000000000000000",
        ),
    ] {
        let answer = inside(command);
        assert!(answer.contains(words), "{command}: {answer}");
    }
}

#[actix_rt::test]
async fn memory_without_end_is_told_and_ended() {
    let Some(_docker) = docker().await else { return };
    let server = doing("sleep 1; perl -e 'my @a; push @a, \"x\" x 1000000 while 1' & wait $!; exit 137");
    let server = server.set("limits.memory", 64).start().await;
    is_told(&server, &arm(), "limits.memory").await;
    until("it is gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn forks_without_end_stay_few_and_end_with_the_client() {
    let Some(_docker) = docker().await else { return };
    let server = doing("(while :; do sleep 1000 & done) 2>/dev/null &").set("limits.processes", 60);
    let (server, client) = running(server).await;
    let webots = of_service(&server, "webots")[0].clone();
    let count = || ask(&["top", &webots]).lines().count();
    until("there are as many as there may be", async || count() >= 50).await;
    assert!(count() <= 62, "{}", count());
    client.leave().await;
    until("all are gone", async || containers(&server).is_empty()).await;
}

#[actix_rt::test]
async fn what_fills_the_project_is_told_and_ended() {
    let Some(_docker) = docker().await else { return };
    let server = doing("(sleep 1; dd if=/dev/zero of=/usr/local/webots-project/big bs=1M count=50 2>/dev/null) &");
    let server = server.set("limits.disk", 20).start().await;
    is_told(&server, &arm(), "limits.disk").await;
}

#[actix_rt::test]
async fn links_in_the_project_lead_no_other_container_astray() {
    let Some(_docker) = docker().await else { return };
    // Webots replaces the participant's folder by a symlink to files of the machine, and asks for a reset.
    let server = doing(
        "cd /usr/local/webots-project\nrm -rf controllers\nln -s /etc controllers\nln -s /etc c\n\
         while :; do echo .; echo reset; sleep 0.2; done",
    );
    let yml = "dockerCompose: \"competition:webots-project/controllers/c\"\n";
    let controller = format!("FROM {NAME}\nCOPY . /usr/local/webots-project/controllers\nCMD [\"sleep\", \"1000\"]\n");
    server.forge().commit(
        "lab/arm",
        "main",
        &[("webots.yml", yml), ("controllers/Dockerfile", &controller)],
    );
    let (server, _client) = running(server).await;
    let controller = of_service(&server, "controller")[0].clone();
    let starts = || ask(&["inspect", "--format", "{{.State.StartedAt}}", &controller]);
    let first = starts();
    until("the controller was started anew", async || starts() != first).await;
    let shown = ask(&["exec", &controller, "ls", "/usr/local/webots-project/controllers/c"]);
    assert_eq!(shown, "c.py");
}
