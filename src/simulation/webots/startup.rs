//! The start of a Webots, as its port shows it.
//!
//! Webots listens before there is a world. First it downloads the world's assets: it answers, but a viewer that requests
//! the scene crashes it. Then it reads the world: the kernel accepts connections, and nothing answers. To the handshake
//! of a controller it answers `PROCESSING` until the world is ready, and writes nothing to its console. Releases before
//! R2023b don't: a controller crashes them too, and the first heartbeat is the best sign that they are ready.
//!
//! Docker's proxy and pasta accept connections from the start, even if nothing inside listens: behind pasta, the network
//! of the sandbox shows that Webots listens, behind Docker's proxy only an answer does.

use std::cell::Cell;
use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use actix::prelude::*;
use futures_util::StreamExt;
use tokio::net::TcpStream;
use tokio::sync::Notify;
use tokio_tungstenite::connect_async_with_config;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;

use crate::simulation::process::process_tree;
use crate::simulation::progress::{Progress, Step};
use crate::simulation::relay::has_world;

/// An event of the start of a Webots.
#[derive(Message, Debug, Clone, PartialEq, Eq)]
#[rtype(result = "()")]
pub enum StartupEvent {
    /// It listens.
    Listening,
    /// The progress of its download or load.
    Loading(Progress),
    /// The world is ready: viewers may connect.
    Ready,
}

/// The pauses of a poll: a part of the time since the start, so that many starts on a busy machine don't poll all the
/// time, within bounds.
struct Pace {
    part: u32,
    shortest: Duration,
    longest: Duration,
}

/// Looks for its port. A Webots that listens and ends between two of them counts as one that has never listened.
const LOOKS: Pace = Pace {
    part: 50,
    shortest: Duration::from_millis(5),
    longest: Duration::from_millis(50),
};
/// Requests, which Webots answers while it has no world.
const REQUESTS: Pace = Pace {
    part: 20,
    shortest: Duration::from_millis(5),
    longest: Duration::from_millis(500),
};
/// Bounds of the timeout of a request behind a proxy, until one was answered. It is the time since the start: the proxy
/// may accept the first request before anything inside listens, and Webots answers none while it reads a world.
const TIMEOUT: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(10));
/// Size limit of a message with progress, in bytes. In containers the project decides what sends it.
const MAX_MESSAGE: usize = 4096;
/// Pause after a message. Webots sends some per second; a program that floods this server is blocked.
const AFTER_MESSAGE: Duration = Duration::from_millis(20);

/// What shows that Webots listens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ListenSign {
    /// Its port accepts a connection.
    Accepts,
    /// It is in the network of the children of this process, behind pasta.
    InNetworkOf(i32),
    /// It answers a request, behind Docker's proxy.
    Answers,
}

/// Follows the start of the Webots at this address, and sends its events. If it answers controllers, the last one is
/// [`StartupEvent::Ready`]; otherwise nothing is sent to it, and the only event is [`StartupEvent::Listening`].
///
/// A container must run already: a request before it has its address delays all others by a second, until the kernel
/// resolves the address again.
pub async fn follow_startup(
    address: SocketAddr,
    sign: ListenSign,
    answers_controllers: bool,
    events: Recipient<StartupEvent>,
) {
    let startup = Startup {
        address,
        sign,
        events,
        begin: Instant::now(),
        listens: Cell::new(false),
        processing: Notify::new(),
        loaded: Notify::new(),
    };
    let is_shown_by_request = answers_controllers && !matches!(sign, ListenSign::InNetworkOf(_));
    tokio::select! {
        () = startup.until_ready(), if answers_controllers => startup.events.do_send(StartupEvent::Ready),
        never = startup.forward_progress() => match never {},
        never = startup.watch_for_listening(), if !is_shown_by_request => match never {},
    }
}

struct Startup {
    address: SocketAddr,
    sign: ListenSign,
    events: Recipient<StartupEvent>,
    begin: Instant,
    /// Whether Webots is known to listen.
    listens: Cell<bool>,
    /// Webots answers, but there is no world.
    processing: Notify,
    /// Webots has sent a world.
    loaded: Notify,
}

impl Startup {
    /// Sends requests until the world is ready.
    async fn until_ready(&self) {
        loop {
            let answer = if self.sign != ListenSign::Accepts && !self.listens.get() {
                let timeout = self.begin.elapsed().clamp(TIMEOUT.0, TIMEOUT.1);
                let answer = actix_rt::time::timeout(timeout, self.request()).await;
                answer.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
            } else {
                // While a world is read, a request waits in Webots' queue, and is answered then.
                self.request().await
            };
            match answer {
                Ok(true) => return,
                Ok(false) => self.processing.notify_one(),
                Err(_) => {}
            }
            let is_look = self.sign == ListenSign::Accepts && !self.listens.get();
            let pause = self.pause(if is_look { &LOOKS } else { &REQUESTS });
            actix_rt::time::timeout(pause, self.loaded.notified()).await.ok();
        }
    }

    /// Watches for the sign that Webots listens, where requests don't show it in time: a world that is being read answers
    /// none.
    async fn watch_for_listening(&self) -> Infallible {
        // When the sockets of a network are listed again: if their number has changed, or at times.
        let (mut counted, mut listed) = (0, self.begin);
        while !self.listens.get() {
            let listens = match self.sign {
                ListenSign::Accepts => TcpStream::connect(self.address).await.is_ok(),
                ListenSign::InNetworkOf(pid) => {
                    let sockets = process_tree::sockets_of_children(pid);
                    let is_due = sockets != counted || listed.elapsed() > self.pause(&REQUESTS);
                    if is_due {
                        (counted, listed) = (sockets, Instant::now());
                    }
                    is_due && process_tree::children_listen(pid, self.address.port())
                }
                ListenSign::Answers => break,
            };
            if listens {
                self.listens();
            } else {
                actix_rt::time::sleep(self.pause(&LOOKS)).await;
            }
        }
        std::future::pending().await
    }

    fn pause(&self, pace: &Pace) -> Duration {
        (self.begin.elapsed() / pace.part).clamp(pace.shortest, pace.longest)
    }

    /// Asks Webots whether it has a world.
    async fn request(&self) -> io::Result<bool> {
        let mut stream = TcpStream::connect(self.address).await?;
        if self.sign == ListenSign::Accepts {
            self.listens();
        }
        let has_world = has_world(&mut stream).await?;
        self.listens();
        Ok(has_world)
    }

    fn listens(&self) {
        if !self.listens.replace(true) {
            self.events.do_send(StartupEvent::Listening);
        }
    }

    /// Sends what Webots reports about its progress. It reports to each WebSocket, also to one that requests nothing.
    async fn forward_progress(&self) -> Infallible {
        let url = format!("ws://{}/", self.address);
        let limits = WebSocketConfig::default()
            .max_message_size(Some(MAX_MESSAGE))
            .max_frame_size(Some(MAX_MESSAGE));
        loop {
            self.processing.notified().await;
            let Ok((mut socket, _)) = connect_async_with_config(&url, Some(limits), false).await else {
                continue;
            };
            while let Some(Ok(frame)) = socket.next().await {
                let text = frame.to_text().unwrap_or_default();
                if let Some(progress) = text.strip_prefix("loading:") {
                    // A full mailbox drops this line.
                    self.events.try_send(StartupEvent::Loading(parsed(progress))).ok();
                } else if text.starts_with("world:") {
                    self.loaded.notify_one();
                    break;
                }
                actix_rt::time::sleep(AFTER_MESSAGE).await;
            }
        }
    }
}

/// The progress `STATUS:PERCENT`. Whatever the status is, clients can't take its text for an error.
fn parsed(progress: &str) -> Progress {
    let of_webots = |text: &str| Progress::new(Step::Load, format!("Webots: {text}"));
    match progress.rsplit_once(':') {
        Some((status, percent)) => Progress {
            percent: percent.trim().parse().ok().filter(|percent| *percent <= 100),
            ..of_webots(&format!("{}: {percent} %", status.trim()))
        },
        None => of_webots(progress),
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use futures_util::SinkExt;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpListener;
    use tokio::sync::mpsc;
    use tokio_tungstenite::WebSocketStream;
    use tokio_tungstenite::tungstenite::Message as Frame;

    use super::*;
    use crate::simulation::relay::REQUEST;

    struct Listener(mpsc::UnboundedSender<StartupEvent>);

    impl Actor for Listener {
        type Context = Context<Self>;
    }

    impl Handler<StartupEvent> for Listener {
        type Result = ();

        fn handle(&mut self, event: StartupEvent, _: &mut Self::Context) {
            self.0.send(event).unwrap();
        }
    }

    /// A stand-in for Webots, and the events of its start.
    async fn start(sign: ListenSign) -> (TcpListener, mpsc::UnboundedReceiver<StartupEvent>) {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let (sender, events) = mpsc::unbounded_channel();
        let events_of_start = Listener(sender).start().recipient();
        let address = listener.local_addr().unwrap();
        actix_rt::spawn(follow_startup(address, sign, true, events_of_start));
        (listener, events)
    }

    /// The next connection, and its request.
    async fn request(listener: &TcpListener) -> TcpStream {
        let (mut stream, _) = listener.accept().await.unwrap();
        let mut request = [0; REQUEST.len()];
        stream.read_exact(&mut request).await.unwrap();
        assert_eq!(request, REQUEST);
        stream
    }

    /// The next WebSocket for progress. Requests before it and beside it are answered.
    async fn progress_socket(listener: &TcpListener) -> WebSocketStream<TcpStream> {
        let opened = async {
            loop {
                let (mut stream, _) = listener.accept().await.unwrap();
                let mut first = [0; 3];
                stream.peek(&mut first).await.unwrap();
                if first == *b"GET" {
                    break tokio_tungstenite::accept_async(stream).await.unwrap();
                }
                stream.write_all(b"PROCESSING").await.unwrap();
            }
        };
        let opened = actix_rt::time::timeout(Duration::from_secs(20), opened).await;
        opened.expect("progress is asked for")
    }

    #[actix_rt::test]
    async fn an_accepted_connection_shows_that_it_listens_and_an_answer_that_it_is_ready() {
        let (listener, mut events) = start(ListenSign::Accepts).await;
        let mut stream = request(&listener).await;
        assert_eq!(events.recv().await, Some(StartupEvent::Listening));
        // However long the world is read, there is one request.
        let second = actix_rt::time::timeout(Duration::from_millis(300), listener.accept()).await;
        assert!(second.is_err() && events.is_empty());
        stream.write_all(b"FAILED").await.unwrap();
        assert_eq!(events.recv().await, Some(StartupEvent::Ready));
        assert_eq!(events.recv().await, None);
    }

    #[actix_rt::test]
    async fn a_proxy_that_accepts_for_nobody_shows_nothing() {
        let (listener, mut events) = start(ListenSign::Answers).await;
        // It closes the first connection, and does not answer on the second.
        drop(listener.accept().await.unwrap());
        let _silent = listener.accept().await.unwrap();
        let mut stream = request(&listener).await;
        assert!(events.is_empty());
        stream.write_all(b"FAILED").await.unwrap();
        assert_eq!(events.recv().await, Some(StartupEvent::Listening));
        assert_eq!(events.recv().await, Some(StartupEvent::Ready));
    }

    #[actix_rt::test]
    async fn progress_is_forwarded_and_the_world_ends_the_wait() {
        let (listener, mut events) = start(ListenSign::Accepts).await;
        let mut socket = progress_socket(&listener).await;
        assert_eq!(events.recv().await, Some(StartupEvent::Listening));
        socket.send(Frame::text("loading:Downloading assets:40")).await.unwrap();
        let progress = Progress {
            percent: Some(40),
            ..Progress::new(Step::Load, "Webots: Downloading assets: 40 %")
        };
        assert_eq!(events.recv().await, Some(StartupEvent::Loading(progress)));
        socket
            .send(Frame::text("world:worlds/a.wbt:worlds/a.wbt"))
            .await
            .unwrap();
        request(&listener).await.write_all(b"FAILED").await.unwrap();
        assert_eq!(events.recv().await, Some(StartupEvent::Ready));
    }

    #[actix_rt::test]
    async fn progress_is_short_and_comes_at_its_pace_whatever_is_sent() {
        let (listener, mut events) = start(ListenSign::Accepts).await;
        let mut socket = progress_socket(&listener).await;
        assert_eq!(events.recv().await, Some(StartupEvent::Listening));
        let long = format!("loading:{}", "x".repeat(1 << 20));
        // The connection may break before all is sent.
        socket.send(Frame::text(long)).await.ok();
        let mut socket = progress_socket(&listener).await;
        let begin = Instant::now();
        for percent in 0..20 {
            socket.send(Frame::text(format!("loading:x:{percent}"))).await.unwrap();
        }
        for percent in 0..20 {
            let event = events.recv().await;
            assert!(
                matches!(&event, Some(StartupEvent::Loading(progress)) if progress.percent == Some(percent)),
                "{event:?}"
            );
        }
        assert!(begin.elapsed() > Duration::from_millis(300), "{:?}", begin.elapsed());
    }
}
