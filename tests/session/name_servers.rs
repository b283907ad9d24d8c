//! Name servers that fail, or know less than others.

use std::io::Write;
use std::net::{IpAddr, Ipv6Addr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use futures_util::future::join_all;
use serde_json::json;

use super::names::own_mounts;
use super::stand_in::{Manner, StandIn};
use super::{times_logged, until_states};
use crate::support::name_server::NameServer;
use crate::support::odd_name_server::{Kind, OddNameServer, Reply};
use crate::support::program::session_server;
use crate::support::{http, ports, until};

fn loopback(last: &[u8]) -> Vec<IpAddr> {
    last.iter().map(|last| [127, 0, 0, *last].into()).collect()
}

fn stand_ins(last: &[u8], port: u16) -> Vec<StandIn> {
    let start = |address| StandIn::start_on((address, port).into(), Manner::idle(5.0, 1000));
    loopback(last).into_iter().map(start).collect()
}

#[actix_rt::test]
async fn one_name_server_that_knows_a_name_is_enough() {
    let (good, port) = (NameServer::start(&[]), ports::block(1));
    let _servers = stand_ins(&[2, 3, 4], port);
    good.set("fleet.test", &loopback(&[2, 3]));
    let name = format!("dns+fleet.test:{port}");
    let replies = [Reply::Silence, Reply::Code(0), Reply::Code(2), Reply::Code(3), Reply::Code(5)];
    let watched = join_all(replies.map(async |reply| {
        let odd = OddNameServer::start(move |_| reply);
        let session = session_server(std::slice::from_ref(&name))
            .set("nameServers", json!([odd.address(), good.address()]))
            .start()
            .await;
        until_states(&session, &["up"; 2]).await;
        // Each lookup asks it twice at least.
        until("several lookups are done", async || odd.asked() >= 12).await;
        (session, odd)
    }))
    .await;
    good.set("fleet.test", &loopback(&[2, 3, 4]));
    let begin = Instant::now();
    join_all(watched.iter().map(|(session, _)| until_states(session, &["up"; 3]))).await;
    assert!(begin.elapsed() < Duration::from_secs(5), "used after {:?}", begin.elapsed());
    for ((session, _), reply) in watched.iter().zip(replies) {
        for told in ["down", "up"] {
            let told = times_logged(session, &format!("{name}: {told}: "));
            assert_eq!(told, 0, "beside one with {reply:?}: {}", session.log());
        }
        assert!(http::get(&session.url("/status")).await.json()["names"][0]["error"].is_null());
    }
}

#[actix_rt::test]
async fn of_name_servers_that_know_different_records_the_first_counts() {
    let (other, port) = (NameServer::start(&[]), ports::block(1));
    let _servers = stand_ins(&[2, 3], port);
    other.set("fleet.test", &loopback(&[3]));
    let odd = OddNameServer::start(|kind| match kind {
        Kind::A => Reply::Address([127, 0, 0, 2].into()),
        _ => Reply::Code(0),
    });
    for (list, counts) in [([odd.address(), other.address()], 2), ([other.address(), odd.address()], 3)] {
        let session = session_server(&[format!("dns+fleet.test:{port}")]).set("nameServers", json!(list)).start().await;
        until_states(&session, &["up"]).await;
        let asked = odd.asked();
        until("ten lookups are done", async || odd.asked() >= asked + 20).await;
        assert_eq!(times_logged(&session, "leads to other servers: "), 1, "{}", session.log());
        assert_eq!(http::get(&session.url("/session")).await.text(), format!("ws://127.0.0.{counts}:{port}"));
    }
}

#[actix_rt::test]
async fn a_name_is_unknown_only_where_no_name_server_knows_it() {
    let odd = [Reply::Code(3), Reply::Code(0)].map(|reply| OddNameServer::start(move |_| reply));
    let session = session_server(&["dns+fleet.test:2000".to_owned()])
        .set("nameServers", json!(odd.each_ref().map(OddNameServer::address)))
        .start()
        .await;
    until("it is told", async || times_logged(&session, "dns+fleet.test:2000: down: DNS has no such records") == 1)
        .await;
}

#[actix_rt::test]
async fn targets_of_a_service_that_only_the_name_server_knows_stay_when_it_fails() {
    // One comes back to its port, which the system gives to nobody meanwhile.
    let port = ports::block(1);
    let [target, fixed] = [port, 0].map(|port| StandIn::start_at(port, Manner::idle(5.0, 1000)));
    let mut names = NameServer::start(&[format!("_webots._tcp.lab.test,node1.lab.test,{}", target.port())]);
    names.set("node1.lab.test node2.lab.test", &loopback(&[1]));
    let listed = format!("node2.lab.test:{}", fixed.port());
    let session = session_server(&[listed, "dnssrv+_webots._tcp.lab.test".to_owned()])
        .set("nameServers", json!(names.address()))
        .start()
        .await;
    until_states(&session, &["up"; 2]).await;
    names.end();
    // What it has told is used for ten seconds.
    let begin = Instant::now();
    until("the answer is old", async || begin.elapsed() > Duration::from_secs(11)).await;
    drop(target);
    until_states(&session, &["up", "down"]).await;
    let _target = StandIn::start_at(port, Manner::idle(5.0, 1000));
    until_states(&session, &["up"; 2]).await;
}

#[actix_rt::test]
async fn names_of_servers_that_no_name_server_knows_are_asked_of_the_machine() {
    let Some(unshare) = own_mounts() else {
        let why = "SKIPPED, for unshare --mount is not allowed here: \
                   names_of_servers_that_no_name_server_knows_are_asked_of_the_machine";
        return writeln!(std::io::stderr(), "{why}").unwrap();
    };
    let (names, server) = (NameServer::start(&[]), StandIn::start(Manner::idle(5.0, 1000)));
    let hosts = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(hosts.path(), "127.0.0.1 localhost node3.test\n").unwrap();
    let mount = format!("mount --bind {} /etc/hosts && exec \"$0\" \"$@\"", hosts.path().display());
    let silent = OddNameServer::start(|_| Reply::Silence);
    for name_server in [names.address(), silent.address()] {
        let session = session_server(&[format!("node3.test:{}", server.port())])
            .set("nameServers", json!(name_server))
            .set("timing", json!({"answer": 15}))
            .before(&format!("exec {unshare} sh -c '{mount}' \"$0\" \"$@\""))
            .start()
            .await;
        until_states(&session, &["up"]).await;
        assert_eq!(times_logged(&session, ": down: "), 0, "{}", session.log());
    }
    assert!(silent.asked() > 0);
}

#[actix_rt::test]
async fn ipv4_addresses_are_enough_where_nothing_is_told_of_ipv6() {
    let port = ports::block(1);
    let _servers = stand_ins(&[2], port);
    for reply in [Reply::Code(2), Reply::Silence] {
        let half = OddNameServer::start(
            move |kind| if kind == Kind::A { Reply::Address([127, 0, 0, 2].into()) } else { reply },
        );
        let session =
            session_server(&[format!("dns+fleet.test:{port}")]).set("nameServers", json!(half.address())).start().await;
        until_states(&session, &["up"]).await;
        until("several lookups are done", async || half.asked() >= 8).await;
        assert_eq!(times_logged(&session, "fleet.test"), 1, "what it leads to: {}", session.log());
    }
}

#[actix_rt::test]
async fn ipv6_addresses_stay_while_nothing_is_told_of_them() {
    let port = ports::block(1);
    let _v4 = stand_ins(&[2], port);
    let _v6 = StandIn::start_on((Ipv6Addr::LOCALHOST, port).into(), Manner::idle(5.0, 1000));
    let fails = Arc::new(AtomicBool::new(false));
    let failing = fails.clone();
    let half = OddNameServer::start(move |kind| match kind {
        Kind::A => Reply::Address([127, 0, 0, 2].into()),
        _ if failing.load(Ordering::Relaxed) => Reply::Code(2),
        _ => Reply::Address(Ipv6Addr::LOCALHOST.into()),
    });
    let session =
        session_server(&[format!("dns+fleet.test:{port}")]).set("nameServers", json!(half.address())).start().await;
    until_states(&session, &["up"; 2]).await;
    let told = times_logged(&session, "fleet.test");
    fails.store(true, Ordering::Relaxed);
    let asked = half.asked();
    until("several lookups are done", async || half.asked() >= asked + 12).await;
    until_states(&session, &["up"; 2]).await;
    assert_eq!(times_logged(&session, "fleet.test"), told, "{}", session.log());
}

#[actix_rt::test]
async fn the_name_servers_of_the_machine_are_asked_each_by_itself() {
    // They are always at port 53.
    let sockets = ["127.0.53.1:53", "127.0.53.2:53"].map(|address| UdpSocket::bind(address).ok());
    let (Some(unshare), [Some(good), Some(odd)]) = (own_mounts(), sockets) else {
        let why = "SKIPPED, for unshare --mount or port 53 is not allowed here: \
                   the_name_servers_of_the_machine_are_asked_each_by_itself";
        return writeln!(std::io::stderr(), "{why}").unwrap();
    };
    let port = ports::block(1);
    let _servers = stand_ins(&[2], port);
    let _good = OddNameServer::start_on(good, |kind| match kind {
        Kind::A => Reply::Address([127, 0, 0, 2].into()),
        _ => Reply::Code(0),
    });
    let odd = OddNameServer::start_on(odd, |_| Reply::Code(2));
    let configuration = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(configuration.path(), "nameserver 127.0.53.2\nnameserver 127.0.53.1\n").unwrap();
    let mount = format!("mount --bind {} /etc/resolv.conf && exec \"$0\" \"$@\"", configuration.path().display());
    let session = session_server(&[format!("dns+fleet.test:{port}")])
        .before(&format!("exec {unshare} sh -c '{mount}' \"$0\" \"$@\""))
        .start()
        .await;
    until_states(&session, &["up"]).await;
    until("several lookups are done", async || odd.asked() >= 12).await;
    assert_eq!(times_logged(&session, "fleet.test"), 1, "what it leads to: {}", session.log());
}
