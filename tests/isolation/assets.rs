//! What Webots downloads is kept for the next simulation of the same repository, and no world can spoil it for others.

use crate::simulation::scene::nothing_left;
use crate::support::{Client, DEMO, Forge, Server, Webots, arm, simulation_server, until, world};

/// Downloads an asset if it is not there, as Webots does, and prints which. Then leaves in the folder what harms a server
/// that reads it without care, and tries to change what is kept.
const SCRIPT: &str = r#"
asset() { printf "%040d" "$1"; }
cd ~ && mkdir -p .cache/Cyberbotics/Webots/assets && cd .cache/Cyberbotics/Webots/assets
if [ -e "$(asset 1)" ]; then echo "FOUND $(cat "$(asset 1)")"; else echo DOWNLOADED; echo "of $OLDPWD" >"$(asset 1)"; fi
kept=$(readlink "$(asset 1)")
if [ -n "$kept" ]; then
    (echo spoiled >"$kept") 2>/dev/null && echo SPOILED
    (rm -f "$kept" || touch "${kept%/*}/$(asset 7)") 2>/dev/null && echo CHANGED
fi
ln -sf /etc/passwd "$(asset 2)"
[ -e "$(asset 3)" ] || mkfifo "$(asset 3)"
mkdir -p "$(asset 4)"
truncate -s 1000M "$(asset 5)"
echo other >other
cd "$OLDPWD"
echo END
"#;

/// Runs a simulation of this world to its end; returns what its Webots has printed.
async fn printed(server: &Server, world: &str) -> String {
    let mut client = Client::start(server, world).await;
    client.until("webots:").await;
    let file = server.output_file(&client);
    let text = || std::fs::read_to_string(&file).unwrap_or_default();
    until("all is done", async || text().contains("END")).await;
    let text = text();
    client.leave().await;
    nothing_left(server, 1).await;
    text
}

#[actix_rt::test]
async fn what_webots_has_downloaded_is_there_for_the_next_world_of_its_repository() {
    needs!("bwrap");
    let forge = Forge::with_arm();
    forge.commit("lab/leg", "main", &[("worlds/a.wbt", "#VRML_SIM R2025a utf8\n")]);
    let webots = Webots::script(&format!("(\n{SCRIPT}\n)\n{DEMO} \"$@\" & wait"));
    let server = simulation_server(&webots.path(), forge.path(), 1)
        .set("isolation", "sandbox")
        .start()
        .await;
    let leg = world("lab/leg", "main", "worlds/a.wbt");
    let first = printed(&server, &arm()).await;
    assert!(first.contains("DOWNLOADED"), "{first}");
    for _ in 0..2 {
        let again = printed(&server, &arm()).await;
        assert!(again.contains("FOUND of"), "{again}");
        assert!(!again.contains("SPOILED") && !again.contains("CHANGED"), "{again}");
    }
    let other = printed(&server, &leg).await;
    assert!(other.contains("DOWNLOADED"), "another repository's: {other}");
    // Of all that was left, only files are kept.
    let kept: Vec<_> = std::fs::read_dir(server.folder.join("cache/assets"))
        .unwrap()
        .flat_map(|repository| std::fs::read_dir(repository.unwrap().path()).unwrap())
        .map(|file| file.unwrap().file_name().into_string().unwrap())
        .collect();
    assert_eq!(kept, [format!("{:040}", 1), format!("{:040}", 1)]);
}
