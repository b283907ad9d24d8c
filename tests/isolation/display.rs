//! A virtual display of a simulation's own.

use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};

use procfs::process::{FDTarget, Process};
use x11rb::connection::Connection;
use x11rb::protocol::xproto::{ConnectionExt, CreateGCAux, Rectangle};
use x11rb::rust_connection::{DefaultStream, RustConnection};

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
fn take_memory(server: &Server, level: &str) -> RustConnection<DefaultStream> {
    let instance = instance_folders(&server.folder).remove(0);
    let display =
        |(pid, _): (i32, String)| Process::new(pid).ok()?.environ().ok()?.remove(std::ffi::OsStr::new("DISPLAY"));
    let name = instances_below(&server.folder).into_iter().find_map(display).unwrap().into_string().unwrap();
    let root = if level == "sandbox" { instance.as_path() } else { Path::new("/") };
    let socket = UnixStream::connect(root.join("tmp/.X11-unix").join(name.replace(':', "X"))).unwrap();
    let authority = std::fs::read(instance.join("Xauthority")).unwrap();
    let cookie = authority[authority.len() - 16..].to_vec();
    let (stream, _) = DefaultStream::from_unix_stream(socket).unwrap();
    let method = b"MIT-MAGIC-COOKIE-1".to_vec();
    let connection = RustConnection::connect_to_stream_with_auth_info(stream, 0, method, cookie).unwrap();
    let screen = &connection.setup().roots[0];
    let [picture, tool] = [connection.generate_id().unwrap(), connection.generate_id().unwrap()];
    // Four bytes each.
    let (width, height) = (8192, u16::try_from(MEMORY / 4 / 8192).unwrap());
    connection.create_pixmap(screen.root_depth, picture, screen.root, width, height).unwrap();
    connection.create_gc(tool, picture, &CreateGCAux::new().foreground(screen.white_pixel)).unwrap();
    connection.poly_fill_rectangle(picture, tool, &[Rectangle { x: 0, y: 0, width, height }]).unwrap();
    connection.get_input_focus().unwrap().reply().unwrap();
    connection
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
