//! A virtual display for each simulation.

use std::path::PathBuf;

use procfs::process::Process;

use super::deeds::{as_nobody, open};
use super::limits::Delegated;
use crate::simulation::scene::nothing_left;
use crate::support::wrapper::Wrapper;
use crate::support::{Client, DEMO, Server, Webots, demo_server, display, instances_below, server_of, until};

fn xvfb(server: &Server) -> i32 {
    instances_below(&server.folder)
        .into_iter()
        .find(|(_, words)| words.contains("Xvfb -screen"))
        .unwrap()
        .0
}

fn namespace(pid: &str, name: &str) -> PathBuf {
    std::fs::read_link(format!("/proc/{pid}/ns/{name}")).unwrap()
}

#[actix_rt::test]
async fn a_virtual_display_is_inside_of_the_sandbox() {
    needs!("bwrap");
    needs!("Xvfb");
    needs!("xset");
    let mut users = vec![("root", "true")];
    users.extend(as_nobody().map(|nobody| ("nobody", nobody)));
    for (user, before) in users {
        let folder = tempfile::tempdir().unwrap();
        open(folder.path());
        // Sandboxes hide the cache.
        let fonts = folder.path().join("cache/fonts");
        let webots = Webots::script(&format!(
            "test -S /tmp/.X11-unix/X${{DISPLAY#:}} && echo 'DONE socket'\nxset q >/dev/null && echo 'DONE use it'\n\
             xset fp= {} && echo 'DONE read hidden fonts'\ngrep '@/tmp/.X11-unix/X99' /proc/net/unix && echo 'DONE abstract'\n\
             (exec 3<>/dev/tcp/127.0.0.1/6099) && echo 'DONE TCP'\n\
             XAUTHORITY=/dev/null xset q || echo \"DONE refuse others at $DISPLAY\"\n\
             {DEMO} \"$@\" & wait",
            fonts.display()
        ));
        let builder = server_of(webots, 1).set("xvfb", true).set("isolation", "sandbox");
        let server = builder.folder(folder.path()).before(before).start().await;
        std::fs::create_dir_all(&fonts).unwrap();
        std::fs::write(fonts.join("fonts.dir"), "0\n").unwrap();
        let client = Client::ready(&server).await;
        let mut printed = String::new();
        until("all of its output is kept", async || {
            printed = std::fs::read_to_string(server.output_file(&client)).unwrap();
            printed.contains("DONE refuse others at ")
        })
        .await;
        let done: Vec<&str> = printed.lines().filter_map(|line| line.strip_prefix("DONE ")).collect();
        assert_eq!(done, ["socket", "use it", "refuse others at :99"], "{user}: {printed}");
        let pid = xvfb(&server);
        for name in ["pid", "mnt", "ipc"] {
            assert_ne!(
                namespace(&pid.to_string(), name),
                namespace("self", name),
                "{user}: {name}"
            );
        }
        client.leave().await;
        nothing_left(&server, 1).await;
        let has_ended = || {
            Process::new(pid)
                .and_then(|one| one.stat())
                .map_or(true, |stat| stat.state == 'Z')
        };
        until("its display has ended", async || has_ended()).await;
    }
}

/// Memory of a display with a screen of 8,192 by 8,192 pixels, in bytes.
const MEMORY: u64 = 256 << 20;

/// The memory of the only simulation on the monitor, in bytes.
async fn told_memory(server: &Server) -> u64 {
    let page = server.monitor().await;
    let cell = page.split_once("data-label=\"Memory\"").map_or("", |(_, cell)| cell);
    let value = cell
        .split_once("data-value=\"")
        .and_then(|(_, value)| value.split_once('"'));
    value.map_or(0, |(value, _)| value.parse().unwrap())
}

#[actix_rt::test]
async fn what_a_virtual_display_takes_counts_for_its_simulation() {
    needs!("Xvfb");
    let _alone = display::alone().await;
    let large = Wrapper::of("Xvfb", "set -- \"${@/1280x1024x24/8192x8192x24}\"");
    for level in ["sandbox", "none"] {
        let group = Delegated::new();
        let builder = demo_server(1)
            .set("xvfb", true)
            .set("isolation", level)
            .env("PATH", &large.path());
        let join = group.as_ref().map_or("true".to_owned(), Delegated::join);
        let server = builder.before(&join).start().await;
        let client = Client::ready(&server).await;
        until("its memory counts", async || told_memory(&server).await >= MEMORY).await;
        if let Some(group) = &group {
            let own = group
                .groups()
                .into_iter()
                .find(|name| name.starts_with("simulation-"))
                .unwrap();
            let folder = group.0.join(own);
            let inside = std::fs::read_to_string(folder.join("cgroup.procs")).unwrap();
            assert!(inside.lines().any(|pid| pid == xvfb(&server).to_string()), "{inside}");
            // If systemd delegates this controller, it enforces `limits.memory`.
            if let Ok(memory) = std::fs::read_to_string(folder.join("memory.current")) {
                assert!(memory.trim().parse::<u64>().unwrap() >= MEMORY, "{memory}");
            }
        }
        let pid = xvfb(&server);
        client.leave().await;
        nothing_left(&server, 1).await;
        let is_alive = |pid| Process::new(pid).is_ok_and(|one| one.is_alive());
        until("it has ended", async || !is_alive(pid)).await;
    }
}
