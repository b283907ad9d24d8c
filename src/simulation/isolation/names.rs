//! Resolves names for programs in networks of their own, which reach nothing by UDP: a relay of DNS over TCP.
//!
//! pasta forwards the port 53 of each network's loopback to the relay, which asks the machine's own name servers. It has
//! a thread of its own. The packet filter of a network limits how many connections its programs have to it.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use actix_rt::time::{sleep, timeout};
use futures_util::{SinkExt, StreamExt};
use hickory_resolver::system_conf::read_system_conf;
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::runtime::Builder;
use tokio::sync::Semaphore;
use tokio_util::codec::{Framed, LengthDelimitedCodec};

use crate::shared::run::permanent;

/// Limit of connections at a time. More of them wait.
const CONNECTIONS: usize = 1024;
/// Timeout of a program that asks nothing, or does not read its answer.
const IDLE: Duration = Duration::from_secs(5);
/// Timeout of a name server. Programs wait five seconds (glibc), in which two name servers can be asked.
const ANSWER: Duration = Duration::from_secs(2);
/// Pause after a connection that can't be accepted, because the server has no file descriptor left.
const PAUSE: Duration = Duration::from_millis(100);
/// The port of name servers.
const PORT: u16 = 53;
/// Largest message of DNS, in bytes.
const LARGEST: usize = 65_535;
/// In the third byte of an answer: it is truncated, and must be requested over TCP.
const TRUNCATED: u8 = 2;

/// Starts the relay at this address, at a free port, which is returned.
///
/// # Errors
/// When the address, a thread or a runtime can't be had.
pub fn start(address: IpAddr) -> io::Result<u16> {
    let listener = std::net::TcpListener::bind((address, 0))?;
    listener.set_nonblocking(true)?;
    let port = listener.local_addr()?.port();
    let runtime = Builder::new_current_thread().enable_all().build()?;
    permanent::thread("names", move || {
        if let Err(error) = runtime.block_on(serve(listener)) {
            log::error!("programs in networks of their own can resolve no names: {error}");
        }
    })?;
    Ok(port)
}

async fn serve(listener: std::net::TcpListener) -> io::Result<()> {
    let listener = TcpListener::from_std(listener)?;
    let permits = Arc::new(Semaphore::new(CONNECTIONS));
    loop {
        let permit = Arc::clone(&permits).acquire_owned().await.map_err(io::Error::other)?;
        match listener.accept().await {
            Ok((stream, _)) => {
                tokio::spawn(async move {
                    // The program has closed its connection, or gets no answer: it sees the end of the connection.
                    converse(stream).await.ok();
                    drop(permit);
                });
            }
            Err(_) => sleep(PAUSE).await,
        }
    }
}

/// Answers the questions of one connection until it ends.
async fn converse(stream: TcpStream) -> io::Result<()> {
    let mut messages = framed(stream);
    while let Some(question) = timeout(IDLE, messages.next()).await? {
        let answer = answer(&question?).await?;
        timeout(IDLE, messages.send(answer.as_slice())).await??;
    }
    Ok(())
}

/// DNS over TCP: each message follows its length in two bytes.
fn framed(stream: TcpStream) -> Framed<TcpStream, LengthDelimitedCodec> {
    LengthDelimitedCodec::builder()
        .length_field_type::<u16>()
        .max_frame_length(LARGEST)
        .new_framed(stream)
}

/// The answer of the first name server of the machine that answers. The configuration is read for each question,
/// because it changes with the network.
async fn answer(question: &[u8]) -> io::Result<Vec<u8>> {
    let (config, _) = read_system_conf().map_err(io::Error::other)?;
    for server in config.name_servers() {
        let server = SocketAddr::new(server.ip, PORT);
        if let Ok(Ok(answer)) = timeout(ANSWER, ask(server, question)).await {
            return Ok(answer);
        }
    }
    Err(io::ErrorKind::TimedOut.into())
}

async fn ask(server: SocketAddr, question: &[u8]) -> io::Result<Vec<u8>> {
    let answer = ask_by_udp(server, question).await?;
    if answer.get(2).is_some_and(|flags| flags & TRUNCATED != 0) {
        ask_by_tcp(server, question).await
    } else {
        Ok(answer)
    }
}

async fn ask_by_udp(server: SocketAddr, question: &[u8]) -> io::Result<Vec<u8>> {
    let any: IpAddr = if server.is_ipv4() {
        Ipv4Addr::UNSPECIFIED.into()
    } else {
        Ipv6Addr::UNSPECIFIED.into()
    };
    let socket = UdpSocket::bind((any, 0)).await?;
    socket.connect(server).await?;
    socket.send(question).await?;
    let mut answer = vec![0; LARGEST];
    loop {
        let length = socket.recv(&mut answer).await?;
        // An answer begins with the number of its question.
        if length >= 2 && answer.get(..2) == question.get(..2) {
            answer.truncate(length);
            return Ok(answer);
        }
    }
}

async fn ask_by_tcp(server: SocketAddr, question: &[u8]) -> io::Result<Vec<u8>> {
    let mut messages = framed(TcpStream::connect(server).await?);
    messages.send(question).await?;
    let answer = messages.next().await.ok_or(io::ErrorKind::UnexpectedEof)??;
    Ok(answer.to_vec())
}
