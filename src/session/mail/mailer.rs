//! Mails to the administrator.
//!
//! Created once by the app, if the configuration is for mails; the registry sends it [`Notice`]s. It owns what is yet
//! to be mailed: [`Notices`] decides what, [`Outbox`] when. One mail is on its way at most, and nobody waits for it.
//! It never ends by itself; its supervisor restarts it with fresh state.

use std::time::{Duration, Instant};

use actix::prelude::*;

use super::email::Letterhead;
use super::notices::{Entry, Notice, Notices};
use super::outbox::{Batch, Failure, Outbox, Persistence};
use super::smtp::{MailError, Relay};
use crate::session::config::SessionConfig;

/// How many entries wait at most: both topics of every server of the largest fleet.
const MOST_ENTRIES: usize = 2_000;

/// How many notices may come in one instant: all servers of the largest fleet.
const MOST_AT_ONCE: usize = 4_096;

/// Tells the administrator what happens to simulation servers.
pub struct Mailer {
    relay: Relay,
    letterhead: Letterhead,
    pace: Pace,
    notices: Notices,
    outbox: Outbox,
    sending: bool,
    alarm: Option<(Instant, SpawnHandle)>,
}

/// The durations a mailer starts with, each time.
#[derive(Debug, Clone, Copy)]
struct Pace {
    gather: Duration,
    flapping: Duration,
    persistence: Persistence,
}

impl Pace {
    fn fresh(self) -> (Notices, Outbox) {
        (Notices::new(self.gather, self.flapping), Outbox::new(self.persistence))
    }
}

/// Starts the mailer under a supervisor; none if the configuration is not for mails.
#[must_use]
pub fn start(config: &SessionConfig) -> Option<Addr<Mailer>> {
    let mailer = Mailer::new(config).inspect_err(|why| log::info!("{why}")).ok()?;
    Some(Supervisor::start(|_| mailer))
}

/// Sends one mail now, and says how it went.
///
/// # Errors
/// When the SMTP server did not take it.
pub async fn test_mail(config: &SessionConfig) -> Result<String, MailError> {
    let relay = Relay::new(config)?;
    let letter = letterhead(config)?.test()?;
    let answer = relay.deliver(&letter).await?;
    Ok(format!("{} ({}) took a mail for {}: {answer}", relay.name(), relay.privacy(), letter.to.bare()))
}

fn letterhead(config: &SessionConfig) -> Result<Letterhead, MailError> {
    Letterhead::new(config).ok_or(MailError::Off("administrator or mailSender"))
}

impl Mailer {
    /// A mailer as the configuration says.
    ///
    /// # Errors
    /// When the configuration is not for mails.
    pub fn new(config: &SessionConfig) -> Result<Self, MailError> {
        let timing = &config.timing;
        let persistence = Persistence { retry: timing.mail_retry, patience: timing.mail_patience, most: MOST_ENTRIES };
        let pace = Pace { gather: timing.gather, flapping: timing.flapping, persistence };
        let (notices, outbox) = pace.fresh();
        let (relay, letterhead) = (Relay::new(config)?, letterhead(config)?);
        Ok(Self { relay, letterhead, pace, notices, outbox, sending: false, alarm: None })
    }

    /// Sends what is due, and sets the alarm for what is due later.
    fn step(&mut self, ctx: &mut Context<Self>) {
        let now = Instant::now();
        let dropped = self.outbox.put(self.notices.take(now));
        if dropped > 0 {
            log::warn!("{dropped} notices dropped: {MOST_ENTRIES} others wait for {}", self.relay.name());
        }
        if !self.sending
            && let Some(batch) = self.outbox.take(now)
        {
            self.send(batch, ctx);
        }
        // While a mail is on its way, its end is the next time to look at the outbox.
        let retry = if self.sending { None } else { self.outbox.due(now) };
        self.wake_at(self.notices.due().into_iter().chain(retry).min(), now, ctx);
    }

    fn wake_at(&mut self, due: Option<Instant>, now: Instant, ctx: &mut Context<Self>) {
        if self.alarm.map(|(when, _)| when) == due {
            return;
        }
        if let Some((_, handle)) = self.alarm.take() {
            ctx.cancel_future(handle);
        }
        self.alarm = due.map(|due| {
            let handle = ctx.run_later(due.saturating_duration_since(now), |mailer, ctx| {
                mailer.alarm = None;
                mailer.step(ctx);
            });
            (due, handle)
        });
    }

    fn send(&mut self, batch: Batch, ctx: &mut Context<Self>) {
        self.sending = true;
        let letter = self.letterhead.tell(batch.entries());
        let relay = self.relay.clone();
        async move { relay.deliver(&letter?).await }
            .into_actor(self)
            .map(move |sent, mailer, ctx| {
                mailer.sending = false;
                mailer.settle(batch, sent);
                mailer.step(ctx);
            })
            .spawn(ctx);
    }

    /// Notes how a try went.
    fn settle(&mut self, batch: Batch, sent: Result<String, MailError>) {
        let told = in_words(batch.entries());
        let error = match sent {
            Ok(answer) => {
                log::info!("mail sent by {} ({told}): {answer}", self.relay.name());
                return self.outbox.succeeded();
            }
            Err(error) => error,
        };
        let failure = if error.is_lasting() { Failure::Lasting } else { Failure::Passing };
        let now = Instant::now();
        let count = batch.entries().count();
        let lost = self.outbox.failed(batch, failure, now);
        if !lost.is_empty() {
            let patience = self.pace.persistence.patience.as_secs_f64();
            log::error!("mail given up after {patience} s ({}): {error}", in_words(lost.iter()));
        }
        if lost.len() < count
            && let Some(next) = self.outbox.due(now)
        {
            let wait = next.saturating_duration_since(now).as_secs_f64();
            log::warn!("mail not sent, next try in {wait:.0} s ({told}): {error}");
        }
    }
}

/// The first few entries, for a log line.
fn in_words<'entries>(entries: impl Iterator<Item = &'entries Entry>) -> String {
    let mut entries = entries.map(|entry| format!("{} {}", entry.notice.server, entry.notice.event.words()));
    let words = entries.by_ref().take(3).collect::<Vec<_>>().join(", ");
    let more = entries.count();
    if more > 0 {
        return format!("{words} and {more} more");
    }
    words
}

impl Actor for Mailer {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.set_mailbox_capacity(MOST_AT_ONCE);
    }
}

impl Supervised for Mailer {
    fn restarting(&mut self, _: &mut Self::Context) {
        log::warn!("the mailer starts again: notices that were not mailed yet are lost");
        (self.notices, self.outbox) = self.pace.fresh();
        self.sending = false;
        self.alarm = None;
    }
}

impl Handler<Notice> for Mailer {
    type Result = ();

    fn handle(&mut self, notice: Notice, ctx: &mut Self::Context) {
        self.notices.add(notice, Instant::now());
        self.step(ctx);
    }
}
