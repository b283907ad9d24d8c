//! What a web client sends.

use webots_fleet::simulation::protocol::{ClientRequest, error};

#[test]
fn a_client_is_answered_in_the_form_of_the_protocol_whatever_it_sends() {
    super::try_many(include_str!("seeds/client_message.txt"), |input| {
        let text = String::from_utf8_lossy(input);
        match ClientRequest::parse(&text) {
            Ok(request) => {
                let texts = [request.reset_controller, request.resume, request.start.map(|start| start.url)];
                assert!(texts.into_iter().flatten().all(|one| one.len() <= text.len()));
                assert!(serde_json::from_str::<serde_json::Value>(&text).is_ok());
            }
            Err(wrong) => {
                let told = error(&wrong.to_string());
                assert!(told.starts_with("loading: Error: Wrong message: "), "{told}");
                // Webots' page puts the text into its HTML.
                assert!(!told.contains(['<', '>', '&']) && super::is_one_line(&told), "{told}");
                assert!(!told.contains("expected struct"), "{told}");
            }
        }
    });
}
