//! The builders of images: how many images are built or pulled at a time, in all and for one address.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Weak};
use std::task::Poll;
use std::time::Duration;

use parking_lot::Mutex;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, SemaphorePermit};

/// The builders of a server.
pub struct Builders {
    count: usize,
    free: Semaphore,
    /// The share of each address that builds or waits.
    shares: Mutex<HashMap<IpAddr, Weak<Semaphore>>>,
}

/// A builder in use; dropping it frees the builder.
pub struct Builder<'builders> {
    _builder: SemaphorePermit<'builders>,
    _share: Option<OwnedSemaphorePermit>,
}

impl Builders {
    /// So many builders. One address gets all but one of them, so that builds without end leave one to others.
    pub fn new(count: usize) -> Self {
        Self {
            count,
            free: Semaphore::new(count),
            shares: Mutex::default(),
        }
    }

    /// The number of builders in use.
    pub fn in_use(&self) -> usize {
        self.count - self.free.available_permits()
    }

    /// Waits for a builder, for this time at most. `address` is that of the client, if it is known; `on_wait` is called
    /// unless a builder is free. `None` if none became free.
    pub async fn take(&self, address: Option<IpAddr>, limit: Duration, on_wait: impl FnOnce()) -> Option<Builder<'_>> {
        let share = address.map(|address| self.share_of(address));
        let take = async {
            // The semaphores are never closed. Who waits for a share holds no builder.
            let share = match share {
                Some(share) => Some(share.acquire_owned().await.ok()?),
                None => None,
            };
            Some(Builder {
                _builder: self.free.acquire().await.ok()?,
                _share: share,
            })
        };
        let mut take = Box::pin(actix_rt::time::timeout(limit, take));
        let taken = match futures_util::poll!(&mut take) {
            Poll::Ready(taken) => taken,
            Poll::Pending => {
                on_wait();
                take.await
            }
        };
        taken.ok().flatten()
    }

    fn share_of(&self, address: IpAddr) -> Arc<Semaphore> {
        let mut shares = self.shares.lock();
        shares.retain(|_, share| share.strong_count() > 0);
        if let Some(share) = shares.get(&address).and_then(Weak::upgrade) {
            return share;
        }
        let share = Arc::new(Semaphore::new((self.count - 1).max(1)));
        shares.insert(address, Arc::downgrade(&share));
        share
    }
}
