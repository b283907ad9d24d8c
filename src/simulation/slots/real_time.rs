//! Follows how fast simulations run: tells their clients and the metric, and limits the places. Part of the slot pool.

use std::sync::Arc;
use std::time::{Duration, Instant};

use prometheus::Histogram;

use super::real_time_places::Pace;
use super::simulation_record::SlotEvent;
use super::slot_pool::{SlotPool, Slots};
use crate::simulation::simulated_time::REAL_TIME;

/// Interval between two looks at all simulations.
const PERIOD: Duration = Duration::from_secs(1);
/// Number of looks between two messages to a client, and two observations of the metric.
const LOOKS: u32 = 5;

impl SlotPool {
    /// Follows how fast simulations run, tells clients of slow ones, and limits the number of places so that `target` is
    /// kept, unless it is 0. `histogram` observes all simulations.
    pub async fn follow_real_time(self: Arc<Self>, target: f64, histogram: Histogram) {
        let mut looks = 0_u32;
        loop {
            actix_rt::time::sleep(PERIOD).await;
            looks = looks.wrapping_add(1);
            let mut slots = self.0.lock();
            if looks.is_multiple_of(LOOKS) {
                slots.tell_paces(&histogram);
            }
            if target > 0.0 {
                slots.limit_places(target);
            }
        }
    }

    /// The number of places that are offered because simulations are slow; `None` if all are.
    pub fn real_time_places(&self) -> Option<usize> {
        let slots = self.0.lock();
        slots.real_time.places().filter(|places| *places < slots.all_places())
    }
}

impl Slots {
    fn limit_places(&mut self, target: f64) {
        let paces: Vec<Pace> = self
            .of_clients()
            .filter_map(|record| {
                Some(Pace {
                    factor: record.time.recent()?,
                    world: record.world.clone(),
                })
            })
            .collect();
        let slots = (self.used(), self.all_places());
        self.real_time.take_in(&paces, slots, target, Instant::now());
    }

    /// Tells the client of each simulation that is slow how fast it runs, and once that it is not slow any more.
    fn tell_paces(&mut self, histogram: &Histogram) {
        for record in self.records.values_mut() {
            let factor = record.time.recent();
            if let Some(factor) = factor {
                histogram.observe(factor);
            }
            let slow = factor.filter(|factor| *factor < REAL_TIME);
            let Some(served) = record.served_mut() else { continue };
            let is_news = slow.is_some() || served.knows_slow;
            served.knows_slow = slow.is_some();
            if is_news {
                record.listener.do_send(SlotEvent::Pace(slow));
            }
        }
    }
}
