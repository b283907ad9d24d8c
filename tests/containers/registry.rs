//! A registry with one image, which has one empty layer.

use std::net::TcpListener;

use sha2::{Digest, Sha256};

use crate::support::listener::serve;

/// The registry, as long as the test runs.
pub struct Registry {
    pub port: u16,
}

impl Registry {
    /// Serves the image under every name.
    pub fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        // An archive without files ends with two blocks of zeros.
        let layer = vec![0; 1024];
        let config = serde_json::json!({
            "architecture": "amd64", "os": "linux", "config": {},
            "rootfs": {"type": "layers", "diff_ids": [digest(&layer)]},
        });
        let config = config.to_string().into_bytes();
        let kind = |name: &str| format!("application/vnd.docker.{name}");
        let manifest = serde_json::json!({
            "schemaVersion": 2, "mediaType": kind("distribution.manifest.v2+json"),
            "config": {
                "mediaType": kind("container.image.v1+json"), "size": config.len(), "digest": digest(&config),
            },
            "layers": [{
                "mediaType": kind("image.rootfs.diff.tar"), "size": layer.len(), "digest": digest(&layer),
            }],
        });
        let manifest = manifest.to_string().into_bytes();
        let blobs = [layer, config, manifest.clone()];
        serve(listener, None, move |request| {
            let path = request.head.split(' ').nth(1).unwrap();
            if path.contains("/manifests/") {
                let head = "200 OK\r\nContent-Type: application/vnd.docker.distribution.manifest.v2+json";
                return Some((
                    format!("{head}\r\nDocker-Content-Digest: {}", digest(&manifest)),
                    manifest.clone(),
                ));
            }
            let found = blobs.iter().find(|blob| path.ends_with(&digest(blob)));
            Some(("200 OK".to_owned(), found.cloned().unwrap_or_default()))
        });
        Self { port }
    }
}

fn digest(bytes: &[u8]) -> String {
    let digest = Sha256::digest(bytes);
    digest
        .iter()
        .fold("sha256:".to_owned(), |text, byte| format!("{text}{byte:02x}"))
}
