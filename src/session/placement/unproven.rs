//! The placements on a server that reports only a load: whether their clients came is for the load to tell.

use super::allowance::Allowances;
use super::cost::Told;
use super::policy::Policy;
use std::collections::VecDeque;
use std::net::IpAddr;
use std::time::Instant;

/// When a placement was made, and for which address.
type Placed = (Instant, IpAddr);

/// The placements of one server, oldest first.
#[derive(Debug, Default)]
pub(super) struct Unproven {
    new: VecDeque<Placed>,
    /// Those that should show in the load by now and don't. They may only be slow: a checkout takes its time.
    doubted: VecDeque<Placed>,
}

impl Unproven {
    /// Another placement; only one that counts among its address's allowance.
    pub(super) fn add(&mut self, placed: Placed) {
        self.new.push_back(placed);
    }

    /// Nothing will ever tell whether they came.
    pub(super) fn clear(&mut self) {
        self.new.clear();
        self.doubted.clear();
    }

    /// Counts what a step of the load has told, for those whose clients show in it: on average after half of the settling.
    pub(super) fn judge(&mut self, now: Instant, told: Told, policy: &Policy, allowances: &mut Allowances) {
        if told == Told::NotYet {
            return;
        }
        let age = |at: Instant| now.saturating_duration_since(at);
        let first = self.new.partition_point(|(at, _)| age(*at) > policy.settling / 2);
        for placed in self.new.drain(..first) {
            match told {
                Told::Came => allowances.came(placed.1),
                Told::Missed => self.doubted.push_back(placed),
                Told::NotYet | Told::Nothing | Told::Late => {}
            }
        }
        if matches!(told, Told::Came | Told::Late) {
            self.doubted.drain(..).for_each(|(_, from)| allowances.came(from));
        }
        let given_up = self.doubted.partition_point(|(at, _)| age(*at) >= policy.patience);
        self.doubted.drain(..given_up).for_each(|(_, from)| allowances.missed(from));
    }
}
