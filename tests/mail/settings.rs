//! The keys of the configuration that mails need.

use serde_json::json;
use webots_fleet::session::config::SessionConfig;
use webots_fleet::session::mail::{self, test_mail};
use webots_fleet::shared::config::load;

use super::config;

#[actix_rt::test]
async fn without_one_of_the_three_keys_mails_are_off() {
    for key in ["administrator", "mailServer", "mailSender"] {
        let mut config = config(25, &json!({}));
        match key {
            "administrator" => config.administrator = None,
            "mailServer" => config.mail_server = None,
            _ => config.mail_sender = None,
        }
        assert!(mail::start(&config, mail::Channel::Mail).is_none(), "there is a mailer without {key}");
        let error = test_mail(&config).await.unwrap_err().to_string();
        assert_eq!(error, format!("notifications are off: {key} is not set"));
    }
}

#[test]
fn a_wrong_address_is_a_fault_of_the_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("wrong.json");
    for (key, value) in [
        ("administrator", "nobody"),
        ("administrator", "a@example.org\r\nBcc: b@example.org"),
        ("mailSender", "a@example.org, b@example.org"),
        ("mailServer", "smtp.example.org:587"),
    ] {
        let keys = json!({"server": "localhost", "port": 1999, "simulationServers": [], key: value});
        std::fs::write(&file, keys.to_string()).unwrap();
        let error = load::<SessionConfig>(&file).unwrap_err().to_string();
        assert!(error.starts_with(&format!("{}: {key}: {value:?} is no ", file.display())), "{error}");
    }
    let keys =
        json!({"server": "localhost", "port": 1999, "simulationServers": [], "administrator": "", "mailSender": null});
    std::fs::write(&file, keys.to_string()).unwrap();
    assert_eq!(load::<SessionConfig>(&file).unwrap().warnings, [""; 0]);
}
