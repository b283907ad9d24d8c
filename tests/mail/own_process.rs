//! Tests that need an environment of their own.

use std::path::PathBuf;
use std::process::Command;

/// A file for an authority's certificate that this process trusts.
///
/// Who is trusted comes with the environment of a process, so that the test is run again in one of its own: there this
/// gives back the file, here nothing once the other has succeeded.
pub fn trusted_authority(test: &str) -> Option<String> {
    let key = "SSL_CERT_FILE";
    let file = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("{test}-{}.pem", std::process::id()));
    let parent = std::env::var("FLEET_TEST_OWN_PROCESS").ok();
    if parent.as_deref() == Some(test) {
        return std::env::var(key).ok();
    }
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", &format!("mail::login::{test}"), "--nocapture"])
        .env(key, &file)
        .env("FLEET_TEST_OWN_PROCESS", test)
        .output()
        .unwrap();
    std::fs::remove_file(&file).expect("the SMTP server wrote its authority's certificate");
    let texts = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && texts.0.contains("1 passed"), "{}{}", texts.0, texts.1);
    None
}
