//! A small HTTP server in a thread, for what a test wants to be asked or to answer by itself.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::sync::Arc;

use rustls::{ServerConfig, ServerConnection, StreamOwned};

/// A request.
pub struct Request {
    pub head: String,
    pub content: Vec<u8>,
}

impl Request {
    /// What was asked for, as it was sent.
    pub fn path(&self) -> &str {
        self.head.split(' ').nth(1).unwrap_or_default()
    }

    /// The value of a header, whose name is written in small letters; empty where there is none.
    pub fn header(&self, name: &str) -> &str {
        let headers = self.head.lines().filter_map(|line| line.split_once(": "));
        headers.filter(|(other, _)| other.to_lowercase() == name).map(|(_, value)| value).next().unwrap_or_default()
    }
}

/// Answers each request with a status and a content, until the test program ends or there is no answer.
pub fn listen(listener: TcpListener, mut answer: impl FnMut(Request) -> Option<(u16, &'static str)> + Send + 'static) {
    std::thread::spawn(move || {
        for connection in listener.incoming().flatten() {
            // Who breaks off is not answered.
            let Some(request) = read(&connection) else { continue };
            let Some((status, content)) = answer(request) else { return };
            write(&connection, &format!("{status} -"), content.as_bytes());
        }
    });
}

/// Answers requests side by side, encrypted where there is a certificate: with a status and headers, and a content.
pub fn serve<A>(listener: TcpListener, certificate: Option<Arc<ServerConfig>>, answer: A)
where
    A: Fn(&Request) -> Option<(String, Vec<u8>)> + Clone + Send + 'static,
{
    std::thread::spawn(move || {
        for connection in listener.incoming().flatten() {
            let (certificate, answer) = (certificate.clone(), answer.clone());
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
    write!(stream, "HTTP/1.1 {head}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", content.len()).ok()?;
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
    let mut request = Request { head, content: Vec::new() };
    request.content = vec![0; request.header("content-length").parse().unwrap_or(0)];
    reader.read_exact(&mut request.content).ok()?;
    Some(request)
}
