//! docs/containers.md by doing: its commands and its files as they stand; and of docs/scaling.md what needs root.
//!
//! | stands in | for | because |
//! |---|---|---|
//! | a script that does nothing | `apt-get`, `systemctl` | the machine of the tests stays as it is |
//! | `docker image inspect` | `docker pull` | no registry can be reached: what is pulled has to be there by that name |
//! | scripts | `certbot`, `docker` | no certificate authority and no Swarm are here |
//! | `setpriv` | `sudo` | the user of the package is not on this machine: another one who is not root |

use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::process::{Command, Stdio};

use super::daemon::{ask, build_from, docker, host, of_service, open_socket, running, server_with};
use super::image::NAME;
use crate::support::page;

/// The blocks of the page in this language.
fn blocks(language: &str) -> Vec<String> {
    page::blocks(&page::page("containers.md"), language)
}

fn script(folder: &Path, name: &str, text: &str) {
    let path = folder.join(name);
    std::fs::write(&path, format!("#!/bin/bash\n{text}\n")).unwrap();
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap();
}

#[actix_rt::test]
async fn the_commands_of_the_page_on_containers_lead_to_a_server_that_can_start() {
    let Some(_docker) = docker().await else { return };
    open_socket();
    let folder = tempfile::tempdir().unwrap();
    std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o755)).unwrap();
    let (bin, configuration) = (folder.path().join("bin"), "etc/webots-fleet/simulation");
    for part in ["bin", "work", configuration] {
        std::fs::create_dir_all(folder.path().join(part)).unwrap();
    }
    std::fs::write(folder.path().join(configuration).join("main.json"), &blocks("json")[0]).unwrap();
    // The images of the tests are those of one version.
    let commands = blocks("sh").concat();
    for image in commands.lines().filter_map(|line| line.strip_prefix("docker pull cyberbotics/webots.cloud:")) {
        ask(&["tag", NAME, &format!("cyberbotics/webots.cloud:{image}")]);
    }
    script(&bin, "apt-get", "");
    script(&bin, "systemctl", "");
    script(
        &bin,
        "docker",
        "PATH=${PATH#*:}; [ \"$1\" != pull ] || exec docker image inspect \"$2\"; exec docker \"$@\"",
    );
    script(&bin, "sudo", "exec setpriv --reuid 12345 --regid 12345 --clear-groups \"${@:3}\"");
    symlink(env!("CARGO_BIN_EXE_simulation-server"), bin.join("simulation-server")).unwrap();
    // The machine's own /etc stays below. What the page says of the packet filter is loaded into a network of its own.
    let machine = "mount -t overlay overlay -o lowerdir=/etc,upperdir=$0/etc,workdir=$0/work /etc && bash -euxo pipefail \
                   -c \"$1\" && PATH=$PATH:/usr/sbin && nft -f deploy/nftables/containers.nft && nft -f \
                   /etc/webots-fleet/nftables/lab.nft && nft list table inet webots_fleet";
    let output = Command::new("unshare")
        .args(["--mount", "--net", "--propagation", "private", "bash", "-c", machine])
        .arg(folder.path())
        .arg(&commands)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .env("PATH", format!("{}:{}", bin.display(), std::env::var("PATH").unwrap()))
        .env("DOCKER_HOST", host())
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let told = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{told}");
    for words in
        ["\ndocker: it answers; worlds run in", "\ntemplates: those of this server", "192.168.7.0/24 . 8000-8010"]
    {
        assert!(told.contains(words), "{words:?} is not in {told}");
    }
    assert!(!told.contains("unknown key") && !told.contains("warning: docker"), "{told}");
}

#[actix_rt::test]
async fn the_dockerfile_of_the_page_on_containers_is_built_and_runs() {
    let Some(_docker) = docker().await else { return };
    // Packages can't be had here.
    let image = "webots-fleet.test/packages";
    build_from(&format!("FROM {NAME}\nRUN ln -s /bin/true /usr/local/bin/apt-get\n"), image);
    let makefile = ("controllers/mine/Makefile", "all:\n\ttouch made\n");
    let server = server_with(&[("Dockerfile", &blocks("dockerfile").concat()), makefile]);
    let (server, _client) = running(server.set("container", serde_json::json!({ "image": image }))).await;
    let made = "/usr/local/webots-project/controllers/mine/made";
    ask(&["exec", &of_service(&server, "webots")[0], "ls", made]);
}

#[actix_rt::test]
async fn the_certificate_of_the_page_on_scaling_is_made_and_renewed() {
    let Some(_docker) = docker().await else { return };
    let folder = tempfile::tempdir().unwrap();
    for part in ["bin", "work", "etc", "renewed"] {
        std::fs::create_dir_all(folder.path().join(part)).unwrap();
    }
    for (name, text) in [("fullchain.pem", "a new chain"), ("privkey.pem", "a new key")] {
        std::fs::write(folder.path().join("renewed").join(name), text).unwrap();
    }
    let (bin, folder) = (folder.path().join("bin"), folder.path());
    // It asks its authority, and then runs what it was given for that.
    script(&bin, "certbot", "export RENEWED_LINEAGE=$FOLDER/renewed\nexec sh -ec \"${!#}\"");
    script(&bin, "docker", "[ $1 = kill ] || { echo door; exit; }\necho \"$*\" >$FOLDER/kill");
    let commands = page::blocks(&page::page("scaling.md"), "sh").concat();
    let shown = "openssl x509 -in $PWD/tls.crt -noout -subject; stat -c '%u %a' tls.key; ls -la";
    // Before certbot is asked, the door has a certificate of its own making that its user may read.
    let (before, after) = commands.split_once("# After it:").unwrap();
    let machine = "mount -t overlay overlay -o lowerdir=/etc,upperdir=$0/etc,workdir=$0/work /etc && bash -euo pipefail -c \"$1\"";
    let output = Command::new("unshare")
        .args(["--mount", "--propagation", "private", "bash", "-c", machine])
        .arg(folder)
        .arg(format!("{before}\n{shown}\n{after}\ncat tls.crt tls.key; stat -c '%u %a' tls.key"))
        .env("PATH", format!("{}:{}", bin.display(), std::env::var("PATH").unwrap()))
        .env("FOLDER", folder)
        .output()
        .unwrap();
    let told = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{told}");
    for words in ["fleet.example.org", "a new chain", "a new key"] {
        assert!(told.contains(words), "{words} is not in {told}");
    }
    assert_eq!(told.matches("101 600").count(), 2, "{told}");
    assert_eq!(std::fs::read_to_string(folder.join("kill")).unwrap(), "kill --signal HUP door\n");
}
