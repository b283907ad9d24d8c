//! Whether a Webots has a world, by the handshake of a controller.

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use actix_rt::net::TcpStream;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

/// The handshake of a controller for a robot that no world has. Its answer is `PROCESSING`, or another text once there
/// is a world.
pub const REQUEST: &[u8] = b"CTR\nRobot-Name: %2F\n\n";
/// The beginning of `PROCESSING`. No other answer is shorter.
const PROCESSING: [u8; 6] = *b"PROCES";
/// Pause between two requests to a Webots without a world.
const PAUSE: Duration = Duration::from_millis(50);

/// Asks the Webots at the other end of this connection whether it has a world. While it reads one, it does not answer.
///
/// # Errors
/// When it closes the connection instead.
pub async fn has_world(webots: &mut TcpStream) -> io::Result<bool> {
    webots.write_all(REQUEST).await?;
    let mut answer = PROCESSING;
    webots.read_exact(&mut answer).await?;
    Ok(answer != PROCESSING)
}

/// Waits until the Webots at this address has a world: a viewer would crash it before.
pub(super) async fn until_world(address: SocketAddr) -> io::Result<()> {
    while !has_world(&mut TcpStream::connect(address).await?).await? {
        actix_rt::time::sleep(PAUSE).await;
    }
    Ok(())
}
