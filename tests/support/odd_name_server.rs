//! A DNS server that answers as no real one would be told to: with errors, with nothing at all, or with half of what it knows.

use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

/// The answer to one question.
#[derive(Debug, Clone, Copy)]
pub enum Reply {
    /// None.
    Silence,
    /// No records, with this response code: 0 no error, 2 failure, 3 no such name, 5 refused.
    Code(u8),
    /// One A or AAAA record.
    Address(IpAddr),
}

/// Which records a question is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    A,
    Aaaa,
    Other,
}

/// The server. It ends with this value.
pub struct OddNameServer {
    address: SocketAddr,
    asked: Arc<AtomicUsize>,
    end: Arc<AtomicBool>,
}

impl OddNameServer {
    /// Starts one that answers like this.
    pub fn start(reply: impl Fn(Kind) -> Reply + Send + 'static) -> Self {
        Self::start_on(UdpSocket::bind("127.0.0.1:0").unwrap(), reply)
    }

    /// Starts one at a socket that there is.
    pub fn start_on(socket: UdpSocket, reply: impl Fn(Kind) -> Reply + Send + 'static) -> Self {
        socket.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        let address = socket.local_addr().unwrap();
        let (asked, end) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(false)));
        let server = Self { address, asked: asked.clone(), end: end.clone() };
        std::thread::spawn(move || {
            let mut buffer = [0; 4096];
            while !end.load(Ordering::Relaxed) {
                let Ok((length, client)) = socket.recv_from(&mut buffer) else { continue };
                asked.fetch_add(1, Ordering::Relaxed);
                if let Some(answer) = answer(&buffer[..length], &reply) {
                    socket.send_to(&answer, client).unwrap();
                }
            }
        });
        server
    }

    /// `HOST:PORT`.
    pub fn address(&self) -> String {
        self.address.to_string()
    }

    /// How many questions have come.
    pub fn asked(&self) -> usize {
        self.asked.load(Ordering::Relaxed)
    }
}

impl Drop for OddNameServer {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
    }
}

/// The message that answers this one (RFC 1035, 4.1), none where there shall be silence.
fn answer(query: &[u8], reply: impl Fn(Kind) -> Reply) -> Option<Vec<u8>> {
    const HEADER: usize = 12;
    let name = query[HEADER..].iter().position(|length| *length == 0).unwrap();
    let question = &query[HEADER..HEADER + name + 5];
    let kind = match question[name + 2] {
        1 => Kind::A,
        28 => Kind::Aaaa,
        _ => Kind::Other,
    };
    let (code, address) = match reply(kind) {
        Reply::Silence => return None,
        Reply::Code(code) => (code, None),
        Reply::Address(address) => (0, Some(address)),
    };
    let mut message = query[..2].to_vec();
    message.extend([0x85, 0x80 | code, 0, 1, 0, u8::from(address.is_some()), 0, 0, 0, 0]);
    message.extend(question);
    if let Some(address) = address {
        let (kind, bytes) = match address {
            IpAddr::V4(address) => (1, address.octets().to_vec()),
            IpAddr::V6(address) => (28, address.octets().to_vec()),
        };
        // The name of the question, the kind, IN, for ten minutes, the length.
        message.extend([0xc0, HEADER as u8, 0, kind, 0, 1, 0, 0, 2, 0x58, 0, bytes.len() as u8]);
        message.extend(bytes);
    }
    Some(message)
}
