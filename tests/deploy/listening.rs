//! Without `bind`, a server listens on all IPv4 and IPv6 addresses. The session server is tested; both servers share the
//! function that listens.

use std::process::Command;

use serde_json::json;

/// Starts a server in its own network and requests a page by IPv4 and IPv6. Prints the first line of each answer.
const ASK: &str = r#"
    ip link set lo up
    "$1" "$2" >/dev/null &
    for host in 127.0.0.1 ::1; do
        for ((try = 0; try < 200; try++)); do
            if { exec 3<>"/dev/tcp/$host/$3"; } 2>/dev/null; then
                printf 'GET /load HTTP/1.0\r\n\r\n' >&3
                head --lines=1 <&3
                break
            fi
            sleep 0.1
        done
    done
    kill $!
    wait $!
"#;

#[test]
fn without_a_word_on_it_a_server_listens_on_both_families() {
    let own_network = ["unshare --net", "unshare --net --map-root-user"]
        .into_iter()
        .find(|command| {
            Command::new("sh")
                .args(["-c", &format!("{command} true")])
                .output()
                .unwrap()
                .status
                .success()
        });
    let Some(own_network) = own_network else {
        assert!(std::env::var_os("CI").is_none(), "unshare --net is not allowed here");
        return crate::support::skip("unshare --net is not allowed here");
    };
    let folder = tempfile::tempdir().unwrap();
    let inside = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let config = json!({"server": "localhost", "port": 2000, "logDir": inside("log"), "simulationServers": []});
    std::fs::write(inside("config.json"), config.to_string()).unwrap();
    let mut command = Command::new("timeout");
    command
        .args(["60"])
        .args(own_network.split(' '))
        .args(["bash", "-c", ASK, "ask"]);
    let output = command
        .args([env!("CARGO_BIN_EXE_session-server"), &inside("config.json"), "2000"])
        .output()
        .unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(said.replace('\r', ""), "HTTP/1.0 200 OK\nHTTP/1.0 200 OK\n", "{errors}");
}
