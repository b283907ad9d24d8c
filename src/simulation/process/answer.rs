//! Checks whether a starting Webots is ready at its port.
//!
//! In the machine's network, Webots is ready when it accepts a connection. Docker's proxy and pasta accept connections
//! from the start, even if nothing inside listens: behind them, only an answer to a request shows that Webots is ready.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

/// A request for a file that Webots does not have. A request for `/` would open a WebSocket.
const REQUEST: &[u8] = b"GET /robots.txt HTTP/1.0\r\nHost: localhost\r\n\r\n";
/// Bounds of the pause between two requests.
const PAUSE: (Duration, Duration) = (Duration::from_millis(5), Duration::from_millis(500));
/// The pause is 1/`PART` of the time since the start, so that many starts on a busy machine don't poll all the time.
const PART: u32 = 20;
/// Bounds of the timeout of a request, which is the time since the start: the proxy may accept the first request before
/// anything inside listens, and Webots answers none while it reads a world.
const TIMEOUT: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(2));

/// Waits until Webots is ready at this address. Its container must run already: a request before the container has its
/// address delays all others by a second, until the kernel resolves the address again.
pub async fn until_answering(address: SocketAddr, is_forwarded: bool) {
    let begin = Instant::now();
    loop {
        let timeout = begin.elapsed().clamp(TIMEOUT.0, TIMEOUT.1);
        match actix_rt::time::timeout(timeout, answers(address, is_forwarded)).await {
            Ok(Ok(true)) => return,
            Ok(_) => actix_rt::time::sleep((begin.elapsed() / PART).clamp(PAUSE.0, PAUSE.1)).await,
            Err(_) => {}
        }
    }
}

async fn answers(address: SocketAddr, is_forwarded: bool) -> std::io::Result<bool> {
    let mut stream = TcpStream::connect(address).await?;
    if !is_forwarded {
        return Ok(true);
    }
    stream.write_all(REQUEST).await?;
    let mut answer = [0; 5];
    stream.read_exact(&mut answer).await?;
    Ok(answer == *b"HTTP/")
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    #[actix_rt::test]
    async fn a_proxy_that_accepts_for_nobody_is_no_answer() {
        let listener = tokio::net::TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let address = listener.local_addr().unwrap();
        let waiting = actix_rt::spawn(until_answering(address, true));
        drop(listener.accept().await.unwrap());
        let (mut stream, _) = listener.accept().await.unwrap();
        assert!(!waiting.is_finished());
        stream.write_all(b"HTTP/1.1 404 Not Found\r\n\r\n").await.unwrap();
        waiting.await.unwrap();
    }
}
