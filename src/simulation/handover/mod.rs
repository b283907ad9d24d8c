//! An upgrade without an end: the server starts its program anew, and the new process takes the port over. The one before
//! serves its simulations until their clients leave.
//!
//! Both have the listening socket, the lock of `cacheDir` and that of the PID file: open files, which the new process gets
//! over a Unix socket ([`Inheritance`]). Each connection goes to the process that serves what its request is for
//! ([`ConnectionRouter`]): tokens and passes name it, and everything else is for the one that has the port, to whose
//! directory the link `serving` in `cacheDir` leads. That one asks the others what they have ([`Predecessors`]), for its
//! pages, and because their ports are not free: a port is given back, and never taken again.
//!
//! Each process can be asked over the socket `control` in its directory ([`control`]).

pub mod control;
mod inheritance;
mod predecessors;
mod router;

pub use inheritance::{Inheritance, PROTOCOL, TAKES_OVER, Takeover, ToPredecessor, ToSuccessor};
pub use predecessors::Predecessors;
pub use router::ConnectionRouter;
