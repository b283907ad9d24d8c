//! A virtual display of a simulation's own.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};

use procfs::process::{FDTarget, Process};

use super::deeds::{as_nobody, open};
use super::limits::Delegated;
use crate::simulation::scene::{instance_folders, nothing_left};
use crate::support::{Client, DEMO, Server, Webots, demo_server, display, instances_below, needs, server_of, until};

/// The inodes of the sockets that a process has open.
fn sockets(pid: i32) -> Vec<u64> {
    let files = Process::new(pid).unwrap().fd().unwrap().flatten();
    files.filter_map(|file| if let FDTarget::Socket(inode) = file.target { Some(inode) } else { None }).collect()
}

fn xvfb(server: &Server) -> i32 {
    instances_below(&server.folder).into_iter().find(|(_, words)| words.contains("Xvfb -screen")).unwrap().0
}

fn namespace(pid: &str, name: &str) -> PathBuf {
    std::fs::read_link(format!("/proc/{pid}/ns/{name}")).unwrap()
}

#[actix_rt::test]
async fn a_virtual_display_is_inside_of_the_sandbox() {
    needs("Xvfb", "xvfb");
    needs("xset", "x11-xserver-utils");
    let mut users = vec![("root", "true")];
    users.extend(as_nobody().map(|nobody| ("nobody", nobody)));
    for (user, before) in users {
        let folder = tempfile::tempdir().unwrap();
        open(folder.path());
        // The cache is hidden from simulations.
        let fonts = folder.path().join("cache/fonts");
        let webots = Webots::script(&format!(
            "test -S /tmp/.X11-unix/X${{DISPLAY#:}} && echo 'DONE socket'\nxset q >/dev/null && echo 'DONE use it'\n\
             xset fp= {} && echo 'DONE read hidden fonts'\nXAUTHORITY=/dev/null xset q || echo 'DONE refuse others'\n\
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
            printed.contains("DONE refuse others")
        })
        .await;
        let done: Vec<&str> = printed.lines().filter_map(|line| line.strip_prefix("DONE ")).collect();
        assert_eq!(done, ["socket", "use it", "refuse others"], "{user}: {printed}");
        let pid = xvfb(&server);
        for name in ["pid", "mnt", "ipc"] {
            assert_ne!(namespace(&pid.to_string(), name), namespace("self", name), "{user}: {name}");
        }
        let own = sockets(pid);
        let unix = std::fs::read_to_string(format!("/proc/{pid}/net/unix")).unwrap();
        let is_own = |line: &&str| own.iter().any(|inode| line.split(' ').any(|word| word == inode.to_string()));
        let own_unix: Vec<&str> = unix.lines().filter(is_own).collect();
        assert!(own_unix.iter().any(|line| line.ends_with(" /tmp/.X11-unix/X99")), "{user}: {own_unix:?}");
        assert!(!own_unix.iter().any(|line| line.contains('@')), "{user}: {own_unix:?}");
        let listens = |one: &procfs::net::TcpNetEntry| own.contains(&one.inode);
        let process = Process::new(pid).unwrap();
        let tcp: Vec<_> = process.tcp().unwrap().into_iter().chain(process.tcp6().unwrap()).collect();
        assert!(!tcp.iter().any(listens), "{user}");
        client.leave().await;
        nothing_left(&server, 1).await;
        let has_ended = || Process::new(pid).and_then(|one| one.stat()).map_or(true, |stat| stat.state == 'Z');
        until("its display has ended", async || has_ended()).await;
    }
}

/// Has the display of a simulation take `MEMORY`, as long as the connection is open.
fn take_memory(server: &Server, level: &str) -> UnixStream {
    let instance = instance_folders(&server.folder).remove(0);
    let display =
        |(pid, _): (i32, String)| Process::new(pid).ok()?.environ().ok()?.remove(std::ffi::OsStr::new("DISPLAY"));
    let name = instances_below(&server.folder).into_iter().find_map(display).unwrap().into_string().unwrap();
    let root = if level == "sandbox" { instance.as_path() } else { Path::new("/") };
    let mut socket = UnixStream::connect(root.join("tmp/.X11-unix").join(name.replace(':', "X"))).unwrap();
    let authority = std::fs::read(instance.join("Xauthority")).unwrap();
    let greeting = b"l\0\x0b\0\0\0\x12\0\x10\0\0\0MIT-MAGIC-COOKIE-1\0\0".as_slice();
    socket.write_all(&[greeting, &authority[authority.len() - 16..]].concat()).unwrap();
    let mut head = [0; 8];
    socket.read_exact(&mut head).unwrap();
    assert_eq!(head[0], 1, "it takes this client");
    let mut setup = vec![0; 4 * usize::from(u16::from_le_bytes([head[6], head[7]]))];
    socket.read_exact(&mut setup).unwrap();
    let number = |at: usize| u32::from_le_bytes(setup[at..at + 4].try_into().unwrap());
    let vendor = usize::from(u16::from_le_bytes([setup[16], setup[17]])).next_multiple_of(4);
    // The first id that this client may give, and the window of the first screen, after the vendor's name and the formats.
    let (picture, window) = (number(4), number(32 + vendor + 8 * usize::from(setup[21])));
    // Four bytes each.
    let size = 8192 | u32::try_from(MEMORY / 4 / 8192).unwrap() << 16;
    let request = |code: u32, length: u32| code | length << 16;
    let picture_of_24_bits = [request(53, 4) | 24 << 8, picture, window, size];
    let tool_with_a_color = [request(55, 5), picture + 1, window, 4, u32::MAX];
    let rectangle = [request(70, 5), picture, picture + 1, 0, size];
    let what_is_answered = [request(43, 1)];
    for word in picture_of_24_bits.iter().chain(&tool_with_a_color).chain(&rectangle).chain(&what_is_answered) {
        socket.write_all(&word.to_le_bytes()).unwrap();
    }
    socket.read_exact(&mut [0; 32]).unwrap();
    socket
}

/// In bytes.
const MEMORY: u64 = 256 << 20;

/// What the monitor tells of the memory of the only simulation, in bytes.
async fn told_memory(server: &Server) -> u64 {
    let page = server.monitor().await;
    let cell = page.split_once("data-label=\"Memory\"").map_or("", |(_, cell)| cell);
    let value = cell.split_once("data-value=\"").and_then(|(_, value)| value.split_once('"'));
    value.map_or(0, |(value, _)| value.parse().unwrap())
}

#[actix_rt::test]
async fn what_a_virtual_display_takes_counts_for_its_simulation() {
    let _alone = display::alone().await;
    for level in ["sandbox", "none"] {
        let group = Delegated::new();
        let builder = demo_server(1).set("xvfb", true).set("isolation", level);
        let join = group.as_ref().map_or("true".to_owned(), Delegated::join);
        let server = builder.before(&join).start().await;
        let client = Client::ready(&server).await;
        let _connection = take_memory(&server, level);
        until("its memory counts", async || told_memory(&server).await >= MEMORY).await;
        if let Some(group) = &group {
            let own = group.groups().into_iter().find(|name| name.starts_with("simulation-")).unwrap();
            let folder = group.0.join(own);
            let inside = std::fs::read_to_string(folder.join("cgroup.procs")).unwrap();
            assert!(inside.lines().any(|pid| pid == xvfb(&server).to_string()), "{inside}");
            // Where systemd delegates this controller, it keeps `limits.memory`.
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
