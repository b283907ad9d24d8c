//! Many cheap stand-ins for simulation servers, in one thread: each answers every request with the same bytes.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;

/// The running stand-ins.
pub(crate) struct StandIns {
    /// `HOST:PORT` of each.
    pub(crate) addresses: Vec<String>,
    hung: Arc<AtomicBool>,
    end: Arc<Notify>,
}

impl StandIns {
    /// Starts `count` stand-ins; the first one can be made to hang.
    pub(crate) fn start(count: usize) -> Self {
        Self::with_repositories(count, 1)
    }

    /// Starts stand-ins that each accept the repositories of this many owners.
    pub(crate) fn with_repositories(count: usize, repositories: usize) -> Self {
        let allowed: Vec<String> = (0..repositories)
            .map(|owner| format!("https://github.com/lab{owner}"))
            .collect();
        let body = serde_json::json!({
            "load": 5.0, "version": "1", "allowedRepositories": allowed, "docker": false,
            "instances": {"queued": 0, "starting": 1, "idle": 2, "running": 3, "places": 100_000, "arrivals": 6},
        })
        .to_string();
        let answer: Arc<str> = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n{body}", body.len()).into();
        let sockets: Vec<_> = (0..count)
            .map(|_| std::net::TcpListener::bind("127.0.0.1:0").expect("a free port"))
            .collect();
        let addresses = sockets
            .iter()
            .map(|socket| socket.local_addr().expect("it is bound").to_string())
            .collect();
        let hung = Arc::new(AtomicBool::new(false));
        let end = Arc::new(Notify::new());
        let seen = Arc::clone(&hung);
        let ended = Arc::clone(&end);
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_io()
                .build()
                .expect("a runtime");
            runtime.block_on(async {
                for (index, socket) in sockets.into_iter().enumerate() {
                    socket.set_nonblocking(true).expect("a socket");
                    let listener = TcpListener::from_std(socket).expect("a socket");
                    tokio::spawn(serve(
                        listener,
                        Arc::clone(&answer),
                        (index == 0).then(|| Arc::clone(&seen)),
                    ));
                }
                ended.notified().await;
            });
        });
        Self { addresses, hung, end }
    }

    /// Makes the first one accept connections and answer nothing.
    pub(crate) fn hang_first(&self) {
        self.hung.store(true, Ordering::SeqCst);
    }
}

impl Drop for StandIns {
    /// Stops all of them at once.
    fn drop(&mut self) {
        self.end.notify_one();
    }
}

async fn serve(listener: TcpListener, answer: Arc<str>, hung: Option<Arc<AtomicBool>>) {
    while let Ok((stream, _)) = listener.accept().await {
        tokio::spawn(converse(stream, Arc::clone(&answer), hung.clone()));
    }
}

async fn converse(mut stream: TcpStream, answer: Arc<str>, hung: Option<Arc<AtomicBool>>) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    let mut request = [0; 2048];
    // A request is small enough to arrive in one piece.
    while stream.read(&mut request).await? > 0 {
        if hung.as_ref().is_some_and(|hung| hung.load(Ordering::SeqCst)) {
            std::future::pending::<()>().await;
        }
        stream.write_all(answer.as_bytes()).await?;
    }
    Ok(())
}
