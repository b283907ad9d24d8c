//! Runs the commands of docs/containers.md, with its files as they are.
//!
//! | stands in | for | because |
//! |---|---|---|
//! | a script that does nothing | `apt-get`, `systemctl` | the tests must not change the machine |
//! | `docker image inspect` | `docker pull` | no registry is reachable: the images must exist under the names that are pulled |
//! | `setpriv` | `sudo` | the package's user does not exist on this machine; the commands run as another user than root |

use std::os::unix::fs::symlink;
use std::process::{Command, Stdio};

use super::daemon::{ask, build_from, docker, host, of_service, open_socket, running, server_with};
use super::image::NAME;
use crate::support::{make_program, open_folder, page};

/// The code blocks of the page in this language.
fn blocks(language: &str) -> Vec<String> {
    page::blocks(&page::page("containers.md"), language)
}

/// A machine that runs the commands of a page.
struct Machine(tempfile::TempDir);

impl Machine {
    fn new() -> Self {
        let machine = Self(open_folder());
        for part in ["bin", "work", "etc/webots-fleet/simulation"] {
            std::fs::create_dir_all(machine.0.path().join(part)).unwrap();
        }
        machine
    }

    /// A script in place of a real program.
    fn script(&self, name: &str, text: &str) {
        make_program(&self.0.path().join("bin").join(name), text);
    }

    /// The output of these commands. They run in a new network, with an overlay over the real /etc.
    fn run(&self, commands: &str) -> String {
        let etc = "mount -t overlay overlay -o lowerdir=/etc,upperdir=$FOLDER/etc,workdir=$FOLDER/work /etc";
        let output = Command::new("unshare")
            .args([
                "--mount",
                "--net",
                "--propagation",
                "private",
                "bash",
                "-euxo",
                "pipefail",
                "-c",
            ])
            .arg(format!("{etc}\n{commands}"))
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .env(
                "PATH",
                format!("{}/bin:{}", self.0.path().display(), std::env::var("PATH").unwrap()),
            )
            .env("FOLDER", self.0.path())
            .env("DOCKER_HOST", host())
            .stdin(Stdio::null())
            .output()
            .unwrap();
        let told = format!(
            "{}{}",
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
        assert!(output.status.success(), "{told}");
        told
    }
}

#[actix_rt::test]
async fn the_commands_for_containers_lead_to_a_ready_server() {
    let Some(_docker) = docker().await else { return };
    open_socket();
    let machine = Machine::new();
    std::fs::write(
        machine.0.path().join("etc/webots-fleet/simulation/main.json"),
        &blocks("json")[0],
    )
    .unwrap();
    // All tests use the images of one version.
    let commands = blocks("sh").concat();
    for image in commands
        .lines()
        .filter_map(|line| line.strip_prefix("docker pull cyberbotics/webots.cloud:"))
    {
        ask(&["tag", NAME, &format!("cyberbotics/webots.cloud:{image}")]);
    }
    machine.script("apt-get", "");
    machine.script("systemctl", "");
    let real = "PATH=${PATH#*:}; [ \"$1\" != pull ] || exec docker image inspect \"$2\"; exec docker \"$@\"";
    machine.script("docker", real);
    machine.script(
        "sudo",
        "exec setpriv --reuid 12345 --regid 12345 --clear-groups \"${@:3}\"",
    );
    symlink(
        env!("CARGO_BIN_EXE_simulation-server"),
        machine.0.path().join("bin/simulation-server"),
    )
    .unwrap();
    // Loads the packet filter of the page.
    let filter = "PATH=$PATH:/usr/sbin\nnft -f deploy/nftables/containers.nft\nnft -f /etc/webots-fleet/nftables/lab.nft\n\
                  nft list table inet webots_fleet";
    let told = machine.run(&format!("(\n{commands}\n)\n{filter}"));
    for words in ["\ndocker: it answers; worlds run in", "192.168.7.0/24 . 8000-8010"] {
        assert!(told.contains(words), "{words:?} is not in {told}");
    }
    assert!(
        !told.contains("unknown key") && !told.contains("warning: docker"),
        "{told}"
    );
}

#[actix_rt::test]
async fn the_dockerfile_of_the_page_on_containers_is_built_and_runs() {
    let Some(_docker) = docker().await else { return };
    // Packages can't be downloaded here.
    let image = "webots-fleet.test/packages";
    build_from(
        &format!("FROM {NAME}\nRUN ln -s /bin/true /usr/local/bin/apt-get\n"),
        image,
    );
    let makefile = ("controllers/mine/Makefile", "all:\n\ttouch made\n");
    let server = server_with(&[("Dockerfile", &blocks("dockerfile").concat()), makefile]);
    let (server, _client) = running(server.set("container", serde_json::json!({ "image": image }))).await;
    let made = "/usr/local/webots-project/controllers/mine/made";
    ask(&["exec", &of_service(&server, "webots")[0], "ls", made]);
}
