//! Actor: mails notices to the administrator.
//!
//! Created by the app, and again by the registry if it has panicked; only if the configuration is for e-mails. It accepts
//! [`Notice`]s. [`Notices`] decides what is mailed, [`Outbox`] when. One e-mail is sent at a time; nobody waits for it.

use std::time::{Duration, Instant};

use actix::prelude::*;

use super::email::EmailComposer;
use super::mail_error::MailError;
use super::notices::{Entry, Notice, Notices};
use super::outbox::{Batch, Failure, Outbox, RetryPolicy};
use super::smtp::Relay;
use crate::session::config::SessionConfig;

/// How many entries may wait: both topics of every server of the largest fleet.
const MAX_WAITING: usize = 2_000;

/// How many notices may be sent to the mailer at once: all servers of the largest fleet.
const MAILBOX_CAPACITY: usize = 4_096;

/// The actor.
pub struct Mailer {
    relay: Relay,
    composer: EmailComposer,
    notices: Notices,
    outbox: Outbox,
    give_up_after: Duration,
    sending: bool,
    timer: Option<(Instant, SpawnHandle)>,
}

/// Starts the mailer; none if the configuration is not for e-mails.
#[must_use]
pub fn start(config: &SessionConfig) -> Option<Addr<Mailer>> {
    let mailer = Mailer::new(config).inspect_err(|why| log::info!("{why}")).ok()?;
    Some(mailer.start())
}

/// Sends a test e-mail now. Returns what the SMTP server answered.
///
/// # Errors
/// When the configuration is not for e-mails, or the SMTP server did not take it.
pub async fn test_mail(config: &SessionConfig) -> Result<String, MailError> {
    let relay = Relay::new(config)?;
    let composer = composer(config)?;
    let answer = relay.deliver(&composer.test()?).await?;
    Ok(format!("{} ({}) took a mail for {}: {answer}", relay.name(), relay.privacy(), composer.recipient()))
}

fn composer(config: &SessionConfig) -> Result<EmailComposer, MailError> {
    EmailComposer::new(config).ok_or(MailError::Off("administrator or mailSender"))
}

impl Mailer {
    fn new(config: &SessionConfig) -> Result<Self, MailError> {
        let timing = &config.timing;
        let give_up_after = timing.mail_patience;
        let policy = RetryPolicy { first_delay: timing.mail_retry, give_up_after, max_waiting: MAX_WAITING };
        Ok(Self {
            relay: Relay::new(config)?,
            composer: composer(config)?,
            notices: Notices::new(timing.gather, timing.flapping),
            outbox: Outbox::new(policy),
            give_up_after,
            sending: false,
            timer: None,
        })
    }

    /// Sends what is due, and sets the timer for what is due later.
    fn send_due(&mut self, ctx: &mut Context<Self>) {
        let now = Instant::now();
        let dropped = self.outbox.put(self.notices.take(now));
        if dropped > 0 {
            log::warn!("{dropped} notices dropped: {MAX_WAITING} others wait for {}", self.relay.name());
        }
        if !self.sending
            && let Some(batch) = self.outbox.take(now)
        {
            self.send(batch, ctx);
        }
        // While an e-mail is being sent, its end is the next time to look at the outbox.
        let retry = if self.sending { None } else { self.outbox.due(now) };
        self.set_timer(self.notices.due().into_iter().chain(retry).min(), now, ctx);
    }

    fn set_timer(&mut self, due: Option<Instant>, now: Instant, ctx: &mut Context<Self>) {
        if self.timer.map(|(when, _)| when) == due {
            return;
        }
        if let Some((_, handle)) = self.timer.take() {
            ctx.cancel_future(handle);
        }
        self.timer = due.map(|due| {
            let handle = ctx.run_later(due.saturating_duration_since(now), |mailer, ctx| {
                mailer.timer = None;
                mailer.send_due(ctx);
            });
            (due, handle)
        });
    }

    fn send(&mut self, batch: Batch, ctx: &mut Context<Self>) {
        self.sending = true;
        let message = self.composer.compose(batch.entries());
        let relay = self.relay.clone();
        async move { relay.deliver(&message?).await }
            .into_actor(self)
            .map(move |sent, mailer, ctx| {
                mailer.sending = false;
                mailer.handle_outcome(batch, sent);
                mailer.send_due(ctx);
            })
            .spawn(ctx);
    }

    /// Reports to the outbox and the log how sending a batch went.
    fn handle_outcome(&mut self, batch: Batch, sent: Result<String, MailError>) {
        let subject = in_words(batch.entries());
        let error = match sent {
            Ok(answer) => {
                log::info!("mail sent by {} ({subject}): {answer}", self.relay.name());
                return self.outbox.succeeded();
            }
            Err(error) => error,
        };
        let failure = if error.is_permanent() { Failure::Permanent } else { Failure::Transient };
        let now = Instant::now();
        let count = batch.entries().count();
        let lost = self.outbox.failed(batch, failure, now);
        if !lost.is_empty() {
            let seconds = self.give_up_after.as_secs_f64();
            log::error!("mail given up after {seconds} s ({}): {error}", in_words(lost.iter()));
        }
        if lost.len() < count
            && let Some(next) = self.outbox.due(now)
        {
            let wait = next.saturating_duration_since(now).as_secs_f64();
            log::warn!("mail not sent, next try in {wait:.0} s ({subject}): {error}");
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
        ctx.set_mailbox_capacity(MAILBOX_CAPACITY);
    }
}

impl Handler<Notice> for Mailer {
    type Result = ();

    fn handle(&mut self, notice: Notice, ctx: &mut Self::Context) {
        self.notices.add(notice, Instant::now());
        self.send_due(ctx);
    }
}
