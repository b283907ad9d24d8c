//! The reserve of the disk: no simulation can use it up.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use nix::sys::statvfs::statvfs;

use super::deeds::{as_nobody, open};
use crate::simulation::scene::{instance_folders, nothing_left};
use crate::support::disk::{self, Full};
use crate::support::{Builder, Client, DEMO, SOON, Server, Webots, open_folder, server_of, skip, until};

/// The size of the disk, in MiB; `diskReserve` has its default.
const SIZE: u32 = 1024;

/// Many processes that write many files each.
const MANY: &str = "import os, itertools\n\
                    for one in range(8):\n\
                    \x20   if os.fork() == 0:\n\
                    \x20       for number in itertools.count():\n\
                    \x20           folder = f'{one}-{number // 100}'\n\
                    \x20           os.makedirs(folder, exist_ok=True)\n\
                    \x20           with open(f'{folder}/{number}', 'wb') as file: file.write(bytes(65536))\n\
                    os.wait()";

/// Deleted files that processes keep open. With an argument, the processes hide their descriptors.
const NAMELESS: &str = "import ctypes, os, sys\n\
                        for one in range(8):\n\
                        \x20   if os.fork() == 0:\n\
                        \x20       if sys.argv[1:]: ctypes.CDLL(None).prctl(4, 0)\n\
                        \x20       files = []\n\
                        \x20       while True:\n\
                        \x20           files.append(os.open('.', os.O_TMPFILE | os.O_RDWR))\n\
                        \x20           for piece in range(64): os.write(files[-1], bytes(65536))\n\
                        os.wait()";

/// The free space of a disk, in bytes.
fn free(folder: &Path) -> u64 {
    let disk = statvfs(folder).unwrap();
    disk.blocks_available() * disk.fragment_size()
}

/// Records the least free space of a disk.
struct Least(Arc<AtomicU64>);

impl Least {
    /// Records until this value is dropped.
    fn of(folder: &Path) -> Self {
        let folder = folder.to_owned();
        let least = Self(Arc::new(AtomicU64::new(u64::MAX)));
        let bytes = Arc::downgrade(&least.0);
        std::thread::spawn(move || {
            while let Some(bytes) = bytes.upgrade() {
                bytes.fetch_min(free(&folder), Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(1));
            }
        });
        least
    }

    fn mib(&self) -> u64 {
        self.0.load(Ordering::Relaxed) >> 20
    }
}

/// A server in this folder whose simulations are limited only by `diskReserve`.
async fn server(webots: Webots, folder: &Path, change: impl FnOnce(Builder) -> Builder) -> Server {
    open(folder);
    let builder = server_of(webots, 2).folder(folder).set("timing.heartbeat", 0.5);
    change(builder.set("isolation", "sandbox").set("limits.disk", 1_000_000))
        .start()
        .await
}

fn webots() -> Webots {
    Webots::script(&format!(
        "{DEMO} \"$@\" &\nuntil [ -e go ]; do sleep 0.05; done\nhead -c 2000000 /dev/zero > own; sh go & wait"
    ))
}

/// Starts a simulation and writes this program into its project. Returns its client and its instance directory.
async fn doing(server: &Server, deed: &str) -> (Client, PathBuf) {
    let before = instance_folders(&server.folder);
    let client = Client::ready(server).await;
    let new = instance_folders(&server.folder)
        .into_iter()
        .find(|folder| !before.contains(folder))
        .unwrap();
    std::fs::write(new.join("project/deed"), deed).unwrap();
    (client, new)
}

/// Makes the simulation with this instance directory run this line.
fn go(folder: &Path, line: &str) {
    std::fs::write(folder.join("project/new"), line).unwrap();
    std::fs::rename(folder.join("project/new"), folder.join("project/go")).unwrap();
}

#[actix_rt::test]
async fn on_a_quiet_machine_the_reserve_of_the_disk_is_kept() {
    disk::hide_mounts_from_others();
    let folder = open_folder();
    let small = folder.path().join("small");
    if !disk::small_disk(&small, SIZE) {
        return skip("only root may mount a small disk");
    }
    let mut users = vec![("root", "true")];
    users.extend(as_nobody().map(|nobody| ("nobody", nobody)));
    for (user, before) in users {
        let own = small.join(user);
        std::fs::create_dir(&own).unwrap();
        let server = server(webots(), &own, |builder| builder.before(before)).await;
        let (mut innocent, folder) = doing(&server, "").await;
        go(&folder, "true");
        // A server of root sees hidden descriptors, too.
        for (name, deed, argument) in [
            ("many", MANY, ""),
            ("nameless", NAMELESS, ""),
            ("hidden", NAMELESS, "hidden"),
        ] {
            let what = format!("{user}, {name}");
            let (mut client, folder) = doing(&server, deed).await;
            let least = Least::of(&small);
            go(&folder, &format!("python3 deed {argument}"));
            let told = actix_rt::time::timeout(SOON, client.until("loading: Error:")).await;
            let told = told.unwrap_or_else(|_| panic!("{what}: it was not ended, {} MiB were left", least.mib()));
            assert!(
                told.contains("is almost full (diskReserve), and the simulation "),
                "{what}: {told}"
            );
            let hides = user == "nobody" && name == "hidden";
            assert_eq!(told.contains("hides which files"), hides, "{what}: {told}");
            assert_eq!(client.closed().await, Some(1000), "{what}");
            eprintln!("{what}: {} MiB were left, {told}", least.mib());
            assert!(least.mib() > 0, "{what}: the reserve was used up");
            until("there is room again", async || free(&small) >> 20 > 512).await;
            until("it is ready again", async || server.health().await.0 == 200).await;
            innocent.until(".").await;
        }
        innocent.leave().await;
        nothing_left(&server, 2).await;
    }
}

#[actix_rt::test]
async fn no_simulation_ends_where_another_program_fills_the_disk() {
    disk::hide_mounts_from_others();
    let folder = tempfile::tempdir().unwrap();
    if !disk::small_disk(folder.path(), 64) {
        return skip("only root may mount a small disk");
    }
    let server = server(Webots::launcher(), folder.path(), |builder| {
        builder.set("diskReserve", 8)
    })
    .await;
    let mut client = Client::ready(&server).await;
    let _filler = Full::at(folder.path());
    until("it is full", async || server.health().await.0 == 503).await;
    // Longer than the time that an end has to show an effect.
    for _ in 0..12 {
        client.until(".").await;
    }
    assert!(!server.log().contains("almost full"), "{}", server.log());
}
