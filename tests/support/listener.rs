//! A small HTTP server in a thread, for what a test wants to be asked or to answer by itself.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};

/// A request. Its content is text in tests.
pub struct Request {
    pub head: String,
    pub content: String,
}

impl Request {
    /// What was asked for, as it was sent.
    pub fn path(&self) -> &str {
        self.head.split(' ').nth(1).unwrap_or_default()
    }
}

/// Answers each request with a status and a content, until the test program ends or there is no answer.
pub fn listen(listener: TcpListener, mut answer: impl FnMut(Request) -> Option<(u16, &'static str)> + Send + 'static) {
    std::thread::spawn(move || {
        for connection in listener.incoming().flatten() {
            // Who breaks off is not answered.
            let Some(request) = read(&connection) else { continue };
            let Some((status, content)) = answer(request) else { return };
            let head = format!("HTTP/1.1 {status} -\r\nContent-Length: {}\r\nConnection: close", content.len());
            write!(&connection, "{head}\r\n\r\n{content}").ok();
        }
    });
}

fn read(connection: &TcpStream) -> Option<Request> {
    let mut reader = BufReader::new(connection);
    let mut head = String::new();
    while !head.ends_with("\r\n\r\n") {
        if reader.read_line(&mut head).ok()? == 0 {
            return None;
        }
    }
    let length = head.lines().find_map(|line| line.to_lowercase().strip_prefix("content-length: ")?.parse().ok());
    let mut content = vec![0; length.unwrap_or(0)];
    reader.read_exact(&mut content).ok()?;
    Some(Request { head, content: String::from_utf8_lossy(&content).into_owned() })
}
