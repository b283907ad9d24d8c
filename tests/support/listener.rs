//! Small HTTP servers in threads, for answers that come from a test itself.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::sync::Arc;

use rustls::{ServerConfig, ServerConnection, StreamOwned};

pub struct Request {
    pub head: String,
    pub content: Vec<u8>,
}

impl Request {
    /// The request target as sent.
    pub fn path(&self) -> &str {
        self.head.split(' ').nth(1).unwrap_or_default()
    }

    /// The value of a header, whose name is given in lower case; empty if it is missing.
    pub fn header(&self, name: &str) -> &str {
        let headers = self.head.lines().filter_map(|line| line.split_once(": "));
        headers
            .filter(|(other, _)| other.to_lowercase() == name)
            .map(|(_, value)| value)
            .next()
            .unwrap_or_default()
    }
}

/// Answers one request after another with a status and a body, until `answer` returns `None`.
pub fn listen(listener: TcpListener, mut answer: impl FnMut(Request) -> Option<(u16, &'static str)> + Send + 'static) {
    std::thread::spawn(move || {
        for connection in listener.incoming().flatten() {
            // The client broke off its request.
            let Some(request) = read(&connection) else { continue };
            let Some((status, content)) = answer(request) else {
                return;
            };
            write(&connection, &format!("{status} -"), content.as_bytes());
        }
    });
}

/// Answers requests in parallel with a status, headers and a body; over TLS if there is a certificate.
pub fn serve<A>(listener: TcpListener, certificate: Option<Arc<ServerConfig>>, answer: A)
where
    A: Fn(&Request) -> Option<(String, Vec<u8>)> + Clone + Send + 'static,
{
    std::thread::spawn(move || {
        for connection in listener.incoming().flatten() {
            let certificate = certificate.clone();
            let answer = answer.clone();
            std::thread::spawn(move || match certificate {
                None => exchange(&mut &connection, &answer),
                Some(certificate) => {
                    let mut tls = StreamOwned::new(ServerConnection::new(certificate).unwrap(), connection);
                    exchange(&mut tls, &answer)?;
                    tls.conn.send_close_notify();
                    tls.flush().ok()
                }
            });
        }
    });
}

fn exchange(stream: &mut (impl Read + Write), answer: &impl Fn(&Request) -> Option<(String, Vec<u8>)>) -> Option<()> {
    let request = read(&mut *stream)?;
    let (head, content) = answer(&request)?;
    write(stream, &head, &content)
}

fn write(mut stream: impl Write, head: &str, content: &[u8]) -> Option<()> {
    write!(
        stream,
        "HTTP/1.1 {head}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
        content.len()
    )
    .ok()?;
    stream.write_all(content).ok()
}

fn read(stream: impl Read) -> Option<Request> {
    let mut reader = BufReader::new(stream);
    let mut head = String::new();
    while !head.ends_with("\r\n\r\n") {
        if reader.read_line(&mut head).ok()? == 0 {
            return None;
        }
    }
    let mut request = Request {
        head,
        content: Vec::new(),
    };
    request.content = vec![0; request.header("content-length").parse().unwrap_or(0)];
    reader.read_exact(&mut request.content).ok()?;
    Some(request)
}
