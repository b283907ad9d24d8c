//! Measures how late the server enforces a limit that it checks itself: a simulation's folder exceeds `limits.disk`.

use std::path::PathBuf;
use std::time::Instant;

use procfs::process::Process;

use crate::class::{leave, ready};
use crate::support::SOON;
use crate::support::client::Client;
use crate::support::git::Forge;
use crate::support::http;
use crate::support::program::{Server, simulation_server};

/// Default numbers of running simulations.
const SIZES: [u16; 2] = [10, 100];
/// Number of them whose folders are filled, one after another.
const FILLED: usize = 7;
/// Number of simulations that start at once.
const AT_ONCE: u16 = 100;
/// `limits.disk`, in MiB.
const DISK: usize = 5;

/// Prints how long it takes until the client of a simulation receives the error that it has written too much.
pub async fn measure(levels: &[String], sizes: &[u16]) {
    println!("limits.disk, until the client of a simulation that exceeds it is told (median, longest of {FILLED}):");
    let sizes = if sizes.is_empty() { &SIZES } else { sizes };
    for level in levels {
        for &size in sizes {
            let forge = Forge::with_arm();
            let demo = std::path::Path::new(env!("CARGO_BIN_EXE_demo-simulator"));
            let builder = simulation_server(demo, forge.path(), size).set("isolation", level.as_str());
            // Clients that wait for their turn answer no pings.
            let server = builder
                .set("limits.disk", DISK)
                .set("timing.silence", 3600)
                .start()
                .await;
            let mut clients = Vec::new();
            while clients.len() < usize::from(size) {
                clients.extend(ready(&server, AT_ONCE.min(size - clients.len() as u16)).await);
            }
            let mut times = Vec::new();
            for _ in 0..FILLED.min(clients.len()) {
                let mut client = clients.pop().unwrap();
                let folder = folder(&server, &client).await;
                let begin = Instant::now();
                for number in 0..=DISK {
                    std::fs::write(folder.join(format!("project/filling-{number}")), vec![1; 1 << 20]).unwrap();
                }
                client
                    .within("loading: Error: The simulation has written more than", SOON)
                    .await;
                times.push(begin.elapsed());
            }
            times.sort();
            println!(
                "  {level:<8}{size:>5}: {:>8.2?} {:>8.2?}",
                times[times.len() / 2],
                times[times.len() - 1]
            );
            leave(&server, clients).await;
        }
    }
}

/// The folder of a client's simulation.
async fn folder(server: &Server, client: &Client) -> PathBuf {
    let url = client.heard.iter().find(|text| text.starts_with("webots:")).unwrap();
    let port: u16 = url.rsplit_once(':').unwrap().1.parse().unwrap();
    let status = http::get(&server.url("/status")).await.json();
    let all = status["simulations"].as_array().unwrap();
    let one = all
        .iter()
        .find(|one| one["port"].as_u64() == Some(port.into()))
        .unwrap();
    let process = Process::new(one["pid"].as_i64().unwrap().try_into().unwrap()).unwrap();
    process.environ().unwrap()[std::ffi::OsStr::new("WEBOTS_FLEET_INSTANCE")]
        .clone()
        .into()
}
