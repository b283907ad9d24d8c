//! Who competes with whom: the clients of the line by the servers that take them.
//!
//! What depends on the servers is worked out for a class of clients, and not for each of them. A server's rules are
//! applied to a repository when its first client comes, and when the server reports others.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::Arc;

use super::rate::Basis;
use crate::shared::domain::{Admission, ProjectUrl};

/// On what terms a server takes a world.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Terms {
    /// By its rules alone, whatever its load.
    pub admission: Admission,
    /// Whether it does at the load that it has reported: who waits for its idle time is ahead of nobody until then.
    pub is_open: bool,
}

/// The worlds of one repository: each server accepts all of them, or none.
#[derive(Debug)]
pub(super) struct Group {
    /// One of its worlds.
    pub(super) world: Arc<ProjectUrl>,
    /// The repository, in lower case.
    pub(super) repository: String,
    /// The class of its clients.
    pub(super) class: Cell<ClassId>,
}

/// An index of [`Classes`], until these change.
pub(super) type ClassId = usize;

/// The clients that the same servers take on the same terms.
#[derive(Debug)]
pub(super) struct Class {
    /// A world of one of them.
    pub(super) world: ProjectUrl,
    /// Number of those who wait.
    pub(super) waiting: u32,
    /// The terms of each server, in the order of [`Classes::servers`].
    terms: Vec<Option<Terms>>,
    /// The classes that some server takes too at its load, and itself.
    competitors: Vec<ClassId>,
}

/// The classes of all who wait.
#[derive(Debug)]
pub(super) struct Classes<Server> {
    servers: Vec<Server>,
    all: Vec<Class>,
}

/// What else decides when it is the turn of a class.
#[derive(Debug)]
pub(super) struct Doors {
    /// When the clients at the doors of its servers have come, in milliseconds since 1970, in order.
    pub(super) queue: Vec<u64>,
    /// How often slots of its servers become free.
    pub(super) basis: Basis,
}

impl<Server> Default for Classes<Server> {
    fn default() -> Self {
        Self {
            servers: Vec::new(),
            all: Vec::new(),
        }
    }
}

impl<Server: Clone + Eq> Classes<Server> {
    /// The class of a world. `terms` is on what terms a server takes it.
    pub(super) fn of(&mut self, world: &ProjectUrl, terms: impl Fn(&Server, &ProjectUrl) -> Option<Terms>) -> ClassId {
        let terms = self.servers.iter().map(|server| terms(server, world)).collect();
        self.with_terms(terms, world)
    }

    fn with_terms(&mut self, terms: Vec<Option<Terms>>, world: &ProjectUrl) -> ClassId {
        if let Some(known) = self.all.iter().position(|class| class.terms == terms) {
            return known;
        }
        let new = self.all.len();
        let is_open = |terms: &Option<Terms>| terms.is_some_and(|terms| terms.is_open);
        let is_shared = |other: &Class| {
            let both = other.terms.iter().zip(&terms);
            both.into_iter().any(|(other, own)| is_open(other) && is_open(own))
        };
        let mut competitors = vec![new];
        for (id, other) in self.all.iter_mut().enumerate() {
            if is_shared(other) {
                other.competitors.push(new);
                competitors.push(id);
            }
        }
        self.all.push(Class {
            world: world.clone(),
            waiting: 0,
            terms,
            competitors,
        });
        new
    }

    /// The fleet consists of these servers now. `groups` are the groups of those who wait, each with the number of them.
    pub(super) fn set_servers<'line>(
        &mut self,
        servers: &[Server],
        groups: impl Iterator<Item = (&'line Rc<Group>, u32)>,
        terms: impl Fn(&Server, &ProjectUrl) -> Option<Terms>,
    ) {
        servers.clone_into(&mut self.servers);
        self.classify(groups, |server, world, _| terms(server, world));
    }

    /// A server has other rules now.
    pub(super) fn rules_changed<'line>(
        &mut self,
        changed: &Server,
        groups: impl Iterator<Item = (&'line Rc<Group>, u32)>,
        terms: impl Fn(&Server, &ProjectUrl) -> Option<Terms>,
    ) {
        let of = |server: &Server, world: &ProjectUrl, before| {
            if server == changed {
                terms(server, world)
            } else {
                before
            }
        };
        self.classify(groups, of);
    }

    /// Puts all groups into classes again. `terms` also receives the terms so far.
    fn classify<'line>(
        &mut self,
        groups: impl Iterator<Item = (&'line Rc<Group>, u32)>,
        terms: impl Fn(&Server, &ProjectUrl, Option<Terms>) -> Option<Terms>,
    ) {
        let before = std::mem::take(&mut self.all);
        for (group, waiting) in groups {
            let known = before.get(group.class.get()).map(|class| class.terms.as_slice());
            let known = known.unwrap_or_default().iter().copied().chain(std::iter::repeat(None));
            let servers = self.servers.iter().zip(known);
            let new = servers
                .map(|(server, known)| terms(server, &group.world, known))
                .collect();
            let class = self.with_terms(new, &group.world);
            group.class.set(class);
            self.add(class, waiting);
        }
    }

    /// Clients of a class have come.
    pub(super) fn add(&mut self, class: ClassId, clients: u32) {
        if let Some(class) = self.all.get_mut(class) {
            class.waiting += clients;
        }
    }

    /// A client of a class has gone.
    pub(super) fn subtract_one(&mut self, class: ClassId) {
        if let Some(class) = self.all.get_mut(class) {
            class.waiting -= 1;
        }
    }

    /// A class.
    pub(super) fn get(&self, class: ClassId) -> Option<&Class> {
        self.all.get(class)
    }

    /// The classes, in the order of their ids; of some nobody may wait any more.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Class> {
        self.all.iter()
    }

    /// Number of the classes of which somebody waits.
    pub(super) fn occupied(&self) -> usize {
        self.all.iter().filter(|class| class.waiting > 0).count()
    }

    /// Whether a server takes a class by its rules.
    pub(super) fn may_use(&self, class: ClassId, server: &Server) -> bool {
        self.terms_of(class).any(|(one, _)| one == server)
    }

    /// The servers that take a class at the load that they have reported.
    pub(super) fn servers_of(&self, class: ClassId) -> impl Iterator<Item = &Server> {
        let open = self.terms_of(class).filter(|(_, terms)| terms.is_open);
        open.map(|(server, _)| server)
    }

    fn terms_of(&self, class: ClassId) -> impl Iterator<Item = (&Server, &Terms)> {
        let terms = self.all.get(class).map(|class| class.terms.as_slice());
        let all = self.servers.iter().zip(terms.unwrap_or_default());
        all.filter_map(|(server, terms)| Some((server, terms.as_ref()?)))
    }

    /// Number of clients ahead that compete with one of this class, if `ahead` are those ahead by class.
    pub(super) fn competing(&self, class: ClassId, ahead: &[u32]) -> u32 {
        let competitors = self.all.get(class).map(|class| class.competitors.as_slice());
        competitors
            .unwrap_or_default()
            .iter()
            .filter_map(|other| ahead.get(*other))
            .sum()
    }
}
