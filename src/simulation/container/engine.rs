//! A request to the API of Docker's daemon, whose status tells what exit codes of `docker` don't.

use std::path::PathBuf;
use std::time::Duration;

use percent_encoding::{NON_ALPHANUMERIC, utf8_percent_encode};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;

/// The socket of the daemon unless `DOCKER_HOST` names another one.
const SOCKET: &str = "/var/run/docker.sock";
/// Timeout of the answer, for which the daemon asks a registry.
const TIMEOUT: Duration = Duration::from_secs(30);
/// The statuses with which the daemon answers that the registry has no such image, and that the name is not one of an
/// image.
const NO_IMAGE: [u16; 2] = [404, 400];

/// Whether the registry of an image answers that it has no such image; false if it does not answer.
pub async fn is_unknown(image: &str) -> bool {
    let status = actix_rt::time::timeout(TIMEOUT, status_of_pull(image)).await;
    matches!(status, Ok(Ok(Some(status))) if NO_IMAGE.contains(&status))
}

/// Asks for a pull, and returns the status. The daemon ends the pull when the connection closes.
async fn status_of_pull(image: &str) -> std::io::Result<Option<u16>> {
    let host = std::env::var("DOCKER_HOST").ok().filter(|host| !host.is_empty());
    let socket = match &host {
        None => PathBuf::from(SOCKET),
        Some(host) => match host.strip_prefix("unix://") {
            Some(path) => PathBuf::from(path),
            None => return Ok(None),
        },
    };
    let stream = UnixStream::connect(socket).await?;
    let mut stream = BufReader::new(stream);
    stream.write_all(request(image).as_bytes()).await?;
    let mut line = String::new();
    stream.read_line(&mut line).await?;
    Ok(line.split(' ').nth(1).and_then(|status| status.parse().ok()))
}

/// The name of an image with the tag that it means, if it has neither a tag nor a digest.
pub fn with_tag(image: &str) -> String {
    let name = image.rsplit('/').next().unwrap_or_default();
    let tag = if name.contains([':', '@']) { "" } else { ":latest" };
    format!("{image}{tag}")
}

fn request(image: &str) -> String {
    // Without a tag the daemon would fetch all.
    let image = with_tag(image);
    let image = utf8_percent_encode(&image, NON_ALPHANUMERIC);
    format!("POST /images/create?fromImage={image} HTTP/1.0\r\nHost: docker\r\nContent-Length: 0\r\n\r\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_tag_of_an_image_is_asked_for() {
        assert!(request("a:5000/b").starts_with("POST /images/create?fromImage=a%3A5000%2Fb%3Alatest HTTP/1.0\r\n"));
        assert!(request("a/b:c").starts_with("POST /images/create?fromImage=a%2Fb%3Ac HTTP/1.0\r\n"));
    }
}
