//! What a web client sends.

use webots_fleet::simulation::protocol::{ClientRequest, error};

#[test]
fn a_client_is_answered_in_the_form_of_the_protocol_whatever_it_sends() {
    super::try_many(include_str!("seeds/client_message.txt"), |input| {
        let text = String::from_utf8_lossy(input);
        match ClientRequest::parse(&text) {
            Ok(Some(ClientRequest::Start { url, .. })) => assert!(url.len() <= text.len()),
            Ok(Some(ClientRequest::Resume(_) | ClientRequest::Keep)) => {}
            Ok(Some(ClientRequest::ResetController(file))) => assert!(file.len() <= text.len()),
            Ok(None) => assert!(serde_json::from_str::<serde_json::Value>(&text).is_ok()),
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
