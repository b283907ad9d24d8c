//! What is sent and what arrives at what a simulation has listening, and back: names of files with blanks and letters of
//! any language do, no way leads out of a port, and nothing is held back.

use std::io::{Read, Write};
use std::net::TcpListener;
use std::sync::mpsc::{Receiver, channel};

use futures_util::StreamExt;

use super::fleet::Fleet;
use super::rules::Rules;
use super::web_server::Kind;
use crate::support::SOON;
use crate::support::listener::listen;

/// Stands in for the files of a Webots: tells which path it was asked for.
fn files_of_webots(port: u16) -> Receiver<String> {
    let listener = TcpListener::bind(("127.0.0.1", port)).unwrap();
    let (told, asked) = channel();
    // Once the test has ended there is nobody to tell.
    listen(listener, move |request| told.send(request.path().to_owned()).ok().map(|()| (200, "file")));
    asked
}

/// What is asked for, and what arrives through Apache and through nginx; nothing where they refuse.
const PATHS: [(&str, Option<&str>, Option<&str>); 13] = [
    ("/textures/my%20file.png", Some("/textures/my%20file.png"), Some("/textures/my%20file.png")),
    ("/%C3%BC+%2B.png?x=a%20b&y=%2F", Some("/%C3%BC++.png?x=a%20b&y=%2F"), Some("/%C3%BC++.png?x=a%20b&y=%2F")),
    ("/a%25b.png", Some("/a%25b.png"), Some("/a%25b.png")),
    ("/a%252fb.png", Some("/a%252fb.png"), Some("/a%252fb.png")),
    ("/a%23b.png", Some("/a%23b.png"), Some("/a%23b.png")),
    // Apache takes a question mark in a name for an attack.
    ("/a%3Fb.png", None, Some("/a%3Fb.png")),
    // A name with a slash is that of a folder, or of nothing.
    ("/a%2Fb.png", None, Some("/a/b.png")),
    ("/a/%2e%2e/b.png", Some("/b.png"), Some("/b.png")),
    ("/%2e%2e/b.png", None, None),
    ("/a/..%2F..%2Fb.png", None, None),
    // What would end a line stays a part of the name.
    ("/a%0D%0AX:%20y.png", Some("/a%0D%0AX:%20y.png"), Some("/a%0D%0AX:%20y.png")),
    ("/a%00.png", None, None),
    ("//a.png", Some("/a.png"), Some("/a.png")),
];

pub async fn paths_arrive(fleet: &Fleet, rules: Rules) {
    let port = fleet.here.port + 2;
    let asked = files_of_webots(port);
    for (path, apache, nginx) in PATHS {
        let wanted = if rules.kind() == Kind::Apache { apache } else { nginx };
        let answer = fleet.browser.get(&format!("/{port}{path}")).await;
        if wanted.is_some() {
            assert_eq!((answer.status.as_u16(), answer.text().as_str()), (200, "file"), "{path}");
        } else {
            assert!([400, 403, 404].contains(&answer.status.as_u16()), "{path}: {}", answer.status);
        }
        assert_eq!(asked.try_recv().ok().as_deref(), wanted, "{path}");
    }
}

/// What a live page is told, or the pictures of a Webots that streams a video.
pub async fn what_is_sent_in_pieces_comes_in_pieces(fleet: &Fleet) {
    let port = fleet.here.port + 3;
    let listener = TcpListener::bind(("127.0.0.1", port)).unwrap();
    let (next, wanted) = std::sync::mpsc::channel::<()>();
    let sender = std::thread::spawn(move || {
        let (mut connection, _) = listener.accept().unwrap();
        assert_ne!(connection.read(&mut [0; 4096]).unwrap(), 0);
        connection.write_all(b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\n\r\n").unwrap();
        for piece in ["one", "two", "three"] {
            connection.write_all(format!("data: {piece}\n\n").as_bytes()).unwrap();
            wanted.recv_timeout(SOON).unwrap();
        }
    });
    let url = format!("https://{}/{port}/events", fleet.browser.host);
    let mut page = fleet.browser.begin(&url, &[]).await;
    for piece in ["one", "two", "three"] {
        let mut came = Vec::new();
        while !came.ends_with(b"\n\n") {
            let more = actix_rt::time::timeout(SOON, page.next()).await.expect("it is held back");
            came.extend_from_slice(&more.unwrap().unwrap());
        }
        assert_eq!(came, format!("data: {piece}\n\n").as_bytes());
        next.send(()).unwrap();
    }
    sender.join().unwrap();
}
