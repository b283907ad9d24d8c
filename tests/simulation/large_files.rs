//! Project files in Git LFS.

use std::path::Path;

use futures_util::future::join_all;

use super::opened::reader;
use crate::support::git::git;
use crate::support::wrapper::Wrapper;
use crate::support::{Forge, Webots, arm, is_told, make_program, outcome, programs, simulation_server};

const ATTRIBUTES: &str = "*.dae filter=lfs diff=lfs merge=lfs -text\n";
const POINTER: &str = "version https://git-lfs.github.com/spec/v1\noid sha256:0000000000000000000000000000000000000000000000000000000000000000\nsize 12345\n";

/// A `PATH` in which this script is git-lfs.
fn with_git_lfs(script: &str) -> Wrapper {
    let wrapper = Wrapper::git("");
    let path = wrapper.path();
    let folder = path.split(':').next().unwrap();
    make_program(&Path::new(folder).join("git-lfs"), script);
    wrapper
}

#[actix_rt::test]
async fn a_world_whose_large_files_are_missing_opens_without_them() {
    let forge = Forge::with_arm();
    let webots = reader();
    forge.commit(
        "lab/arm",
        "main",
        &[("meshes/a.dae", POINTER), (".gitattributes", ATTRIBUTES)],
    );
    is_told(
        &simulation_server(&webots.path(), forge.path(), 1).start().await,
        &arm(),
        "opened",
    )
    .await;
    // The same without git-lfs.
    let bin = programs(&["git", "bash", "sed", "env", "sh", "rm", "prlimit"]);
    let builder = simulation_server(&webots.path(), forge.path(), 1);
    is_told(
        &builder.env("PATH", bin.path().to_str().unwrap()).start().await,
        &arm(),
        "opened",
    )
    .await;
}

#[actix_rt::test]
async fn the_size_of_large_files_is_bounded() {
    let forge = Forge::with_arm();
    let webots = reader();
    forge.commit(
        "lab/arm",
        "main",
        &[("meshes/a.dae", POINTER), (".gitattributes", ATTRIBUTES)],
    );
    // A git-lfs that loads far more than the 12345 bytes of its file.
    let loads = "mkdir -p \"$GIT_DIR/lfs/tmp\"\nhead -c 5000000 /dev/zero >\"$GIT_DIR/lfs/tmp/a\"\nexec sleep 1000";
    let wrapper = with_git_lfs(loads);
    let server = simulation_server(&webots.path(), forge.path(), 1)
        .set("projectSize", 1)
        .env("PATH", &wrapper.path());
    let told = outcome(&server.start().await, &arm()).await;
    assert_eq!(told, "loading: Error: The project is larger than 1 MiB");
}

#[actix_rt::test]
async fn large_files_that_a_class_loads_at_once_count_against_none_of_its_projects() {
    const CLASS: u16 = 4;
    needs!("git-lfs");
    let forge = Forge::with_arm();
    let webots = reader();
    forge.commit(
        "lab/arm",
        "main",
        &[("meshes/a.dae", POINTER), (".gitattributes", ATTRIBUTES)],
    );
    // Before git-lfs begins, it has loaded less than a project may have, waits until those of the whole class have, and longer
    // than the server's interval of checks: the real one loads at a speed that no test controls.
    let loads = format!(
        "mkdir -p \"$GIT_DIR/lfs/tmp\"
         # Git starts it several times for a checkout.
         head -c 900000 /dev/zero >\"$GIT_DIR/lfs/tmp/$(echo \"$GIT_INDEX_FILE\" | cksum)\"
         until [ \"$(ls \"$GIT_DIR/lfs/tmp\" | wc -l)\" -ge {CLASS} ]; do sleep 0.05; done
         sleep 1.5; exec {} \"$@\"",
        which::which("git-lfs").unwrap().display()
    );
    let wrapper = with_git_lfs(&loads);
    let server = simulation_server(&webots.path(), forge.path(), CLASS)
        .set("projectSize", 1)
        .env("PATH", &wrapper.path())
        .start()
        .await;
    let world = arm();
    let told = join_all((0..CLASS).map(|_| outcome(&server, &world))).await;
    assert!(told.iter().all(|told| told.contains("opened")), "{told:#?}");
}

#[actix_rt::test]
async fn files_in_git_lfs_are_loaded() {
    needs!("git-lfs");
    let forge = Forge::with_arm();
    let webots = Webots::script(
        "for last; do :; done\ncd \"$(dirname \"$last\")/..\"\necho \"mesh [$(head -c 20 meshes/a.dae)]\"\nexit 1",
    );
    let work = forge.work_tree("lab/arm", "main");
    std::fs::create_dir(work.join("meshes")).unwrap();
    std::fs::write(work.join("meshes/a.dae"), "the real mesh".repeat(200)).unwrap();
    std::fs::write(work.join(".gitattributes"), ATTRIBUTES).unwrap();
    git(&work, &["lfs", "install", "--local", "--force"]);
    forge.commit_work_tree("lab/arm", "main");
    git(&work, &["lfs", "push", "--all", "origin"]);
    let server = simulation_server(&webots.path(), forge.path(), 1).start().await;
    for _ in 0..2 {
        is_told(&server, &arm(), "mesh [the real mesh").await;
    }
}
