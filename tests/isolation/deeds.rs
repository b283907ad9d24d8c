//! What a world's program sees and reaches. The stand-in for Webots does each deed, and prints those that succeed.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::simulation::scene::nothing_left;
use crate::support::{Builder, Client, Forge, Webots, arm, simulation_server, skip};

/// A server, and files that are not for worlds.
pub struct Stage {
    /// Directory of the configuration, log and cache.
    pub folder: tempfile::TempDir,
    /// The home of the server's user.
    home: tempfile::TempDir,
    /// A folder that is neither in `/tmp` nor in a home.
    pub elsewhere: tempfile::TempDir,
    pub forge: Forge,
}

/// The levels in the order of the tables.
const LEVELS: [&str; 2] = ["none", "sandbox"];

impl Stage {
    pub fn new() -> Self {
        let everybody = |folder: tempfile::TempDir| {
            open(folder.path());
            folder
        };
        let stage = Self {
            folder: everybody(tempfile::tempdir().unwrap()),
            home: everybody(tempfile::tempdir().unwrap()),
            elsewhere: everybody(tempfile::tempdir_in(apart().unwrap_or(env!("CARGO_TARGET_TMPDIR"))).unwrap()),
            forge: Forge::with_arm(),
        };
        std::fs::write(stage.home.path().join("secret"), "a secret").unwrap();
        std::fs::write(stage.elsewhere.path().join("data"), "data").unwrap();
        stage
    }

    /// A stage with an `elsewhere` that sandboxes don't hide. `None`, with a reason printed, if there can be none.
    fn apart() -> Option<Self> {
        if apart().is_none() {
            let hidden = "the home and folders for temporary files, which a sandbox hides";
            skip(&format!("this user can write nowhere but in {hidden}"));
        }
        apart().map(|_| Self::new())
    }

    pub fn builder(&self, webots: &Webots, level: &str) -> Builder {
        let builder = simulation_server(&webots.path(), self.forge.path(), 2).folder(self.folder.path());
        let builder = builder
            .set("isolation", level)
            .set("adminPassword", "a secret")
            .set("timing.grace", 0.5);
        builder
            .env("HOME", self.home.path().to_str().unwrap())
            .env("SECRET_OF_THE_SERVER", "a secret")
    }

    /// Which of these deeds a world's program can do; each is a name and a shell command.
    pub async fn tried(
        &self,
        deeds: &[(&str, String)],
        level: &str,
        change: impl FnOnce(Builder) -> Builder,
    ) -> Vec<String> {
        let one =
            |(name, line): &(&str, String)| format!("if ( {line} ) >/dev/null 2>&1; then echo 'DONE {name}'; fi\n");
        let webots = Webots::script(&format!(
            "{}\necho THE END\nexit 1",
            deeds.iter().map(one).collect::<String>()
        ));
        let server = change(self.builder(&webots, level)).start().await;
        let told = Client::start(&server, &arm()).await.patiently("loading: Error:").await;
        assert!(told.contains("THE END"), "{told}");
        nothing_left(&server, 2).await;
        told.split(" | ")
            .filter_map(|line| line.split("DONE ").nth(1))
            .map(str::to_owned)
            .collect()
    }
}

/// A writable folder outside of homes and temporary folders. The project may be in one, so there are several candidates.
fn apart() -> Option<&'static str> {
    let user = nix::unistd::User::from_uid(nix::unistd::getuid())
        .unwrap()
        .map(|user| user.dir);
    let hidden: Vec<PathBuf> = ["/tmp", "/var/tmp"]
        .map(PathBuf::from)
        .into_iter()
        .chain([std::env::temp_dir()])
        .chain(user)
        .chain(std::env::var_os("HOME").map(PathBuf::from))
        .filter_map(|folder| folder.canonicalize().ok())
        .filter(|folder| folder.parent().is_some())
        .collect();
    [env!("CARGO_TARGET_TMPDIR"), "/srv", "/var/lib", "/opt"]
        .into_iter()
        .find(|folder| {
            let Ok(real) = Path::new(folder).canonicalize() else {
                return false;
            };
            // The path becomes part of shell commands.
            !folder.contains(' ')
                && !hidden.iter().any(|place| real.starts_with(place))
                && tempfile::tempdir_in(real).is_ok()
        })
}

/// Lets all users read and write a folder.
pub fn open(folder: &Path) {
    std::fs::set_permissions(folder, std::fs::Permissions::from_mode(0o777)).unwrap();
}

fn shown(path: impl AsRef<Path>) -> String {
    path.as_ref().display().to_string()
}

/// Deeds with files, and whether they succeed at each level.
fn files(stage: &Stage) -> Vec<(&'static str, String, [bool; 2])> {
    let folder = shown(&stage.folder);
    let home = shown(&stage.home);
    let elsewhere = shown(&stage.elsewhere);
    vec![
        (
            "read and write the project",
            "test -f worlds/a.wbt && touch worlds/new".to_owned(),
            [true, true],
        ),
        ("write a home", "touch ~/.config-of-webots".to_owned(), [true, true]),
        (
            "write the runtime folder",
            "touch ${XDG_RUNTIME_DIR:-/tmp}/x.$$; rm ${XDG_RUNTIME_DIR:-/tmp}/x.$$".to_owned(),
            [true, true],
        ),
        (
            "use temporary files",
            "f=$(mktemp) && echo x > $f && rm $f".to_owned(),
            [true, true],
        ),
        (
            "use shared memory",
            "touch /dev/shm/fleet.$$ && rm /dev/shm/fleet.$$".to_owned(),
            [true, true],
        ),
        (
            "read the system",
            "test -r /etc/passwd -a -x /usr/bin/env -a -r /proc/cpuinfo -a -d /sys/class".to_owned(),
            [true, true],
        ),
        ("read elsewhere", format!("grep data {elsewhere}/data"), [true, true]),
        ("write elsewhere", format!("touch {elsewhere}/new"), [true, false]),
        (
            "read the configuration",
            format!("grep secret {folder}/config.json"),
            [true, false],
        ),
        (
            "change the configuration",
            format!("echo >> {folder}/config.json"),
            [true, false],
        ),
        (
            "read the log",
            format!("ls {folder}/log/simulation/instances/*.log"),
            [true, false],
        ),
        ("read the cache", format!("ls {folder}/cache/git/*/HEAD"), [true, false]),
        (
            "change the cache",
            format!("for one in {folder}/cache/git/*/HEAD; do echo >> $one; done"),
            [true, false],
        ),
        (
            "see all of its folder",
            format!("ls {folder}/cache/runs/*/*/index"),
            [true, false],
        ),
        ("read the home", format!("grep secret {home}/secret"), [true, false]),
        (
            "write what git obeys",
            format!("touch {home}/.gitconfig && test -f {home}/secret"),
            [true, false],
        ),
        (
            "read the environment of the server",
            "grep -ls SECRET_OF_THE_SERVER /proc/[0-9]*/environ | grep .".to_owned(),
            [true, false],
        ),
        (
            "see other processes",
            "grep -ls simulation-serv /proc/[0-9]*/comm | grep .".to_owned(),
            [true, false],
        ),
    ]
}

/// Deeds with system calls, and whether they succeed at each level.
fn system_calls() -> Vec<(&'static str, String, [bool; 2])> {
    let works = |deed: &str| Command::new("sh").args(["-c", deed]).output().unwrap().status.success();
    // A call reaches the kernel unless it fails with `EPERM`.
    let call = |x86: u32, arm: u32, arguments: &str| {
        let number = if cfg!(target_arch = "aarch64") { arm } else { x86 };
        format!(
            "python3 -c 'import ctypes, struct; c = ctypes.CDLL(None, use_errno=True); \
             assert c.syscall({number}, {arguments}) >= 0 or ctypes.get_errno() != 1'"
        )
    };
    // Of a family that the kernel may not have.
    let socket = |family: u32| call(41, 198, &format!("{family}, 5, 0"));
    let refused = [
        ("use a keyring", call(250, 219, "0, -3, 1")),
        ("use io_uring", call(425, 425, "1, ctypes.create_string_buffer(120)")),
        ("handle page faults", call(323, 282, "1")),
        ("reach the host of a virtual machine", socket(40)),
        ("use ciphers of the kernel", socket(38)),
        ("leave namespaces", call(272, 97, "0")),
        // An array of one element.
        (
            "use BPF",
            call(321, 280, "0, struct.pack(\"18I\", 2, 4, 8, 1, *[0] * 14), 72"),
        ),
        // No such flags, no such folder, no such process: the machine is not changed.
        ("count what the processor does", call(298, 241, "0, 0, -1, -1, -1")),
        ("mount", call(165, 40, "0, b\"/nowhere\", 0, 0, 0")),
        ("take a file of another process", call(438, 438, "-1, 0, 0")),
        ("read the size of the log of the kernel", call(103, 116, "10, 0, 0")),
        ("switch random addresses off", call(135, 92, "0x40000")),
    ];
    // What such a machine does not have can't be kept from worlds.
    let refused = refused.map(|(name, deed)| {
        let is_there = works(&deed);
        (name, deed, [is_there, false])
    });
    let allowed = vec![
        (
            "read its personality",
            call(135, 92, "0xffffffff"),
            [true, true],
        ),
        (
            "start threads and processes",
            "python3 -c 'import threading, subprocess; t = threading.Thread(target=subprocess.check_call, args=[[\"true\"]]); t.start(); t.join()'"
                .to_owned(),
            [true, true],
        ),
        (
            "find that a system call of tomorrow is not there",
            "python3 -c 'import ctypes, errno; c = ctypes.CDLL(None, use_errno=True); assert c.syscall(1000) < 0 and ctypes.get_errno() == errno.ENOSYS'"
                .to_owned(),
            [true, true],
        ),
    ];
    refused.into_iter().chain(allowed).collect()
}

async fn compare(
    stage: &Stage,
    table: Vec<(&'static str, String, [bool; 2])>,
    change: impl Fn(Builder) -> Builder,
    levels: &[usize],
) {
    let deeds: Vec<(&str, String)> = table.iter().map(|(name, line, _)| (*name, line.clone())).collect();
    for level in levels {
        let expected: Vec<&str> = table
            .iter()
            .filter(|(_, _, done)| done[*level])
            .map(|(name, ..)| *name)
            .collect();
        assert_eq!(
            stage.tried(&deeds, LEVELS[*level], &change).await,
            expected,
            "{}",
            LEVELS[*level]
        );
    }
}

#[actix_rt::test]
async fn a_world_sees_and_changes_what_its_level_allows() {
    needs!("bwrap");
    let Some(stage) = Stage::apart() else { return };
    let change = |builder: Builder| builder.set("limits.output", 10_000);
    compare(&stage, files(&stage), change, &[1, 0]).await;
}

/// The command that runs a server as an ordinary user; `None` if that is not possible.
pub fn as_nobody() -> Option<&'static str> {
    let program = Path::new(env!("CARGO_BIN_EXE_simulation-server"));
    let may_be_run = |folder: &Path| folder.metadata().unwrap().permissions().mode() & 1 == 1;
    if !nix::unistd::getuid().is_root() || !program.ancestors().all(may_be_run) {
        skip("only root can become somebody else, who may run what was built");
        return None;
    }
    Some("exec setpriv --reuid=65534 --regid=65534 --clear-groups \"$0\" \"$@\"")
}

#[actix_rt::test]
async fn a_sandbox_refuses_what_reaches_more_of_the_kernel() {
    needs!("bwrap");
    compare(&Stage::new(), system_calls(), |builder| builder, &[1, 0]).await;
}

#[actix_rt::test]
async fn a_sandbox_holds_for_an_ordinary_user_too() {
    let Some(nobody) = as_nobody() else { return };
    let Some(stage) = Stage::apart() else { return };
    compare(&stage, files(&stage), |builder| builder.before(nobody), &[1]).await;
    compare(&stage, system_calls(), |builder| builder.before(nobody), &[1]).await;
    // bubblewrap is one more process.
    let processes = [("be bounded by the kernel", "test $(ulimit -u) = 71".to_owned())];
    let done = stage
        .tried(&processes, "sandbox", |builder| {
            builder.before(nobody).set("limits.processes", 70)
        })
        .await;
    assert_eq!(done, ["be bounded by the kernel"]);
}

#[actix_rt::test]
async fn temporary_folders_are_the_simulations_own_wherever_they_are() {
    needs!("bwrap");
    let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    std::fs::write(folder.path().join("secret"), "a secret").unwrap();
    let there = shown(&folder);
    let deeds = [
        ("use it", format!("touch '{there}'/new.$$ && rm '{there}'/new.$$")),
        (
            "use the usual ones",
            "touch /tmp/new.$$ /var/tmp/new.$$ && rm /tmp/new.$$".to_owned(),
        ),
        ("read what others have there", format!("grep secret '{there}'/secret")),
    ];
    let done = Stage::new()
        .tried(&deeds, "sandbox", |builder| builder.env("TMPDIR", &there))
        .await;
    assert_eq!(done, ["use it", "use the usual ones"]);
}

#[actix_rt::test]
async fn folders_are_shown_and_opened_by_keys() {
    let Some(stage) = Stage::apart() else { return };
    let home = shown(&stage.home);
    let elsewhere = shown(&stage.elsewhere);
    let deeds = [
        ("read home", format!("grep secret {home}/secret")),
        ("write home", format!("touch {home}/new")),
        ("write elsewhere", format!("touch {elsewhere}/new")),
        (
            "read the configuration",
            format!("grep secret {}/config.json", shown(&stage.folder)),
        ),
    ];
    let done = stage.tried(&deeds, "sandbox", |builder| {
        // A path that contains the server's own directories does not make those visible.
        builder
            .set("sandbox.readable", serde_json::json!([home, stage.folder.path()]))
            .set("sandbox.writable", elsewhere.as_str())
    });
    assert_eq!(done.await, ["read home", "write elsewhere"]);
    assert!(stage.elsewhere.path().join("new").exists());
}

#[actix_rt::test]
async fn the_environment_is_what_webots_needs_and_what_a_key_adds() {
    needs!("bwrap");
    let stage = Stage::new();
    let has = |name: &str| format!("test -n \"${{{name}}}\"");
    let deeds = [
        "PATH",
        "HOME",
        "DISPLAY",
        "LC_ALL",
        "SECRET_OF_THE_SERVER",
        "ROS_DOMAIN_ID",
        "ONE",
        "ONE_MORE",
    ]
    .map(|name| (name, has(name)));
    for level in LEVELS {
        let done = stage.tried(&deeds, level, |builder| {
            let builder = builder
                .env("ROS_DOMAIN_ID", "7")
                .env("ONE", "1")
                .env("ONE_MORE", "2")
                .env("LC_ALL", "C");
            builder.set(
                "environment",
                serde_json::json!(["ROS_*", "ONE", "DEMO_SIMULATOR_BIND"]),
            )
        });
        assert_eq!(
            done.await,
            ["PATH", "HOME", "DISPLAY", "LC_ALL", "ROS_DOMAIN_ID", "ONE"],
            "{level}"
        );
    }
}

#[actix_rt::test]
async fn empty_folders_of_a_sandbox_stay_empty() {
    needs!("bwrap");
    let help = Command::new("bwrap").arg("--help").output().unwrap();
    if !String::from_utf8_lossy(&help.stdout).contains("--disable-userns") {
        return skip("bubblewrap is older than 0.8");
    }
    let stage = Stage::new();
    let set = |file: &str| format!("value=$(cat {file}) && echo $value > {file}");
    let hidden = |name| format!("ls {0} && touch {0}/new", shown(stage.folder.path().join(name)));
    let deeds = [
        ("fill /dev", "touch /dev/new".to_owned()),
        ("fill /run", "touch /run/new".to_owned()),
        ("fill the log", hidden("log")),
        ("fill the cache", hidden("cache")),
        ("use devices", "head -c 1 /dev/urandom > /dev/null".to_owned()),
        ("use the runtime folder", "touch $XDG_RUNTIME_DIR/new".to_owned()),
        (
            "use shared memory",
            "head -c 4000000 /dev/zero > /dev/shm/one".to_owned(),
        ),
        ("fill it", "head -c 4000000 /dev/zero > /dev/shm/other".to_owned()),
        (
            "read the settings of the kernel",
            "test -n \"$(cat /proc/sys/vm/swappiness)\"".to_owned(),
        ),
        ("make a user namespace", "unshare --user true".to_owned()),
        ("make another sandbox", "bwrap --bind / / true".to_owned()),
        ("set swappiness", set("/proc/sys/vm/swappiness")),
        ("set what a namespace has", set("/proc/sys/kernel/msgmax")),
        ("set the limit of namespaces", set("/proc/sys/user/max_user_namespaces")),
    ];
    for before in ["true"].into_iter().chain(as_nobody()) {
        // Only folders that exist when the server starts are hidden.
        for name in ["log", "cache"] {
            let folder = stage.folder.path().join(name);
            std::fs::remove_dir_all(&folder).ok();
            std::fs::create_dir(&folder).unwrap();
            open(&folder);
        }
        let done = stage
            .tried(&deeds, "sandbox", |builder| {
                builder.before(before).set("limits.disk", 5)
            })
            .await;
        let allowed = [
            "use devices",
            "use the runtime folder",
            "use shared memory",
            "read the settings of the kernel",
        ];
        assert_eq!(done, allowed, "{before}");
    }
}
