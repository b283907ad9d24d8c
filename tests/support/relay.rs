//! A link to a server that can be cut, slowed down or silenced.

use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

/// What the link does with data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mood {
    /// Forwards everything.
    Open,
    /// Forwards everything after this delay.
    Slow(Duration),
    /// Accepts connections but forwards nothing, as if packets got lost.
    Silent,
    /// Breaks every connection.
    Cut,
}

pub struct Relay {
    pub port: u16,
    mood: Arc<watch::Sender<Mood>>,
}

impl Relay {
    /// Forwards a port of its own to this port.
    pub async fn to(port: u16) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
        let own = listener.local_addr().unwrap().port();
        let mood = Arc::new(watch::Sender::new(Mood::Open));
        let shared = Arc::clone(&mood);
        actix_rt::spawn(async move {
            while let Ok((near, _)) = listener.accept().await {
                let mood = shared.subscribe();
                actix_rt::spawn(async move {
                    let Ok(far) = TcpStream::connect(("127.0.0.1", port)).await else {
                        return;
                    };
                    let (near_reader, near_writer) = near.into_split();
                    let (far_reader, far_writer) = far.into_split();
                    let mut end = mood.clone();
                    tokio::select! {
                        () = forward(near_reader, far_writer, mood.clone()) => {}
                        () = forward(far_reader, near_writer, mood) => {}
                        _ = end.wait_for(|mood| *mood == Mood::Cut) => {}
                    }
                });
            }
        });
        Self { port: own, mood }
    }

    pub fn set(&self, mood: Mood) {
        self.mood.send_replace(mood);
    }
}

async fn forward(
    mut from: tokio::net::tcp::OwnedReadHalf,
    mut to: tokio::net::tcp::OwnedWriteHalf,
    mut mood: watch::Receiver<Mood>,
) {
    let mut chunk = vec![0; 64 << 10];
    while let Ok(length @ 1..) = from.read(&mut chunk).await {
        if mood.wait_for(|mood| *mood != Mood::Silent).await.is_err() {
            return;
        }
        let now = *mood.borrow();
        if let Mood::Slow(delay) = now {
            actix_rt::time::sleep(delay).await;
        }
        if to.write_all(&chunk[..length]).await.is_err() {
            return;
        }
    }
}
