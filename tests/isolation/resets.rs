//! A reset of a controller writes only into the project, whatever the world's program does to its folders.

use std::path::Path;

use crate::simulation::scene::{instance_folders, nothing_left};
use crate::support::{Client, DEMO, Webots, demo_server, server_of, until};

/// The content of the controller of [`Forge::with_arm`].
const ORIGINAL: &str = "print('original')\n";

#[actix_rt::test]
async fn a_reset_replaces_a_link_and_follows_none() {
    needs!("bwrap");
    let table = [
        ("ln -sf VICTIM controllers/c/c.py", true),
        ("rm -r controllers/c; ln -s OUTSIDE controllers/c", false),
        ("rm -r controllers; ln -s OUTSIDE controllers", false),
        ("rm -r controllers; touch controllers", false),
        ("rm -r controllers", false),
        ("rm controllers/c/c.py; mkfifo controllers/c/c.py", true),
        (
            "rm controllers/c/c.py; mkdir controllers/c/c.py; touch controllers/c/c.py/mine",
            false,
        ),
    ];
    for level in ["none", "sandbox"] {
        let server = demo_server(1).set("isolation", level).start().await;
        for (deed, is_restored) in table {
            let outside = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
            let victim = outside.path().join("victim");
            std::fs::write(&victim, "untouched").unwrap();
            std::fs::create_dir(outside.path().join("c")).unwrap();
            let mut client = Client::ready(&server).await;
            let folder = instance_folders(&server.folder)[0].clone();
            let deed = deed.replace("VICTIM", &format!("'{}'", victim.display()));
            let deed = deed.replace("OUTSIDE", &format!("'{}'", outside.path().display()));
            // The server's git must ignore settings in the project's folder.
            let git = "echo '*.py working-tree-encoding=UTF-16' > .gitattributes; echo 'gitdir: /tmp' > .git";
            let mut shell = std::process::Command::new("sh");
            let done = shell
                .args(["-ec", &format!("{deed}; {git}")])
                .current_dir(folder.join("project"))
                .status();
            assert!(done.unwrap().success());
            let what = format!("{level}, {deed}");
            let answer = client.reset("c/c.py").await;
            let file = folder.join("project/controllers/c/c.py");
            assert_eq!(answer.starts_with("reset"), is_restored, "{what}: {answer}");
            if is_restored {
                assert!(file.symlink_metadata().unwrap().is_file(), "{what}");
                assert_eq!(std::fs::read_to_string(&file).unwrap(), ORIGINAL, "{what}");
                assert_eq!(file.canonicalize().unwrap(), file, "{what}");
            }
            assert_eq!(std::fs::read_to_string(&victim).unwrap(), "untouched", "{what}");
            let inside = |folder: &Path| std::fs::read_dir(folder).unwrap().count();
            assert_eq!(
                (inside(outside.path()), inside(&outside.path().join("c"))),
                (2, 0),
                "{what}"
            );
            let left: Vec<_> = std::fs::read_dir(&folder)
                .unwrap()
                .flatten()
                .map(|entry| entry.file_name())
                .collect();
            assert!(
                !left.iter().any(|name| name.to_string_lossy().starts_with("restored")),
                "{left:?}"
            );
            client.leave().await;
            nothing_left(&server, 1).await;
        }
    }
}

/// Keeps swapping a controller's folder and a symlink out of the project, and removes the file to reset.
const EXCHANGE: &str = "import ctypes, os, sys\n\
    os.symlink(sys.argv[1], 'controllers/x')\n\
    libc, folder = ctypes.CDLL(None), os.open('controllers/c', os.O_RDONLY)\n\
    open('exchanging', 'w').close()\n\
    while True: [libc.renameat2(-100, b'controllers/c', -100, b'controllers/x', 2) for n in range(7)], \
    libc.unlinkat(folder, b'c.py', 0)\n";

#[actix_rt::test]
async fn a_reset_never_writes_outside_of_the_project() {
    needs!("bwrap");
    let outside = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let outside_shown = outside.path().display();
    let webots = Webots::script(&format!(
        "python3 -c \"{EXCHANGE}\" '{outside_shown}' &\n{DEMO} \"$@\" & wait"
    ));
    let server = server_of(webots, 1).set("isolation", "sandbox");
    // Resets between two pings are limited.
    let server = server.set("timing.ping", 0.2).start().await;
    let mut client = Client::ready(&server).await;
    let project = instance_folders(&server.folder)[0].join("project");
    until("the names are exchanged", async || project.join("exchanging").exists()).await;
    for _ in 0..100 {
        client.reset("c/c.py").await;
    }
    let written = std::fs::read_dir(outside.path()).unwrap().count();
    assert_eq!(written, 0, "it was written outside of the project");
    client.leave().await;
    nothing_left(&server, 1).await;
}
