//! Many starts and stops in a row must leave the server as it was.

use std::path::Path;
use std::time::Duration;

use procfs::net::TcpState;
use procfs::process::Process;

use crate::support::{Client, Forge, Server, Webots, arm, holds_soon, instances_below, simulation_server, until};

/// The resources that a server uses at one moment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Holdings {
    processes: u64,
    descriptors: u64,
    threads: u64,
    ports: u64,
    folders: u64,
    memory_kib: u64,
}

/// Parallel clients, and slots of the server.
const AT_A_TIME: usize = 4;
/// Starts before the first count: they fill thread pools and allocators.
const WARM_UP: usize = 40;

impl Holdings {
    fn of(server: &Server) -> Self {
        let process = Process::new(server.pid()).unwrap();
        let status = process.status().unwrap();
        let used = |port: &u16| std::net::TcpListener::bind(("0.0.0.0", *port)).is_err();
        Self {
            processes: instances_below(&server.folder).len() as u64,
            descriptors: process.fd_count().unwrap() as u64,
            threads: status.threads,
            ports: (server.port + 1..=server.port + AT_A_TIME as u16 + 10)
                .filter(used)
                .count() as u64,
            folders: folders(&server.folder.join("cache")),
            memory_kib: status.vmrss.unwrap(),
        }
    }

    pub fn rows(&self) -> [(&'static str, u64); 6] {
        [
            ("processes", self.processes),
            ("file descriptors", self.descriptors),
            ("threads", self.threads),
            ("ports in use", self.ports),
            ("folders", self.folders),
            ("resident memory, KiB", self.memory_kib),
        ]
    }

    /// What has grown. Memory may grow a little, but less than any leak in each start would cause.
    pub fn leaks_since(&self, before: &Self, starts: usize) -> Vec<String> {
        let slack = |name: &str| match name {
            "resident memory, KiB" => 2048 + starts as u64,
            // The runtime keeps idle threads for some seconds.
            "threads" => 8,
            _ => 0,
        };
        let rows = before.rows().into_iter().zip(self.rows());
        rows.filter(|((name, before), (_, after))| *after > before + slack(name))
            .map(|((name, before), (_, after))| format!("{name}: {before} before, {after} after"))
            .collect()
    }
}

fn folders(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .filter(|entry| entry.path().is_dir())
        .map(|entry| 1 + folders(&entry.path()))
        .sum()
}

/// Starts and stops this many simulations; returns what the server used before and after. On a busy machine pools fill
/// later, so all growth must stop within this many rounds, which a leak never does.
pub async fn soak(starts: usize, rounds: usize) -> (Holdings, Holdings) {
    let forge = Forge::with_arm();
    let webots = Webots::launcher();
    let server = simulation_server(&webots.path(), forge.path(), AT_A_TIME as u16)
        .start()
        .await;
    visit(&server, WARM_UP).await;
    let mut before = Holdings::of(&server);
    let mut round = 1;
    loop {
        visit(&server, starts).await;
        // Folders may still be in removal.
        let mut after = Holdings::of(&server);
        let nothing_grows = holds_soon(async || {
            after = Holdings::of(&server);
            after.leaks_since(&before, starts).is_empty()
        });
        if nothing_grows.await || round == rounds {
            return (before, after);
        }
        (before, round) = (after, round + 1);
    }
}

/// Makes this many visits, some of which end before Webots is ready; waits until nothing of them remains.
async fn visit(server: &Server, visits: usize) {
    let url = arm();
    let next = std::cell::Cell::new(0);
    let visitor = async || {
        while next.get() < visits {
            let number = next.replace(next.get() + 1);
            let mut client = Client::start(server, &url).await;
            match number % 5 {
                4 => drop(client.until("loading: Step 8/9 : checking").await),
                3 => actix_rt::time::sleep(Duration::from_millis(number as u64 % 50)).await,
                _ => drop(client.until("webots:").await),
            }
            client.leave().await;
        }
    };
    futures_util::future::join_all((0..AT_A_TIME).map(|_| visitor())).await;
    until("all are gone", async || {
        let status = server.status().await;
        status["simulations"].as_array().unwrap().is_empty() && instances_below(&server.folder).is_empty()
    })
    .await;
    until("its connections are closed", async || {
        let sockets = procfs::net::tcp().unwrap();
        let mut own = sockets
            .iter()
            .filter(|socket| socket.local_address.port() == server.port && socket.inode != 0);
        own.all(|socket| socket.state == TcpState::Listen)
    })
    .await;
}

#[cfg(test)]
#[allow(dead_code, reason = "a bench has no tests")]
mod tests {
    #[actix_rt::test]
    async fn starts_and_stops_leave_the_server_as_it_was() {
        let (before, after) = super::soak(40, 4).await;
        assert_eq!(
            after.leaks_since(&before, 40),
            Vec::<String>::new(),
            "{before:?} {after:?}"
        );
    }
}
