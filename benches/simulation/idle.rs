//! Measures what idle simulations cost the server: processor time and memory.

use std::time::{Duration, Instant};

use futures_util::StreamExt;
use procfs::process::Process;

use crate::Verdict;
use crate::class::{leave, ready, server};
use crate::support::git::Forge;
use crate::support::http;
use crate::support::program::Server;

/// Numbers of idle simulations.
const SIZES: [u16; 4] = [0, 10, 100, 200];
/// Limit of the server's processor time for 200, in percent of one core.
const MOST: f64 = 2.0;
/// Limit of the server's memory per simulation, in KiB.
const MEMORY: f64 = 150.0;
/// Pause before a measurement, in which the server completes the work of the starts.
const SETTLE: Duration = Duration::from_secs(3);

/// Prints what idle simulations cost, each number of them measured for `time`.
pub async fn measure(verdict: &mut Verdict, levels: &[String], time: Duration) {
    println!("idle simulations, the server's part, {time:?} each:");
    for level in levels {
        let forge = Forge::with_arm();
        let server = server(&forge, level).await;
        // The first class fills pools and caches.
        leave(&server, ready(&server, 200).await).await;
        let mut before = 0;
        for size in SIZES {
            let mut clients = ready(&server, size).await;
            // A page reads its connection all the time, and answers pings.
            let reading: Vec<_> = clients
                .drain(..)
                .map(|mut client| {
                    actix_rt::spawn(async move { while client.next_within(Duration::MAX).await.is_some() {} })
                })
                .collect();
            actix_rt::time::sleep(SETTLE).await;
            let memory = resident(&server);
            if size == 0 {
                before = memory;
            }
            let each = memory.saturating_sub(before) as f64 / f64::from(size.max(1));
            let alone = processor(&server, time).await;
            let page = watch(&server).await;
            let watched = processor(&server, time).await;
            page.abort();
            assert_eq!(standing(&server).await, usize::from(size), "simulations have ended");
            println!(
                "  {level:<8}{size:>5}: {alone:>5.2} % of a core, with the monitor open {watched:>5.2} %, {each:>6.1} KiB each"
            );
            if size == 200 {
                verdict.ratio("processor time, percent", alone, MOST);
                verdict.ratio("KiB each", each, MEMORY);
            }
            for client in reading {
                client.abort();
            }
            leave(&server, Vec::new()).await;
        }
    }
}

/// Number of simulations.
async fn standing(server: &Server) -> usize {
    http::get(&server.url("/status")).await.json()["simulations"]
        .as_array()
        .unwrap()
        .len()
}

/// Opens the monitor page's events, and reads them.
async fn watch(server: &Server) -> actix_rt::task::JoinHandle<()> {
    let answer = awc::Client::builder()
        .timeout(Duration::from_secs(10))
        .finish()
        .get(server.url("/events"))
        .send();
    let mut answer = answer.await.unwrap();
    assert!(answer.status().is_success());
    answer.next().await.unwrap().unwrap();
    actix_rt::spawn(async move { while answer.next().await.is_some() {} })
}

/// The server's processor time, in percent of one core.
async fn processor(server: &Server, time: Duration) -> f64 {
    let begin = Instant::now();
    let before = taken(server);
    actix_rt::time::sleep(time).await;
    100.0 * (taken(server) - before) / begin.elapsed().as_secs_f64()
}

/// The processor time that a server has used, in seconds.
fn taken(server: &Server) -> f64 {
    let stat = Process::new(server.pid()).unwrap().stat().unwrap();
    (stat.utime + stat.stime) as f64 / procfs::ticks_per_second() as f64
}

/// A server's own memory, in KiB.
fn resident(server: &Server) -> u64 {
    Process::new(server.pid()).unwrap().status().unwrap().rssanon.unwrap()
}
