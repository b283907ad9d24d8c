//! `deploy/nftables/containers.nft` in network namespaces: what containers reach with it and without it.

use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::fd::AsRawFd;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use nix::sched::{CloneFlags, setns, unshare};
use webots_fleet::simulation::container::packet_filter;

use crate::support::{SOON, skip};

/// Metadata services of clouds, carrier-grade NAT and private networks.
const SPECIAL: [&str; 4] = ["169.254.169.254", "168.63.129.16", "100.64.0.9", "10.9.9.9"];

/// A network namespace.
struct Place(File);

impl Place {
    /// `None` if this process may not create one.
    fn new() -> Option<Self> {
        let made = std::thread::spawn(|| {
            unshare(CloneFlags::CLONE_NEWNET).ok()?;
            Some(Self(File::open("/proc/thread-self/ns/net").unwrap()))
        });
        made.join().unwrap()
    }

    /// Runs a function in the namespace. Processes that it starts and sockets that it opens stay there.
    fn within<T: Send>(&self, act: impl FnOnce() -> T + Send) -> T {
        std::thread::scope(|scope| {
            let there = scope.spawn(|| {
                setns(&self.0, CloneFlags::CLONE_NEWNET).unwrap();
                act()
            });
            there.join().unwrap()
        })
    }

    /// Runs shell commands in the namespace, one per line.
    fn run(&self, commands: &str) {
        let script = format!("set -eu\n{commands}");
        let output = self.within(|| Command::new("sh").args(["-xc", &script]).output().unwrap());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }

    /// Its name for `ip`.
    fn name(&self) -> String {
        format!("/proc/{}/fd/{}", std::process::id(), self.0.as_raw_fd())
    }

    /// Runs nft in the namespace; returns whether it succeeds.
    fn nft(&self, arguments: &[&str]) -> bool {
        let output = self.within(|| Command::new("/usr/sbin/nft").args(arguments).output().unwrap());
        print!("{}", String::from_utf8_lossy(&output.stderr));
        output.status.success()
    }

    fn listen(&self, address: &str) -> TcpListener {
        self.within(|| TcpListener::bind(address).unwrap())
    }

    fn connect(&self, address: &str) -> io::Result<TcpStream> {
        let address: SocketAddr = address.parse().unwrap();
        self.within(|| TcpStream::connect_timeout(&address, SOON))
    }

    /// Whether a connection succeeds. Panics on a timeout: a filter must reject at once, or programs would wait for minutes.
    fn reaches(&self, address: &str) -> bool {
        match self.connect(address) {
            Ok(_) => true,
            Err(error) if error.kind() == ErrorKind::ConnectionRefused => false,
            Err(error) => panic!("{address}: {error}"),
        }
    }

    /// Whether datagrams from here arrive at a socket elsewhere (true), or are rejected (false).
    fn sends(&self, address: &str, to: &UdpSocket) -> bool {
        let from = self.within(|| UdpSocket::bind("0.0.0.0:0").unwrap());
        from.connect(address).unwrap();
        for socket in [&from, to] {
            socket.set_read_timeout(Some(Duration::from_millis(10))).unwrap();
        }
        // Datagrams of other sockets may still be in transit.
        let own = from.local_addr().unwrap().port();
        let arrives = || to.recv_from(&mut [0; 8]).is_ok_and(|(_, sender)| sender.port() == own);
        // The error of a rejected datagram is reported at a later call.
        let is_told = |result: io::Result<usize>| result.is_err_and(|error| error.kind() == ErrorKind::HostUnreachable);
        let deadline = Instant::now() + SOON;
        while Instant::now() < deadline {
            if is_told(from.send(b"word")) || is_told(from.recv(&mut [0; 8])) {
                return false;
            }
            if arrives() {
                return true;
            }
        }
        panic!("{address}: neither a datagram nor a word");
    }
}

/// Two containers on the open network, one on the closed one, and the machine, lab and internet around them.
struct Network {
    machine: Place,
    container: Place,
    neighbour: Place,
    closed: Place,
    lab: Place,
    internet: Place,
}

impl Network {
    /// `None`, with a message, if it can't be created.
    fn new() -> Option<Self> {
        needs!("ip", None);
        let Some(machine) = Place::new() else {
            skip("only root may make networks");
            return None;
        };
        let forwards = [
            "/proc/sys/net/ipv4/ip_forward",
            "/proc/sys/net/ipv6/conf/all/forwarding",
        ];
        if !machine.within(|| forwards.iter().all(|file| std::fs::write(file, "1").is_ok())) {
            skip("this machine does not forward");
            return None;
        }
        if !Path::new("/usr/sbin/nft").exists() || !machine.nft(&["add", "table", "inet", "probe"]) {
            skip("there is no nft, or the kernel has no nftables");
            return None;
        }
        let place = || Place::new().unwrap();
        let container = place();
        let neighbour = place();
        let closed = place();
        let network = Self {
            machine,
            container,
            neighbour,
            closed,
            lab: place(),
            internet: place(),
        };
        network.lay_cables();
        Some(network)
    }

    fn lay_cables(&self) {
        self.machine.run(
            "ip link set lo up
            ip link add webots-fleet type bridge
            ip link add webots-closed type bridge
            ip link set webots-fleet up
            ip link set webots-closed up
            ip address add 172.30.0.1/24 dev webots-fleet
            ip address add fd00:30::1/64 dev webots-fleet nodad
            ip address add 172.31.0.1/24 dev webots-closed
            ip address add fd00:31::1/64 dev webots-closed nodad",
        );
        self.cable(&self.container, "container", "master webots-fleet");
        self.cable(&self.neighbour, "neighbour", "master webots-fleet");
        self.cable(&self.closed, "closed", "master webots-closed");
        self.cable(&self.lab, "lab", "up");
        self.cable(&self.internet, "internet", "up");
        self.machine.run(
            "ip address add 192.168.77.1/24 dev lab
            ip address add fd00:77::1/64 dev lab nodad
            ip address add 203.0.113.1/24 dev internet
            ip address add 2001:db8::1/64 dev internet nodad",
        );
        for (place, address, prefix, host) in [
            (&self.container, "172.30.0", "fd00:30", 2),
            (&self.neighbour, "172.30.0", "fd00:30", 3),
            (&self.closed, "172.31.0", "fd00:31", 2),
            (&self.lab, "192.168.77", "fd00:77", 2),
            (&self.internet, "203.0.113", "2001:db8", 2),
        ] {
            place.run(&format!(
                "ip address add {address}.{host}/24 dev eth0
                ip address add {prefix}::{host}/64 dev eth0 nodad
                ip route add default via {address}.1
                ip route add default via {prefix}::1"
            ));
        }
        for address in SPECIAL {
            self.internet.run(&format!("ip address add {address}/32 dev eth0"));
            self.machine.run(&format!("ip route add {address} dev internet"));
        }
        // As Docker does for published ports.
        self.machine.run(
            "nft add table ip ports
            nft 'add chain ip ports arriving { type nat hook prerouting priority dstnat; }'
            nft add rule ip ports arriving iifname internet tcp dport 2001 dnat to 172.30.0.2
            nft add rule ip ports arriving iifname internet tcp dport 2002 dnat to 172.31.0.2:2001",
        );
    }

    /// Connects a namespace to the machine.
    fn cable(&self, place: &Place, device: &str, how: &str) {
        self.machine.run(&format!(
            "ip link add {device} type veth peer name eth0 netns {}
            ip link set {device} {how}
            ip link set {device} up",
            place.name()
        ));
        place.run("ip link set lo up\nip link set eth0 up");
    }

    fn load(&self) {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/nftables/containers.nft");
        assert!(self.machine.nft(&["-f", file.to_str().unwrap()]));
    }

    /// Runs what the systemd unit runs when it stops.
    fn unload(&self) {
        let file =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/systemd/system/webots-fleet-packet-filter.service");
        let unit = std::fs::read_to_string(file).unwrap();
        let command = unit.lines().find_map(|line| line.strip_prefix("ExecStop=")).unwrap();
        self.machine.run(command);
    }
}

/// Whether a word arrives at the other end of a connection.
fn arrives(mut from: &TcpStream, mut to: &TcpStream) -> bool {
    let mut heard = [0; 4];
    to.set_read_timeout(Some(SOON)).unwrap();
    from.write_all(b"word").is_ok() && to.read_exact(&mut heard).is_ok() && &heard == b"word"
}

#[test]
fn containers_reach_the_internet_and_nothing_near() {
    let Some(network) = Network::new() else { return };
    let Network {
        machine,
        container,
        neighbour,
        closed,
        lab,
        internet,
    } = &network;
    // They accept IPv4 and IPv6. Port 2001 of the machine stands in for Docker's proxy.
    let web = internet.listen("[::]:80");
    let _servers = [
        machine.listen("[::]:22"),
        machine.listen("[::]:2001"),
        lab.listen("[::]:80"),
        lab.listen("[::]:3128"),
        lab.listen("[::]:53"),
    ];
    let _controllers = [container, neighbour, closed].map(|place| place.listen("[::]:2001"));
    let [names, clock] = [53, 123].map(|port| lab.within(|| UdpSocket::bind(("0.0.0.0", port)).unwrap()));

    let far = ["203.0.113.2:80", "[2001:db8::2]:80"];
    let asked = "192.168.77.2:53";
    let mut near: Vec<String> = SPECIAL.iter().map(|address| format!("{address}:80")).collect();
    near.extend(["192.168.77.2:80", "192.168.77.2:3128", "[fd00:77::2]:80"].map(str::to_owned));
    for address in [
        "172.30.0.1",
        "172.31.0.1",
        "192.168.77.1",
        "203.0.113.1",
        "[fd00:30::1]",
        "[2001:db8::1]",
    ] {
        near.extend([format!("{address}:22"), format!("{address}:2001")]);
    }
    let beside = |from: &Place| {
        if std::ptr::eq(from, closed) {
            "172.30.0.2:2001"
        } else {
            "172.31.0.2:2001"
        }
    };

    // Without the filter everything is reachable, so only the filter blocks later.
    for from in [container, closed] {
        for address in near.iter().map(String::as_str).chain(far).chain([asked, beside(from)]) {
            assert!(from.reaches(address), "{address} without the filter");
        }
        assert!(from.sends(asked, &names) && from.sends("192.168.77.2:123", &clock));
    }
    assert!(machine.within(packet_filter::missing).unwrap().contains("not loaded"));
    let lasting = container.connect("203.0.113.2:80").unwrap();
    let here = lasting.local_addr().unwrap();
    let is_same = |one: SocketAddr| (one.ip().to_canonical(), one.port()) == (here.ip(), here.port());
    // Skips the earlier connections.
    let lasting_end = web
        .incoming()
        .map(Result::unwrap)
        .find(|one| is_same(one.peer_addr().unwrap()))
        .unwrap();

    let is_kept = |exceptions: &[&str]| {
        for from in [container, closed] {
            for address in near.iter().map(String::as_str).chain([beside(from)]) {
                let excepted = exceptions.contains(&address) && std::ptr::eq(from, container);
                assert_eq!(from.reaches(address), excepted, "{address} with the filter");
            }
            assert!(!from.sends("192.168.77.2:123", &clock));
        }
        for address in far.into_iter().chain([asked]) {
            assert!(
                container.reaches(address) && !closed.reaches(address),
                "{address} with the filter"
            );
        }
        assert!(container.sends(asked, &names) && !closed.sends(asked, &names));
        // Clients reach published ports, from outside and from the machine itself, and receive answers.
        for (from, address) in [
            (internet, "203.0.113.1:2001"),
            (internet, "203.0.113.1:2002"),
            (machine, "172.30.0.2:2001"),
            (machine, "172.31.0.2:2001"),
            (machine, "[fd00:30::2]:2001"),
        ] {
            assert!(from.reaches(address), "{address} for clients");
        }
        assert!(
            arrives(&lasting, &lasting_end) && arrives(&lasting_end, &lasting),
            "a connection does not last"
        );
        assert_eq!(machine.within(packet_filter::missing), None);
    };
    network.load();
    is_kept(&[]);
    // Docker, ufw and firewalld replace their own rules now and then.
    assert!(machine.nft(&["add", "table", "ip", "filter"]) && machine.nft(&["flush", "table", "ip", "filter"]));
    network.load();
    is_kept(&[]);

    let exceptions = "add element inet webots_fleet allowed { 192.168.77.0/24 . 3000-4000, 172.30.0.1 . 22 }";
    assert!(machine.nft(&[exceptions]));
    is_kept(&["192.168.77.2:3128", "172.30.0.1:22"]);
    assert!(machine.nft(&["add element inet webots_fleet closed { 203.0.112.0/23 }"]));
    assert!(!container.reaches("203.0.113.2:80"));

    network.unload();
    assert!(container.reaches("192.168.77.2:80"));
    assert!(machine.within(packet_filter::missing).is_some());
}

#[test]
fn a_container_does_not_reach_its_neighbour() {
    let Some(network) = Network::new() else { return };
    let shown = network
        .machine
        .within(|| std::fs::read_to_string("/proc/sys/net/bridge/bridge-nf-call-iptables"));
    if !shown.is_ok_and(|shown| shown.trim() == "1") {
        // Without br_netfilter, which dockerd loads, no filter sees packets that cross a bridge.
        return skip("there is no br_netfilter");
    }
    let _controller = network.neighbour.listen("[::]:2001");
    for is_loaded in [false, true] {
        if is_loaded {
            network.load();
        }
        assert_eq!(network.container.reaches("172.30.0.3:2001"), !is_loaded);
        assert!(network.machine.reaches("172.30.0.3:2001"));
    }
}
