//! Requests to https servers: which certificates are trusted, and why others are not.
//!
//! The trust store is the system's, to which a lab adds its own authority with `update-ca-certificates`. If one of the
//! environment variables `SSL_CERT_FILE` and `SSL_CERT_DIR` is set, it is that file or directory alone.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use awc::error::{ConnectError, SendRequestError};
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::client::{WebPkiServerVerifier, verify_server_name};
use rustls::crypto::CryptoProvider;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, Error, OtherError, RootCertStore, SignatureScheme,
};

use crate::shared::run::timestamp;

/// Returns the TLS configuration of requests; `None` if rustls can't be set up.
///
/// Unreadable parts of the trust store are logged. Only servers that need them are not trusted.
pub fn client_config() -> Option<Arc<ClientConfig>> {
    let found = rustls_native_certs::load_native_certs();
    for problem in &found.errors {
        log::warn!("some certificate authorities can't be read: {problem}");
    }
    let mut roots = RootCertStore::empty();
    let (_, unusable) = roots.add_parsable_certificates(found.certs.iter().cloned());
    if unusable > 0 {
        log::warn!("{unusable} certificates of authorities can't be used");
    }
    if roots.is_empty() {
        log::warn!("no certificate authority is known: no https server will be trusted");
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(Arc::clone(&provider)).with_safe_default_protocol_versions();
    let builder = builder.inspect_err(|error| log::error!("https is off: {error}")).ok()?;
    let builder = match Verifier::new(roots, found.certs, provider) {
        Some(verifier) => builder.dangerous().with_custom_certificate_verifier(Arc::new(verifier)),
        None => builder.with_root_certificates(RootCertStore::empty()),
    };
    Some(Arc::new(builder.with_no_client_auth()))
}

/// Verifies certificates as webpki does, and also accepts server certificates that are themselves in the trust store.
///
/// webpki refuses a certificate that may sign others (`CA:TRUE`) as a server's own. `openssl req -x509` creates such
/// certificates, and OpenSSL and curl accept them. It does not weaken security: the owner of a trusted authority's key
/// can create a certificate for every name anyway.
#[derive(Debug)]
struct Verifier {
    webpki: Arc<WebPkiServerVerifier>,
    trusted: Vec<CertificateDer<'static>>,
}

impl Verifier {
    /// Returns `None` if the trust store is empty.
    fn new(roots: RootCertStore, trusted: Vec<CertificateDer<'static>>, crypto: Arc<CryptoProvider>) -> Option<Self> {
        let webpki = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), crypto).build().ok()?;
        Some(Self { webpki, trusted })
    }
}

impl ServerCertVerifier for Verifier {
    fn verify_server_cert(
        &self,
        certificate: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let verified = self.webpki.verify_server_cert(certificate, intermediates, name, ocsp_response, now);
        match verified {
            // webpki checks the dates before it returns this error, and would check the name after it.
            Err(Error::InvalidCertificate(error)) if is_of_authority(&error) && self.trusted.contains(certificate) => {
                verify_server_name(&ParsedCertificate::try_from(certificate)?, name)?;
                Ok(ServerCertVerified::assertion())
            }
            verified => verified,
        }
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.webpki.verify_tls12_signature(message, certificate, signature)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.webpki.verify_tls13_signature(message, certificate, signature)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.webpki.supported_verify_schemes()
    }
}

/// Whether a certificate was refused because it may sign others (`CA:TRUE`).
fn is_of_authority(error: &CertificateError) -> bool {
    let CertificateError::Other(OtherError(source)) = error else {
        return false;
    };
    source.downcast_ref() == Some(&webpki::Error::CaUsedAsEndEntity)
}

/// Returns why a request failed, if TLS is the cause.
pub fn reason(error: &SendRequestError) -> Option<String> {
    let SendRequestError::Connect(ConnectError::Io(error)) = error else {
        return None;
    };
    let error = error.get_ref()?.downcast_ref::<Error>()?;
    Some(match error {
        Error::InvalidCertificate(problem) => format!("its certificate is not trusted: {}", distrust(problem)),
        Error::InvalidMessage(_) => "it does not speak https there".to_owned(),
        Error::AlertReceived(alert) => format!("it refuses to encrypt: {alert:?}"),
        other => format!("encryption failed: {other}"),
    })
}

fn distrust(problem: &CertificateError) -> String {
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
        other if is_of_authority(other) => {
            "it is that of an authority (CA:TRUE) and not itself known here (update-ca-certificates and SSL_CERT_FILE make \
             it known)"
                .to_owned()
        }
        other => other.to_string(),
    }
}

/// Returns the bare name from rustls' notation `DnsName("lab.org")`.
fn bare(name: &str) -> &str {
    let inner = name.split_once('(').and_then(|(_, rest)| rest.strip_suffix(')'));
    inner.map_or(name, |inner| inner.trim_matches('"'))
}

fn date(seconds: u64) -> String {
    let time = SystemTime::UNIX_EPOCH.checked_add(Duration::from_secs(seconds)).map(timestamp).unwrap_or_default();
    if time.is_empty() { "a day that is none".to_owned() } else { time }
}
