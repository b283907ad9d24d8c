//! Mails to the administrator, through a real SMTP server (aiosmtpd) on loopback. `tests/python.sh` prepares it.

mod failures;
mod log;
mod login;
mod notices;

use std::time::SystemTime;

use ::log::Level;
use serde_json::{Value, json};
use tokio::sync::mpsc::UnboundedSender;
use webots_fleet::session::config::SessionConfig;
use webots_fleet::session::mail::{self, Channel, Notice, NoticeKind};
use webots_fleet::shared::config::Configuration;
use webots_fleet::shared::domain::Load;

use self::log::{keep_log, logged};

const LOGIN: &[&str] = &["--login", "fleet:s3cret"];

/// A configuration for mails to this port of this machine; `more` replaces and adds keys.
fn config(port: u16, more: &Value) -> Value {
    let mut keys = json!({
        "server": "session.example.org",
        "ssl": true,
        "port": 1999,
        "simulationServers": [],
        "administrator": "Admin <admin@example.org>",
        "mailServer": "127.0.0.1",
        "mailServerPort": port,
        "mailSender": "fleet@example.org",
        "mailSenderUser": "fleet",
        "timing": {"gather": 0.1, "flapping": 0.6, "mailRetry": 0.1, "mailPatience": 60, "mailAnswer": 10},
    });
    for (key, value) in more.as_object().unwrap() {
        match (keys.get_mut(key), value) {
            (Some(Value::Object(old)), Value::Object(new)) => old.extend(new.clone()),
            _ => keys[key] = value.clone(),
        }
    }
    keys
}

/// The same as the server has it.
fn loaded(port: u16, more: &Value) -> SessionConfig {
    let mut config: SessionConfig = serde_json::from_value(config(port, more)).unwrap();
    assert_eq!(config.complete(std::path::Path::new("main.json")).unwrap(), [""; 0]);
    config
}

fn start(port: u16, more: &Value) -> UnboundedSender<Notice> {
    keep_log();
    mail::start(&loaded(port, more)).pop().expect("mails are on")
}

async fn test_mail(config: &SessionConfig) -> Result<String, String> {
    Channel::mail(config)?.test(config).await
}

fn notice(host: &str, event: NoticeKind) -> Notice {
    let server = format!("{host}:2000");
    let error = (event == NoticeKind::NotResponding).then(|| "connection refused".to_owned());
    Notice { server, event, load: Load::try_from(97.25).ok(), error, at: SystemTime::now() }
}

fn nothing_unexpected(port: u16) {
    assert_eq!((logged(Level::Warn, port), logged(Level::Error, port)), (vec![], vec![]));
}
