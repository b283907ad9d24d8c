//! The simulator's port. The first bytes of a connection decide, as in Webots: `GET /` opens a WebSocket, `GET` with
//! another path is for a file, and `CTR` comes from a controller.

use std::path::Path;
use std::rc::Rc;

use actix::Addr;
use tokio::io::AsyncWriteExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio_tungstenite::accept_async_with_config;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;

use crate::client;
use crate::files;
use crate::simulation::{ConnectController, Simulation, Warn};

/// Longest head of a request, in bytes.
const MAX_HEAD: usize = 8 * 1024;
/// Size of the read buffer of a WebSocket, in bytes: clients send short texts.
const READ_BUFFER: usize = 4 * 1024;
const BAD_REQUEST: &[u8] = b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n";

/// Accepts connections, for ever. All are served on this thread, which is also that of the simulation: while it is
/// busy, connections are accepted by the kernel only.
pub(crate) async fn serve(listener: TcpListener, simulation: Addr<Simulation>, project: Rc<Path>) {
    loop {
        // An error is about the connection, or there are too many: later ones may be accepted.
        let Ok((stream, _)) = listener.accept().await else {
            tokio::task::yield_now().await;
            continue;
        };
        let simulation = simulation.clone();
        let project = Rc::clone(&project);
        actix_web::rt::spawn(async move {
            // The peer is gone.
            connect(stream, simulation, &project).await.ok();
        });
    }
}

async fn connect(mut stream: TcpStream, simulation: Addr<Simulation>, project: &Path) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    let mut head = vec![0; MAX_HEAD];
    let length = stream.peek(&mut head).await?;
    let head = String::from_utf8_lossy(head.get(..length).unwrap_or_default()).into_owned();
    let answer = match head.split_ascii_whitespace().collect::<Vec<_>>().as_slice() {
        ["GET", "/", ..] if head.to_ascii_lowercase().contains("upgrade: websocket") => {
            let config = WebSocketConfig::default().read_buffer_size(READ_BUFFER);
            if let Ok(socket) = accept_async_with_config(stream, Some(config)).await {
                client::serve(socket, simulation.recipient()).await;
            }
            return Ok(());
        }
        ["GET", path, ..] if *path != "/" => {
            let answer = files::answer(project, &head);
            if let Some(warning) = answer.warning {
                simulation.do_send(Warn(warning));
            }
            answer.bytes
        }
        ["CTR", ..] => simulation.send(ConnectController).await.unwrap_or_default().into(),
        _ => BAD_REQUEST.into(),
    };
    // The socket must not have unread data when it is closed: the peer would lose the answer.
    let mut read = vec![0; length];
    tokio::io::AsyncReadExt::read_exact(&mut stream, &mut read).await?;
    stream.write_all(&answer).await?;
    stream.shutdown().await
}
