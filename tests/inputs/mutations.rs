//! Mutations of examples: parts are removed or repeated; random bytes or strings known to break programs are inserted.

use proptest::prelude::*;
use proptest::sample::{Index, select};

/// Strings with a meaning in paths, shells, git, JSON, pages or headers.
const SHORT: [&str; 36] = [
    "..", "/", "//", "%2e", "%2f", "%00", "%0a", "%", "\\", "~", "-", "ext::", "file://", "$(id)", "`id`", ";", "|",
    "&", "\"", "\\u0000", "\\ud800", "{", "}", "[", "]", ",", ":", "null", "true", "-1", "1e999", "0.1", "\n", "\r\n",
    "\0", "\u{feff}",
];
const LONG: [&str; 4] = ["--upload-pack=id", "<img src=x>", "99999999999999999999", "\u{202e}"];

/// One change to a text.
#[derive(Debug, Clone)]
enum Mutation {
    /// Inserts these bytes.
    Insert(Index, Vec<u8>),
    /// Removes this many bytes.
    Remove(Index, usize),
    /// Repeats this many bytes this many times.
    Repeat(Index, usize, usize),
    /// Replaces the rest by the end of another example.
    Join(Index, Index, Index),
}

/// Mutations of the lines of a text, each an example.
pub fn of(seeds: &'static str) -> impl Strategy<Value = Vec<u8>> {
    let seeds: Vec<&'static [u8]> = seeds.lines().map(str::as_bytes).collect();
    let piece = prop_oneof![
        4 => select([&SHORT[..], &LONG].concat()).prop_map(|piece| piece.as_bytes().to_vec()),
        1 => prop::collection::vec(any::<u8>(), 1..8),
    ];
    let mutation = prop_oneof![
        3 => (any::<Index>(), piece).prop_map(|(at, piece)| Mutation::Insert(at, piece)),
        2 => (any::<Index>(), 1_usize..20).prop_map(|(at, length)| Mutation::Remove(at, length)),
        1 => (any::<Index>(), 1_usize..20, 1_usize..300).prop_map(|(at, length, times)| Mutation::Repeat(at, length, times)),
        1 => (any::<Index>(), any::<Index>(), any::<Index>()).prop_map(|(at, seed, from)| Mutation::Join(at, seed, from)),
    ];
    (select(seeds.clone()), prop::collection::vec(mutation, 0..6)).prop_map(move |(seed, mutations)| {
        mutations
            .into_iter()
            .fold(seed.to_vec(), |text, mutation| changed(text, mutation, &seeds))
    })
}

fn changed(mut text: Vec<u8>, mutation: Mutation, seeds: &[&[u8]]) -> Vec<u8> {
    let place = |at: Index, length: usize| at.index(length + 1);
    match mutation {
        Mutation::Insert(at, piece) => {
            let at = place(at, text.len());
            text.splice(at..at, piece);
        }
        Mutation::Remove(at, length) => {
            let at = place(at, text.len());
            text.drain(at..(at + length).min(text.len()));
        }
        Mutation::Repeat(at, length, times) => {
            let at = place(at, text.len());
            let piece = text[at..(at + length).min(text.len())].repeat(times);
            text.splice(at..at, piece);
        }
        Mutation::Join(at, seed, from) => {
            text.truncate(place(at, text.len()));
            let other = seeds[seed.index(seeds.len())];
            text.extend_from_slice(&other[place(from, other.len())..]);
        }
    }
    text
}
