//! Requests to https servers: which certificates are trusted, and why others are not.
//!
//! The trust store is the system's, to which a lab adds its own authority with `update-ca-certificates`. If one of the
//! environment variables `SSL_CERT_FILE` and `SSL_CERT_DIR` is set, the store is that file or directory alone.

use std::sync::Arc;

use awc::error::{ConnectError, SendRequestError};
use rustls::{ClientConfig, Error, RootCertStore};

use crate::shared::text::excerpt;

/// Longest text about a certificate, in characters: any server may have sent it.
const MAX_REASON_LENGTH: usize = 300;

/// Returns the TLS configuration of requests; `None` if rustls can't be set up.
///
/// Unreadable parts of the trust store are logged. Only servers that need them are not trusted.
pub fn client_config() -> Option<Arc<ClientConfig>> {
    let found = rustls_native_certs::load_native_certs();
    for problem in &found.errors {
        log::warn!("some certificate authorities can't be read: {problem}");
    }
    let mut roots = RootCertStore::empty();
    roots.add_parsable_certificates(found.certs);
    if roots.is_empty() {
        log::warn!("no certificate authority is known: no https server will be trusted");
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions();
    let builder = builder.inspect_err(|error| log::error!("https is off: {error}")).ok()?;
    Some(Arc::new(builder.with_root_certificates(roots).with_no_client_auth()))
}

/// Returns why a request failed, if TLS is the cause.
pub fn reason(error: &SendRequestError) -> Option<String> {
    let SendRequestError::Connect(ConnectError::Io(error)) = error else {
        return None;
    };
    let reason = match error.get_ref()?.downcast_ref::<Error>()? {
        Error::InvalidMessage(_) => "it does not speak https there".to_owned(),
        other => in_words(other),
    };
    Some(excerpt(&reason, MAX_REASON_LENGTH))
}

/// An error of TLS.
pub fn in_words(error: &Error) -> String {
    match error {
        Error::InvalidCertificate(problem) => format!("its certificate is not trusted: {problem}"),
        other => format!("encryption failed: {other}"),
    }
}
