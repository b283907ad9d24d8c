//! What a network of its own keeps a world's program from, and what it allows. Each deed is also tried without it.
//!
//! pasta creates none for root: as root, a test runs the server as another user.

use std::os::linux::net::SocketAddrExt;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::path::Path;

use nix::sched::{CloneFlags, unshare};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::deeds::{Stage, as_nobody};
use crate::simulation::scene::{gone_within, nothing_left};
use crate::support::client::Heard;
use crate::support::name_server::NameServer;
use crate::support::{
    Builder, Client, DEMO, Server, Webots, arm, display, instances_below, is_told, programs, skip, until,
};

/// The command that runs a server as an ordinary user with own networks; `None`, with a reason printed, if none can.
fn ordinary() -> Option<&'static str> {
    needs!("bwrap", None);
    needs!("pasta", None);
    let mode = |device: &Path| device.metadata().map_or(0, |data| data.permissions().mode());
    if mode(Path::new("/dev/net/tun")) & 0o006 != 0o006 {
        skip("an ordinary user can't open /dev/net/tun here");
        return None;
    }
    if nix::unistd::getuid().is_root() {
        as_nobody()
    } else {
        Some("true")
    }
}

/// The isolations of a simulation: level, command that runs the server, and network.
pub fn levels() -> Vec<(&'static str, &'static str, &'static str)> {
    let mut levels = vec![("none", "true", "shared"), ("sandbox", "true", "shared")];
    levels.extend(ordinary().map(|user| ("sandbox", user, "own")));
    levels
}

/// A server of an ordinary user, with this network for its sandboxes.
fn server(stage: &Stage, webots: &Webots, user: &str, network: &str) -> Builder {
    stage
        .builder(webots, "sandbox")
        .before(user)
        .set("sandbox.network", network)
}

/// Sets `port` in a shell to the value of the option `--port`.
const PORT: &str = "for one; do case $one in --port=*) port=${one#--port=};; esac; done";

/// A deed as a shell command: a line of Python in which `s` is the module `socket`.
fn python(line: &str) -> String {
    format!("python3 -c \"import os, socket as s, errno; {line}\"")
}

#[actix_rt::test]
async fn a_world_in_its_own_network_reaches_nothing_of_the_machine() {
    let Some(user) = ordinary() else { return };
    let stage = Stage::new();
    let name = format!("fleet-test-{}", rand::random::<u64>());
    let _abstract = UnixListener::bind_addr(&SocketAddr::from_abstract_name(&name).unwrap()).unwrap();
    let four = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let six = std::net::TcpListener::bind("[::1]:0");
    let port = four.local_addr().unwrap().port();
    let mut deeds = vec![
        (
            "reach a port of the machine",
            python(&format!("s.create_connection(('127.0.0.1', {port}), 5)")),
        ),
        (
            "reach an abstract socket",
            python(&format!("s.socket(s.AF_UNIX).connect('\\\\0{name}')")),
        ),
        ("pass for a trusted proxy", {
            // The server's own port is one below the first slot's.
            let request = "GET /load HTTP/1.1\\r\\nHost: x\\r\\nX-Forwarded-For: 192.0.2.7\\r\\n\\r\\n";
            let ask = format!("c = s.create_connection(('127.0.0.1', $port - 1), 5); c.send(b'{request}')");
            format!("{PORT}\n{}", python(&format!("{ask}; assert b'200 OK' in c.recv(99)")))
        }),
        (
            "use its own loopback",
            python("l = s.create_server(('127.0.0.1', 0)); s.create_connection(l.getsockname(), 5)"),
        ),
        (
            "hold a socket of the machine",
            python(
                "assert any('socket:' in os.readlink('/proc/self/fd/' + n) for n in os.listdir('/proc/self/fd') if os.path.islink('/proc/self/fd/' + n))",
            ),
        ),
        (
            "be kept from private addresses",
            python("c = s.socket(); c.settimeout(5); assert c.connect_ex(('10.255.255.254', 9)) == errno.ECONNREFUSED"),
        ),
        (
            "be kept from the internet",
            python("c = s.socket(); c.settimeout(5); assert c.connect_ex(('203.0.113.7', 9)) == errno.ECONNREFUSED"),
        ),
    ];
    if let Ok(six) = &six {
        let port = six.local_addr().unwrap().port();
        deeds.push((
            "reach a port of the machine by IPv6",
            python(&format!("s.create_connection(('::1', {port}), 5)")),
        ));
    }
    let tried = async |network: &str| -> Vec<String> {
        let change = |builder: Builder| builder.before(user).set("sandbox.network", network);
        stage
            .tried(&deeds, "sandbox", |builder| {
                change(builder).set("limits.output", 10_000)
            })
            .await
    };
    let own = tried("own").await;
    let free = |name: &String| name != "be kept from the internet";
    assert_eq!(
        own.into_iter().filter(free).collect::<Vec<_>>(),
        ["use its own loopback", "be kept from private addresses"]
    );
    let all = [
        "use its own loopback",
        "be kept from private addresses",
        "be kept from the internet",
    ];
    assert_eq!(tried("closed").await, all);
    let shared = tried("shared").await;
    let mut reached = vec![
        "reach a port of the machine",
        "reach an abstract socket",
        "pass for a trusted proxy",
    ];
    reached.extend(six.is_ok().then_some("reach a port of the machine by IPv6"));
    for deed in reached {
        assert!(shared.iter().any(|one| one == deed), "{deed}: {shared:?}");
    }
}

/// Listens on the next two streaming ports, and hides its descriptors from a server of an ordinary user.
const TAKES_ALL: &str = "python3 -c \"import ctypes, socket, time; ctypes.CDLL(None).prctl(4, 0); \
    s = [socket.create_server(('0.0.0.0', p)) for p in range($port + 1, $port + 3)]; print('TAKEN'); time.sleep(1000)\" &";

#[actix_rt::test]
async fn who_takes_all_ports_in_its_own_network_keeps_nobody_out() {
    let Some(user) = ordinary() else { return };
    for network in ["own", "shared"] {
        let stage = Stage::new();
        let webots = Webots::script(&format!(
            "export PYTHONUNBUFFERED=1\n{PORT}\n{TAKES_ALL}\n{DEMO} \"$@\" & wait"
        ));
        let server = server(&stage, &webots, user, network)
            .set("maxConnections", 3)
            .start()
            .await;
        let first = Client::ready(&server).await;
        let log = server.output_file(&first);
        until("all are taken", async || {
            std::fs::read_to_string(&log).is_ok_and(|text| text.contains("TAKEN"))
        })
        .await;
        let mut second = Client::start(&server, &arm()).await;
        let outcome = loop {
            match second.next().await {
                Heard::Text(text) if text.starts_with("webots:") => break "own",
                Heard::Text(text) if text.starts_with("queue:") => break "shared",
                Heard::Text(_) => {}
                Heard::Closed(frame) => panic!("closed: {frame:?}"),
            }
        };
        assert_eq!(outcome, network, "own: it runs, shared: it waits");
        first.leave().await;
        second.leave().await;
        nothing_left(&server, 3).await;
    }
}

#[actix_rt::test]
async fn a_display_can_be_reached_at_each_level() {
    needs!("Xvfb");
    let _alone = display::alone().await;
    needs!("xhost");
    let deeds = [
        ("use the display", "xhost".to_owned()),
        ("use it without its authority", "XAUTHORITY=/dev/null xhost".to_owned()),
    ];
    for (level, user, network) in levels() {
        let change = |builder: Builder| builder.before(user).set("sandbox.network", network).set("xvfb", true);
        assert_eq!(
            Stage::new().tried(&deeds, level, change).await,
            ["use the display"],
            "{level}, {network}"
        );
    }
}

/// The processes of a server's simulations, without the server itself.
fn all_of(server: &Server) -> Vec<(i32, String)> {
    instances_below(&server.folder)
        .into_iter()
        .filter(|(pid, _)| *pid != server.pid())
        .collect()
}

#[actix_rt::test]
async fn pasta_ends_with_its_simulation_and_with_the_server() {
    let Some(user) = ordinary() else { return };
    for end in ["client", "pasta", "server"] {
        let stage = Stage::new();
        let webots = Webots::script(&format!("(env -i setsid sleep 1000 &)\n{DEMO} \"$@\" & wait"));
        let mut server = server(&stage, &webots, user, "own")
            .set("maxConnections", 1)
            .start()
            .await;
        let mut client = Client::ready(&server).await;
        let parent = server.pid();
        let is_pasta = |one: &procfs::process::Process| {
            one.stat()
                .is_ok_and(|stat| stat.ppid == parent && stat.comm.starts_with("pas"))
        };
        let all = || procfs::process::all_processes().unwrap().flatten();
        let pasta = all().find(is_pasta).unwrap().pid();
        let inside = procfs::process::Process::new(pasta)
            .unwrap()
            .task_main_thread()
            .unwrap()
            .children()
            .unwrap();
        match end {
            "pasta" => {
                kill(Pid::from_raw(pasta), Signal::SIGKILL).unwrap();
                let told = client.until("loading: Error:").await;
                assert!(told.contains("Webots was ended by the signal SIGKILL"), "{told}");
                nothing_left(&server, 1).await;
            }
            "server" => {
                // The guardian, which would end pasta a moment later, is killed too.
                kill(Pid::from_raw(server.guardian()), Signal::SIGKILL).unwrap();
                server.signal(Signal::SIGKILL);
                server.ended().await;
            }
            _ => {
                let left = std::time::Instant::now();
                client.leave().await;
                gone_within(0.5, left, &server).await;
            }
        }
        until("nothing runs", async || {
            all_of(&server).is_empty() && !all().any(|one| is_pasta(&one))
        })
        .await;
        let lives =
            |pid: &u32| procfs::process::Process::new(i32::try_from(*pid).unwrap()).is_ok_and(|one| one.is_alive());
        until("bubblewrap has ended", async || !inside.iter().any(lives)).await;
    }
}

#[actix_rt::test]
async fn how_a_program_has_ended_is_told_from_its_own_network() {
    let Some(user) = ordinary() else { return };
    let stage = Stage::new();
    for (script, words) in [
        ("exit 7", "Webots ended with exit code 7. "),
        ("echo LAST; exit 7", ". Its last output: LAST"),
        ("kill -SEGV $$", "Webots was ended by the signal SIGSEGV"),
    ] {
        let webots = Webots::script(script);
        let server = server(&stage, &webots, user, "own").start().await;
        is_told(&server, &arm(), words).await;
    }
}

#[actix_rt::test]
async fn which_network_simulations_have_is_told() {
    let Some(user) = ordinary() else { return };
    let names = [
        "git", "bash", "env", "sh", "setpriv", "bwrap", "prlimit", "unshare", "pasta",
    ];
    let all = programs(&names);
    let none = programs(&names[..8]);
    let path = |folder: &tempfile::TempDir| folder.path().to_str().unwrap().to_owned();
    for (network, path, shown, words) in [
        (
            "auto",
            path(&all),
            "own",
            "own, with the internet by TCP, without this machine and private addresses",
        ),
        ("closed", path(&all), "closed", "closed, nothing can be reached"),
        ("shared", path(&all), "shared", "shared with this machine"),
        (
            "auto",
            path(&none),
            "shared",
            "shared with this machine: pasta is not there; on Debian",
        ),
    ] {
        let stage = Stage::new();
        let webots = Webots::script("exit 1");
        let setpriv = user.replace("setpriv", "/usr/bin/setpriv");
        let server = server(&stage, &webots, &setpriv, network)
            .env("PATH", &path)
            .start()
            .await;
        assert_eq!(server.status().await["network"], shown);
        let page = server.monitor().await;
        assert!(page.contains(&format!("<dd>{words}")), "{page}");
        assert!(
            server.log().contains(&format!("network of simulations: {words}")),
            "{}",
            server.log()
        );
    }
    let stage = Stage::new();
    let webots = Webots::script("exit 1");
    let setpriv = user.replace("setpriv", "/usr/bin/setpriv");
    let told = server(&stage, &webots, &setpriv, "own")
        .env("PATH", &path(&none))
        .refused(1)
        .await;
    assert!(told.contains("but pasta is not there"), "{told}");
}

#[actix_rt::test]
async fn a_machine_with_one_version_of_ip_has_own_networks() {
    let Some(user) = ordinary() else { return };
    for (ip, address, route) in [
        ("ip -6", "2001:db8::2/64", "2001:db8::1"),
        ("ip -4", "192.0.2.2/24", "192.0.2.1"),
    ] {
        // From here on, this thread starts programs in a network namespace with only this address and route.
        if unshare(CloneFlags::CLONE_NEWNET).is_err() {
            return skip("only root can make a network namespace");
        }
        let script = format!(
            "ip link set lo up && ip link add out type veth peer name far && ip link set far up && sysctl -qw net.ipv6.conf.out.accept_dad=0 && \
             {ip} address add {address} dev out && ip link set out up && {ip} route add default via {route}"
        );
        let made = std::process::Command::new("sh")
            .args(["-ec", &script])
            .output()
            .unwrap();
        if !made.status.success() {
            return skip(&format!("no network: {}", String::from_utf8_lossy(&made.stderr)));
        }
        for streaming in ["direct", "relay"] {
            let stage = Stage::new();
            let webots = Webots::script(&format!("{DEMO} \"$@\" & wait"));
            // `::` stands for the addresses of this namespace.
            let server = server(&stage, &webots, user, "own")
                .set("streaming", streaming)
                .set("bind", "::");
            let server = server.env("DEMO_SIMULATOR_BIND", "::").start().await;
            let client = Client::ready(&server).await;
            client.leave().await;
            nothing_left(&server, 2).await;
        }
    }
}

/// An address that stands for one on the internet, and the port there of a service that answers each datagram.
const OUTSIDE: &str = "198.51.100.7";
const ANSWERS: u16 = 4000;
/// The source ports of datagrams: one that no program of the machine has, one of a service, one of another simulation.
const FREE: u16 = 5353;
const OF_SERVICE: u16 = 5354;
const OF_OTHER: u16 = 5355;

/// Moves this thread, and what it starts, to a machine of its own with one address on the internet. Returns false, with
/// a reason printed, if that is not allowed.
fn move_to_own_machine() -> bool {
    if unshare(CloneFlags::CLONE_NEWNET).is_err() {
        skip("only root can make a network namespace");
        return false;
    }
    let script = format!(
        "ip link set lo up && ip address add {OUTSIDE}/32 dev lo && ip link add out type veth peer name far && \
         ip link set far up && ip address add 192.0.2.2/24 dev out && ip link set out up && ip route add default via 192.0.2.1"
    );
    let made = std::process::Command::new("sh")
        .args(["-ec", &script])
        .output()
        .unwrap();
    if !made.status.success() {
        skip(&format!("no network: {}", String::from_utf8_lossy(&made.stderr)));
    }
    made.status.success()
}

/// Answers each datagram outside, and sends datagrams to services of the machine, on a thread of its own. The result is
/// the largest number of UDP ports that were in use.
fn answer_and_send(until: std::sync::mpsc::Receiver<()>) -> std::thread::JoinHandle<usize> {
    let outside = std::net::UdpSocket::bind((OUTSIDE, ANSWERS)).unwrap();
    outside
        .set_read_timeout(Some(std::time::Duration::from_millis(10)))
        .unwrap();
    // Services that share their port with others, as those of mDNS do, lose it to who binds it last.
    let service = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::DGRAM, None).unwrap();
    service.set_reuse_address(true).unwrap();
    let everywhere: std::net::SocketAddr = (std::net::Ipv4Addr::UNSPECIFIED, OF_SERVICE).into();
    service.bind(&everywhere.into()).unwrap();
    let stranger = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    std::thread::spawn(move || {
        let mut most = 0;
        while until.try_recv() == Err(std::sync::mpsc::TryRecvError::Empty) {
            stranger.send_to(b"stranger", ("127.0.0.1", FREE)).ok();
            stranger.send_to(b"for the service", ("127.0.0.1", OF_SERVICE)).ok();
            let mut question = [0; 99];
            for _ in 0..100 {
                let Ok((length, from)) = outside.recv_from(&mut question) else {
                    break;
                };
                outside.send_to(&question[..length], from).ok();
            }
            let used = std::fs::read_to_string("/proc/thread-self/net/udp").unwrap();
            most = most.max(used.lines().count());
        }
        drop(service);
        most
    })
}

/// A deed: sends a datagram outside from this port, and receives this one.
fn receives(port: u16, text: &str) -> String {
    python(&format!(
        "u = s.socket(s.AF_INET, s.SOCK_DGRAM); u.bind(('', {port})); u.settimeout(5); \
         u.sendto(b'second', ('{OUTSIDE}', {ANSWERS})); assert any(u.recv(99) == b'{text}' for n in range(99))"
    ))
}

#[actix_rt::test]
async fn a_world_in_its_own_network_gets_and_sends_no_datagram() {
    let Some(user) = ordinary() else { return };
    if !move_to_own_machine() {
        return;
    }
    let (stop, until_stopped) = std::sync::mpsc::channel();
    let machine = answer_and_send(until_stopped);
    let first = format!(
        "u = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); u.bind(('', {OF_OTHER}))\nwhile True:\n try: u.sendto(b'first', ('{OUTSIDE}', {ANSWERS}))\n \
         except OSError: pass\n time.sleep(0.02)"
    );
    let first = Webots::script(&format!(
        "python3 -c \"import socket, time\n{first}\" &\n{DEMO} \"$@\" & wait"
    ));
    let first_stage = Stage::new();
    let first_server = server(&first_stage, &first, user, "own").start().await;
    let first_client = Client::ready(&first_server).await;

    let many = "l = [s.socket(s.AF_INET, s.SOCK_DGRAM) for n in range(900)]";
    let deeds = [
        ("get a datagram of a stranger", receives(FREE, "stranger")),
        ("get a datagram for a service", receives(OF_SERVICE, "for the service")),
        ("get an answer to another simulation", receives(OF_OTHER, "first")),
        (
            "take the ports of the machine",
            python(&format!(
                "{many}; [u.sendto(b'x', ('{OUTSIDE}', {ANSWERS})) for u in l]"
            )),
        ),
        (
            "be refused at once",
            python(&format!(
                "assert s.socket(s.AF_INET, s.SOCK_DGRAM).connect_ex(('{OUTSIDE}', {ANSWERS})) == 0; \
                 u = s.socket(s.AF_INET, s.SOCK_DGRAM)\ntry: u.sendto(b'x', ('{OUTSIDE}', {ANSWERS}))\nexcept PermissionError: exit(0)\nexit(1)"
            )),
        ),
        (
            "send datagrams to itself",
            python(
                "u = s.socket(s.AF_INET, s.SOCK_DGRAM); u.bind(('127.0.0.1', 0)); u.sendto(b'x', u.getsockname()); u.settimeout(5); u.recv(9)",
            ),
        ),
    ];
    let stage = Stage::new();
    let done = stage.tried(&deeds, "sandbox", |builder| {
        builder
            .before(user)
            .set("sandbox.network", "own")
            .set("limits.output", 10_000)
    });
    let done = done.await;
    first_client.leave().await;
    nothing_left(&first_server, 2).await;
    stop.send(()).unwrap();
    let ports = machine.join().unwrap();
    assert_eq!(done, ["be refused at once", "send datagrams to itself"]);
    assert!(ports < 100, "{ports} ports of the machine were in use");
}

#[actix_rt::test]
async fn the_connections_of_a_world_are_bounded_in_its_own_network() {
    let Some(user) = ordinary() else { return };
    if !move_to_own_machine() {
        return;
    }
    let listener = std::net::TcpListener::bind((OUTSIDE, ANSWERS)).unwrap();
    // It ends with the test.
    std::thread::spawn(move || listener.incoming().collect::<Vec<_>>());
    let hold = |number| {
        python(&format!(
            "l = [s.create_connection(('{OUTSIDE}', {ANSWERS}), 5) for n in range({number})]"
        ))
    };
    let deeds = [("hold some", hold(100)), ("hold a thousand", hold(1000))];
    let stage = Stage::new();
    let done = stage.tried(&deeds, "sandbox", |builder| {
        builder.before(user).set("sandbox.network", "own")
    });
    assert_eq!(done.await, ["hold some"]);
}

#[actix_rt::test]
async fn names_are_resolved_in_own_networks() {
    let Some(user) = ordinary() else { return };
    let Some(names) = NameServer::start() else { return };
    // Too many for a datagram of 512 bytes.
    let addresses: Vec<std::net::IpAddr> = (1..=60).map(|last| [198, 51, 100, last].into()).collect();
    names.set("arms.test", &addresses);
    if !nix::unistd::getuid().is_root() {
        return skip("only root can give the server another name server and another user");
    }
    let asked = names.asked().replace("&& exec \"$0\" \"$@\"", &format!("&& {user}"));
    let resolve = "assert len({a[4][0] for a in s.getaddrinfo('arms.test', 80)}) == 60";
    let deeds = [
        ("resolve a name", python(resolve)),
        (
            "resolve it a hundred times",
            python(&format!(
                "[s.getaddrinfo('arms.test', 80) for n in range(100)]; {resolve}"
            )),
        ),
        (
            "ask much at once",
            python("l = [s.create_connection(('127.0.0.1', 53), 5) for n in range(20)]"),
        ),
    ];
    for (network, expected) in [
        ("own", &["resolve a name", "resolve it a hundred times"][..]),
        ("closed", &[]),
    ] {
        let stage = Stage::new();
        let done = stage.tried(&deeds, "sandbox", |builder| {
            builder.before(&asked).set("sandbox.network", network)
        });
        assert_eq!(done.await, expected, "{network}");
    }
}
