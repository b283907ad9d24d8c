//! Whose worlds run here.

use crate::support::{Forge, Webots, is_told, simulation_server};

#[actix_rt::test]
async fn a_world_runs_only_where_its_repository_is_allowed() {
    let (forge, webots) = (Forge::with_arm(), Webots::script("echo ran; exit 1"));
    for name in ["lab-evil/arm", "lab/secret"] {
        forge.commit(name, "main", &[("worlds/a.wbt", "#VRML_SIM R2025a utf8\n")]);
    }
    let builder = simulation_server(&webots.path(), forge.path(), 2);
    let blocked = serde_json::json!(["https://github.com/lab/secret"]);
    let server = builder.set("blockedRepositories", blocked).start().await;
    let end = "blob/main/worlds/a.wbt";
    let not_allowed = "Docker not enabled: cannot host simulations from repositories outside of those that this simulation server allows";
    let is_blocked = "Cannot run simulation from blocked repository";
    let table = [
        (format!("https://github.com/lab/arm/{end}"), "Its last output: ran"),
        (format!("https://github.com/lab-evil/arm/{end}"), not_allowed),
        (format!("https://github.com//lab-evil//arm/{end}"), not_allowed),
        (format!("https://github.com.evil.org/lab/arm/{end}"), not_allowed),
        (format!("https://evil.org/github.com/lab/{end}"), not_allowed),
        (format!("https://github.com/LAB/Secret.git/{end}"), is_blocked),
        ("https://github.com/lab/secret/src/branch/main/worlds/a.wbt".to_owned(), is_blocked),
        ("https://github.com/lab/secret/-/blob/main/worlds/a.wbt".to_owned(), is_blocked),
        (format!("https://github.com/lab/%2e%2e/lab-evil/arm/{end}"), "Wrong Webots simulation URL"),
    ];
    for (url, words) in table {
        is_told(&server, &url, words).await;
    }
}
