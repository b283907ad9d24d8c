//! Simulators that misbehave harm nobody.

use super::scene::{DEMO, arm, nothing_left};
use crate::support::client::Client;
use crate::support::git::Forge;
use crate::support::program::{server_of, simulation_server};
use crate::support::webots::Webots;
use crate::support::{http, until};

#[actix_rt::test]
async fn the_output_of_a_simulation_is_kept_and_printable() {
    let webots = Webots::script(&format!(
        "printf 'one\\nred \\033[31m text\\n\\377 no text\\nlast without end' >&2\n{DEMO} \"$@\" & wait"
    ));
    let server = server_of(webots, 1).set("timing.heartbeat", 0.1).start().await;
    let mut client = Client::ready(&server).await;
    client.until(".").await;
    let url = server.url(&format!("/output?id={}", client.id()));
    let text = http::get(&url).await.text();
    let printed = "one\nred  [31m text\n\u{fffd} no text\nlast without end";
    assert!(text.starts_with(printed), "{text:?}");
    client.leave().await;
    nothing_left(&server, 1).await;
    let has_events = |text: &str| text.contains("ended (left)") && text.contains(&format!("\n\n{printed}"));
    until("it is kept with the events", async || has_events(&http::get(&url).await.text())).await;
}

#[actix_rt::test]
async fn an_output_that_can_not_be_kept_fails_no_start() {
    let (forge, webots) = (Forge::with_arm(), Webots::script("echo 'last words'; exit 3"));
    let server = simulation_server(&webots.path(), forge.path(), 1).start().await;
    let logs = server.folder.join("log/simulation");
    std::fs::create_dir_all(&logs).unwrap();
    // Not even root can make a folder in a file.
    std::fs::write(logs.join("instances"), "").unwrap();
    let mut client = Client::start(&server, &arm()).await;
    let told = client.until("loading: Error:").await;
    assert!(told.contains("Webots ended with exit code 3. Its last output: last words"), "{told}");
    assert_eq!(server.log().matches("what Webots prints is not kept").count(), 1);
    nothing_left(&server, 1).await;
}
