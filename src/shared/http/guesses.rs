//! A limit for guesses of the password, which locks nobody out who has given the right one before.
//!
//! A class shares its teacher's address, so guesses from there must not use up what the teacher needs. A program counts as
//! known once it has sent the right password: then it has a limit of its own, as a browser has that was signed in before.
//! Over the limit a password is not compared, so that a client that guesses does not learn which one is right.

use std::collections::HashMap;
use std::hash::{BuildHasher, RandomState};
use std::net::{IpAddr, Ipv6Addr};
use std::time::{Duration, Instant};

use actix_web::HttpRequest;
use actix_web::http::header;
use parking_lot::Mutex;

use super::limits::Quota;
use super::peer::Peer;

/// Wrong passwords at once.
const BURST: u32 = 30;
/// Wrong passwords in each minute after that.
const PER_MINUTE: u32 = 12;
/// How long a program is known after its last right password.
const KNOWN: Duration = Duration::from_hours(24);
/// Most programs that are known.
const MAX_KNOWN: usize = 1000;

/// Counts wrong passwords.
#[derive(Debug)]
pub struct Guesses {
    strangers: Quota<IpAddr>,
    known: Quota<u64>,
    /// The programs that are known, each with the time of its last right password.
    programs: Mutex<HashMap<u64, Instant>>,
    hasher: RandomState,
}

/// Who sends a password.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Guesser {
    /// A browser that was signed in before, by the number in its cookie.
    Browser(u64),
    /// A program: its address, the user name that it gives, and its `User-Agent`.
    Program(IpAddr, u64),
}

/// Too many passwords were wrong; this one was not compared.
#[derive(Debug, PartialEq, Eq)]
pub struct TooMany;

impl Guesses {
    /// Nobody has guessed.
    pub fn new() -> Self {
        Self {
            strangers: Quota::new(BURST, PER_MINUTE),
            known: Quota::new(BURST, PER_MINUTE),
            programs: Mutex::default(),
            hasher: RandomState::new(),
        }
    }

    /// The program that gives this user name.
    pub fn program(&self, request: &HttpRequest, peer: Peer, user: &str) -> Guesser {
        // Proxies that don't report client addresses share one quota.
        let address = peer.rate_limit_key().unwrap_or(Ipv6Addr::UNSPECIFIED.into());
        let agent = request.headers().get(header::USER_AGENT);
        let agent = agent.map(header::HeaderValue::as_bytes);
        Guesser::Program(address, self.hasher.hash_one((address, user, agent)))
    }

    /// Compares a password, if its sender may guess. Only wrong passwords count.
    ///
    /// # Errors
    /// When its sender has guessed too often.
    pub fn judge(&self, who: Guesser, is_right: impl FnOnce() -> bool) -> Result<bool, TooMany> {
        let known = self.known_as(who);
        let address = match who {
            Guesser::Program(address, _) if known.is_none() => Some(address),
            _ => None,
        };
        // Taken before the comparison: requests that arrive together must not all be compared.
        if !(self.known.take(known) && self.strangers.take(address)) {
            return Err(TooMany);
        }
        let is_right = is_right();
        if is_right {
            self.known.give_back(known);
            self.strangers.give_back(address);
            self.remember(who);
        }
        Ok(is_right)
    }

    fn known_as(&self, who: Guesser) -> Option<u64> {
        match who {
            Guesser::Browser(number) => Some(number),
            Guesser::Program(_, number) => {
                let programs = self.programs.lock();
                let is_known = programs.get(&number).is_some_and(|last| last.elapsed() < KNOWN);
                is_known.then_some(number)
            }
        }
    }

    fn remember(&self, who: Guesser) {
        if let Guesser::Program(_, number) = who {
            let mut programs = self.programs.lock();
            if programs.len() >= MAX_KNOWN {
                programs.retain(|_, last| last.elapsed() < KNOWN);
            }
            if programs.len() < MAX_KNOWN || programs.contains_key(&number) {
                programs.insert(number, Instant::now());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn program(last: u8, number: u64) -> Guesser {
        Guesser::Program([203, 0, 113, last].into(), number)
    }

    fn wrong(guesses: &Guesses, who: Guesser) -> usize {
        (0..100).filter(|_| guesses.judge(who, || false) == Ok(false)).count()
    }

    #[test]
    fn guesses_lock_nobody_out_who_is_known() {
        let guesses = Guesses::new();
        let (teacher, student) = (program(1, 1), program(1, 2));
        for _ in 0..100 {
            assert_eq!(
                guesses.judge(teacher, || true),
                Ok(true),
                "the right one does not count"
            );
        }
        assert_eq!(wrong(&guesses, student), 30);
        assert_eq!(guesses.judge(student, || true), Err(TooMany), "it is not compared");
        assert_eq!(guesses.judge(teacher, || true), Ok(true));
        assert_eq!(guesses.judge(Guesser::Browser(7), || true), Ok(true));
        // Other names of a stranger are no way around.
        assert_eq!(wrong(&guesses, program(1, 3)), 0);
        assert_eq!(wrong(&guesses, program(2, 3)), 30, "another address");
        // Those who are known may not guess without limit either.
        assert_eq!(wrong(&guesses, teacher), 30);
        assert_eq!(wrong(&guesses, Guesser::Browser(7)), 30);
    }
}
