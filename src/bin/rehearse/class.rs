//! Starts the clients, each at its time.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::time::Duration;

use futures_util::future::join_all;

use crate::arguments::Arguments;
use crate::behaviour::{Behaviour, Draw};
use crate::board::Board;
use crate::browser::Browser;
use crate::interruption::interruption;
use crate::paces::Paces;
use crate::servers::Servers;
use crate::session_server::SessionServer;
use crate::visit::Visit;

/// Pause between two visits of a client in a soak.
const PAUSE: Duration = Duration::from_millis(500);

/// The result of a class.
pub(crate) struct Played {
    /// The visits of the clients.
    pub(crate) visits: Vec<Visit>,
    /// The highest load of each server.
    pub(crate) peaks: BTreeMap<String, Option<f64>>,
    /// Whether Ctrl-C or SIGTERM interrupted it.
    pub(crate) interrupted: bool,
}

/// Plays the whole class, or until Ctrl-C or SIGTERM.
pub(crate) async fn play(arguments: &Arguments) -> Played {
    let class = Class {
        arguments,
        board: Board::new(),
        session_server: SessionServer::new(&arguments.fleet),
        servers: Servers::default(),
        draw: RefCell::new(Draw::new(arguments.misbehave.clone())),
        visits: RefCell::default(),
        paces: Paces::default(),
    };
    let clients = join_all((0..arguments.clients).map(|client| class.come(client)));
    let aside = futures_util::future::join(class.board.show(), class.servers.watch());
    let mut interrupted = false;
    // Clients that are dropped record their visits so far.
    tokio::select! {
        _ = clients => {}
        _ = aside => {}
        () = interruption() => interrupted = true,
    }
    Played {
        visits: class.visits.take(),
        peaks: class.servers.peaks(),
        interrupted,
    }
}

/// The state that all clients share.
struct Class<'arguments> {
    arguments: &'arguments Arguments,
    board: Board,
    session_server: SessionServer,
    servers: Servers,
    draw: RefCell<Draw>,
    visits: RefCell<Vec<Visit>>,
    paces: Paces,
}

impl Class<'_> {
    /// One client, which visits once, or repeatedly in a soak.
    async fn come(&self, client: u32) {
        actix_rt::time::sleep(self.arguments.over * client / self.arguments.clients).await;
        let end = self.arguments.soak.map_or(0.0, |soak| soak.as_secs_f64());
        loop {
            let behaviour = self.draw.borrow_mut().next();
            self.visit(client, behaviour).await;
            if behaviour == Behaviour::Reload {
                // The reloaded page stays.
                self.visit(client, Behaviour::Ordinary).await;
            }
            if self.board.now() >= end {
                return;
            }
            actix_rt::time::sleep(PAUSE).await;
        }
    }

    async fn visit(&self, client: u32, behaviour: Behaviour) {
        let stay = self.draw.borrow_mut().stay(self.arguments.stay);
        let who = (client, behaviour, stay);
        let browser = Browser::new(
            self.arguments,
            &self.board,
            &self.session_server,
            (&self.visits, &self.paces),
            who,
        );
        browser.visit(|server| self.servers.met(server)).await;
    }
}
