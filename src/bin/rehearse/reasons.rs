//! Why clients got no simulation or lost it, and at which simulation servers. Pure.

use std::collections::{BTreeMap, BTreeSet};

use crate::visit::Visit;

/// Limit of simulation servers that are named with a reason; of more only the number is shown.
const MOST_NAMED: usize = 3;

/// The prefix of the part of a reason that a simulation has printed.
const OUTPUT: &str = "Its last output:";

/// Counts of each kind of reason, separate for reasons that a simulation server has caused.
#[derive(Default)]
pub(crate) struct Reasons<'visits>(BTreeMap<(String, bool), Kind<'visits>>);

/// A kind of reason.
#[derive(Default)]
struct Kind<'visits> {
    count: u32,
    texts: BTreeSet<&'visits str>,
    servers: BTreeSet<&'visits str>,
}

impl<'visits> Reasons<'visits> {
    /// Counts a client's reason, with the simulation server that it was sent to, if any.
    pub(crate) fn add(&mut self, why: &'visits str, visit: &'visits Visit) {
        let why = why.trim_end_matches('.');
        // Some reasons name their server themselves.
        let server = visit.server.as_deref().filter(|server| !why.contains(server));
        let met = self.0.entry((kind(why), server.is_some())).or_default();
        met.count += 1;
        met.texts.insert(why);
        met.servers.extend(server);
    }

    /// Each kind of reason as text, with its servers and its count. If its texts differ, dots replace the differing
    /// words.
    pub(crate) fn told(self) -> BTreeMap<String, u32> {
        let told = |((kind, _), Kind { count, texts, servers }): ((String, bool), Kind<'_>)| {
            let why = texts.first().filter(|_| texts.len() == 1).map_or(kind, |text| (*text).to_owned());
            let named: Vec<&str> = servers.into_iter().collect();
            let place = match named.len() {
                0 => String::new(),
                1..=MOST_NAMED => format!(" at {}", named.join(", ")),
                many => format!(" at {many} simulation servers"),
            };
            (format!("{why}{place}"), count)
        };
        self.0.into_iter().map(told).collect()
    }
}

/// The kind of a reason: its text with dots for the parts that differ between clients: numbers, quoted names, addresses
/// and the output of a simulation.
fn kind(why: &str) -> String {
    let (why, output) = why.split_once(OUTPUT).map_or((why, ""), |(why, _)| (why, OUTPUT));
    let mut words: Vec<&str> = Vec::new();
    let mut quote = None;
    for word in why.split_whitespace().chain(output.split_whitespace()) {
        let opened =
            quote.or_else(|| word.trim_start_matches('(').chars().next().filter(|letter| "'\"`".contains(*letter)));
        let is_closed =
            opened.is_some_and(|quote| word.trim_end_matches(|letter| ".,;:)".contains(letter)).ends_with(quote));
        quote = opened.filter(|_| !is_closed);
        let differs = opened.is_some() || word.contains(|letter: char| letter.is_ascii_digit() || letter == '/');
        match (differs, words.last()) {
            (true, Some(&"...")) => {}
            (true, _) => words.push("..."),
            (false, _) => words.push(word),
        }
    }
    if !output.is_empty() {
        words.push("...");
    }
    words.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_that_differ_in_names_and_numbers_are_of_one_kind() {
        for (one, other, expected) in [
            ("disk is full: 3 MiB are left", "disk is full: 12 MiB are left", "disk is full: ... MiB are left"),
            ("can't write 'a b.x': full", "can't write 'c': full", "can't write ... full"),
            (
                "Webots ended with exit code 3. Its last output: no licence",
                "Webots ended with exit code 3. Its last output: boom | boom",
                "Webots ended with exit code ... Its last output: ...",
            ),
            ("no route to ws://gpu-1/x", "no route to ws://gpu-2/x", "no route to ..."),
        ] {
            assert_eq!((kind(one).as_str(), kind(other).as_str()), (expected, expected));
        }
        assert_ne!(kind("the disk is full"), kind("the server can't start processes"));
    }
}
