//! The user's consent to load a fleet, or a part of it, that is not on this machine.

use std::cell::{Cell, RefCell};
use std::collections::BTreeSet;
use std::io::{BufRead, IsTerminal, Write};

use url::Url;

use crate::arguments::Arguments;
use crate::localhost::is_localhost;

/// The servers that this program may load: those on this machine, and all others once the user has agreed.
pub(crate) struct Consent<'arguments> {
    arguments: &'arguments Arguments,
    everywhere: Cell<bool>,
    /// The simulation servers that were found to be on this machine.
    here: RefCell<BTreeSet<String>>,
    refusal: RefCell<Option<String>>,
}

impl<'arguments> Consent<'arguments> {
    /// No question was asked yet; `--yes` agrees.
    pub(crate) fn new(arguments: &'arguments Arguments) -> Self {
        Self { arguments, everywhere: Cell::new(arguments.yes), here: RefCell::default(), refusal: RefCell::default() }
    }

    /// Whether the session server may be loaded; asks if it is not on this machine.
    pub(crate) fn has_fleet(&self) -> bool {
        let fleet = &self.arguments.fleet;
        self.everywhere.get() || is_localhost(fleet) || self.agrees(fleet.as_str(), "")
    }

    /// Whether a simulation server may be loaded to which the session server sends a client.
    pub(crate) fn has_server(&self, server: &str) -> bool {
        if self.everywhere.get() || self.here.borrow().contains(server) {
            return true;
        }
        if Url::parse(server).is_ok_and(|url| is_localhost(&url)) {
            return self.here.borrow_mut().insert(server.to_owned());
        }
        self.agrees(server, &format!(", where {} sends its clients", self.arguments.fleet))
    }

    /// The error if the user did not agree.
    pub(crate) fn refusal(&self) -> Option<String> {
        self.refusal.borrow().clone()
    }

    /// Asks once for all servers. Without a terminal the answer is no.
    fn agrees(&self, whom: &str, why: &str) -> bool {
        if self.refusal.borrow().is_some() {
            return false;
        }
        if !self.everywhere.get() && !may_load(whom, why, &self.arguments.summary()) {
            self.refusal.replace(Some(format!("nobody agreed to load {whom}{why}; --yes agrees")));
            return false;
        }
        self.everywhere.set(true);
        true
    }
}

fn may_load(whom: &str, why: &str, with: &str) -> bool {
    if !std::io::stdin().is_terminal() {
        return false;
    }
    eprint!("{whom}{why} is not this machine. Load it with {with}? [y/N] ");
    std::io::stderr().flush().ok();
    let mut answer = String::new();
    std::io::stdin().lock().read_line(&mut answer).is_ok() && matches!(answer.trim(), "y" | "Y" | "yes")
}
