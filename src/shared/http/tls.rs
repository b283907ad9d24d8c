//! Requests to https servers: whom they trust, and why they don't, in words.
//!
//! Trusted are the authorities of the system's store, where a lab adds its own with `update-ca-certificates`; or those
//! of the file `SSL_CERT_FILE` and the folders `SSL_CERT_DIR` alone, where one of these variables is set.

use std::sync::Arc;

use awc::error::{ConnectError, SendRequestError};
use rustls::{CertificateError, ClientConfig, Error, RootCertStore};

/// How requests are encrypted. What can't be read of the authorities is told in the log: their servers won't be
/// trusted, all others will.
#[must_use]
pub fn client_config() -> Option<Arc<ClientConfig>> {
    let found = rustls_native_certs::load_native_certs();
    for problem in &found.errors {
        log::warn!("some certificate authorities can't be read: {problem}");
    }
    let mut roots = RootCertStore::empty();
    let (_, unusable) = roots.add_parsable_certificates(found.certs);
    if unusable > 0 {
        log::warn!("{unusable} certificates of authorities can't be used");
    }
    if roots.is_empty() {
        log::warn!("no certificate authority is known: no https server will be trusted");
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions();
    match builder {
        Ok(builder) => Some(Arc::new(builder.with_root_certificates(roots).with_no_client_auth())),
        Err(error) => {
            log::error!("https is off: {error}");
            None
        }
    }
}

/// Why a request failed, where encryption is the cause.
#[must_use]
pub fn reason(error: &SendRequestError) -> Option<String> {
    let SendRequestError::Connect(ConnectError::Io(error)) = error else {
        return None;
    };
    let error = error.get_ref()?.downcast_ref::<Error>()?;
    Some(match error {
        Error::InvalidCertificate(problem) => format!("its certificate is not trusted: {}", mistrust(problem)),
        Error::InvalidMessage(_) => "it does not speak https there".to_owned(),
        Error::AlertReceived(alert) => format!("it refuses to encrypt: {alert:?}"),
        other => format!("encryption failed: {other}"),
    })
}

fn mistrust(problem: &CertificateError) -> String {
    match problem {
        CertificateError::UnknownIssuer => {
            "it comes from an authority that is not known here (update-ca-certificates and SSL_CERT_FILE make one known)"
                .to_owned()
        }
        CertificateError::ExpiredContext { not_after, .. } => format!("it expired on {}", date(not_after.as_secs())),
        CertificateError::NotValidYetContext { not_before, .. } => {
            format!("it is valid only from {}", date(not_before.as_secs()))
        }
        CertificateError::NotValidForNameContext { expected, presented } => {
            let names: Vec<&str> = presented.iter().map(|name| bare(name)).collect();
            let names: String = names.join(", ").chars().filter(|letter| !letter.is_control()).take(200).collect();
            format!("it is for {names}, not for {}", expected.to_str())
        }
        CertificateError::BadSignature => "the authority that it names has not signed it".to_owned(),
        CertificateError::Revoked => "it was revoked".to_owned(),
        other if format!("{other:?}").contains("CaUsedAsEndEntity") => {
            "it is that of an authority (CA:TRUE), where one of a server is needed".to_owned()
        }
        other => other.to_string(),
    }
}

/// A name as rustls tells it, `DnsName("lab.org")`, without its kind.
fn bare(name: &str) -> &str {
    let inner = name.split_once('(').and_then(|(_, rest)| rest.strip_suffix(')'));
    inner.map_or(name, |inner| inner.trim_matches('"'))
}

fn date(seconds: u64) -> String {
    let time = i64::try_from(seconds).ok().and_then(|seconds| jiff::Timestamp::from_second(seconds).ok());
    time.map_or_else(|| "a day that is none".to_owned(), |time| format!("{time:.0}"))
}
