//! The administrator's current announcement, if there is one.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;

use super::config::Announcement;

/// The current announcement: that of the configuration, or the one that was posted since.
pub struct Announcements(watch::Sender<Option<Arc<Announcement>>>);

/// Interval between two checks whether it has expired.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);

impl Announcements {
    /// Starts with the announcement of the configuration, and a task that removes expired ones.
    pub fn start(configured: Option<Announcement>) -> Self {
        let announcements = Self(watch::Sender::new(None));
        announcements.set(configured);
        let current = announcements.0.clone();
        actix_rt::spawn(async move {
            loop {
                actix_rt::time::sleep(CHECK_INTERVAL).await;
                current.send_if_modified(|one| one.take_if(|one| one.is_over()).is_some());
            }
        });
        announcements
    }

    /// Replaces the announcement; an expired one removes it.
    pub fn set(&self, announcement: Option<Announcement>) {
        let announcement = announcement.filter(|one| !one.is_over());
        match &announcement {
            Some(Announcement { text, .. }) => log::info!("announced to everybody: {text}"),
            None => log::debug!("nothing is announced"),
        }
        self.0.send_replace(announcement.map(Arc::new));
    }

    /// The current announcement.
    pub fn current(&self) -> Option<Arc<Announcement>> {
        self.0.borrow().clone()
    }

    /// Receives changes.
    pub fn subscribe(&self) -> watch::Receiver<Option<Arc<Announcement>>> {
        self.0.subscribe()
    }
}
