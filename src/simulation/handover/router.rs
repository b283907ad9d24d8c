//! Which process of the server a connection is for.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use url::form_urlencoded;

use super::control::serving;
use super::predecessors::Predecessors;
use crate::shared::domain::Pass;
use crate::shared::http::{Owner, Router};
use crate::simulation::attachment::Token;
use crate::simulation::protocol::ClientRequest;
use crate::simulation::run_id::RunId;
use crate::simulation::slots::SlotPool;

/// Tells which process a connection is for.
pub struct ConnectionRouter {
    /// `cacheDir`.
    pub cache: PathBuf,
    /// The processes before this one.
    pub predecessors: Arc<Predecessors>,
    /// The simulations of this one.
    pub slots: Arc<SlotPool>,
    /// Whether another one has the port, or is about to have it.
    pub has_moved: Arc<AtomicBool>,
}

impl ConnectionRouter {
    /// The directory of another process that lives.
    fn other(&self, run: RunId) -> Option<PathBuf> {
        let folder = self.predecessors.folder(run);
        (run != RunId::own() && folder.exists()).then_some(folder)
    }

    /// The directory of the process that has the port, if that is not this one.
    fn newest(&self) -> Option<PathBuf> {
        self.has_moved.load(Relaxed).then(|| serving(&self.cache))
    }
}

impl Router for ConnectionRouter {
    fn request(&self, path: &str) -> Owner {
        let (path, query) = path.split_once('?').unwrap_or((path, ""));
        if path == "/client" {
            return Owner::OfFirstMessage;
        }
        let other = if let Some(rest) = path.strip_prefix("/stream/") {
            let token = Token::parse(rest.split('/').next().unwrap_or_default());
            token.and_then(|token| self.other(token.run()))
        } else if path == "/watch" {
            let mut fields = form_urlencoded::parse(query.as_bytes());
            let id = fields
                .find_map(|(name, id)| (name == "id").then_some(id))
                .unwrap_or_default();
            let is_here = self.slots.has(&id);
            self.predecessors
                .with_simulation(&id)
                .or_else(|| self.newest().filter(|_| !is_here))
        } else {
            self.newest()
        };
        other.map_or(Owner::This, Owner::Other)
    }

    fn message(&self, text: &str) -> Option<PathBuf> {
        let pass = match ClientRequest::parse(text).ok()? {
            ClientRequest::Resume(token) => return self.other(Token::parse(&token)?.run()),
            ClientRequest::Start(start) => start.pass,
            _ => None,
        };
        let server = pass.and_then(|pass| Pass::server_of(&pass));
        match server.map(|server| RunId::of(server.0)) {
            Some(run) if run == RunId::own() => None,
            Some(run) => self.other(run).or_else(|| self.newest()),
            None => self.newest(),
        }
    }
}
