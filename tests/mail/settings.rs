//! The keys of the configuration that mails need.

use serde_json::json;
use webots_fleet::session::mail::{self, test_mail};

use super::loaded;

#[actix_rt::test]
async fn without_one_of_the_three_keys_mails_are_off() {
    for key in ["administrator", "mailServer", "mailSender"] {
        let mut config = loaded(25, &json!({}));
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
