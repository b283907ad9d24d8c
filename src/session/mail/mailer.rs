//! Actor: sends notices to the administrator on one channel, by mail or by webhook.
//!
//! Created by the registry, again if it has panicked; only if it is configured. It accepts [`Notice`]s.
//! [`Outbox`] decides what is sent, and when. One batch is sent at a time; nothing waits for it.

use std::time::{Duration, Instant};

use actix::prelude::*;

use super::channel::{Channel, Transport};
use super::notice_text::Composer;
use super::outbox::{MailEntry, Notice, Outbox};
use super::smtp::{MailError, SmtpRelay};
use super::webhook::Webhook;
use crate::session::config::SessionConfig;

/// The actor.
pub struct Mailer {
    channel: Channel,
    transport: Transport,
    composer: Composer,
    outbox: Outbox,
    patience: Duration,
    sending: bool,
    /// The timer of the next batch.
    timer: SpawnHandle,
}

/// Starts the mailer of a channel; `None` if it is not configured.
pub fn start(config: &SessionConfig, channel: Channel) -> Option<Addr<Mailer>> {
    let mailer = Mailer::new(config, channel).inspect_err(|why| {
        if channel == Channel::Mail {
            log::info!("{why}");
        }
    });
    Some(mailer.ok()?.start())
}

/// Sends a test e-mail now. Returns what the SMTP server answered.
///
/// # Errors
/// When e-mails are not configured, or the SMTP server did not take it.
pub async fn test_mail(config: &SessionConfig) -> Result<String, MailError> {
    let relay = SmtpRelay::new(config)?;
    let answer = relay.deliver(Composer::new(config).test()?).await?;
    Ok(format!("{}: {answer}", relay.description()))
}

/// Posts a test to the webhook now. Returns what was answered.
///
/// # Errors
/// When the configuration has no webhook, or it did not take it.
pub async fn test_webhook(config: &SessionConfig) -> Result<String, MailError> {
    let webhook = Webhook::new(config)?;
    let answer = webhook.deliver(&Composer::new(config).test()?.body).await?;
    Ok(format!("the webhook at {} took a test: {answer}", webhook.server()))
}

impl Mailer {
    fn new(config: &SessionConfig, channel: Channel) -> Result<Self, MailError> {
        Ok(Self {
            channel,
            transport: Transport::new(config, channel)?,
            composer: Composer::new(config),
            outbox: Outbox::new(&config.timing),
            patience: config.timing.mail_patience,
            sending: false,
            timer: SpawnHandle::default(),
        })
    }

    /// Sets the timer of the next e-mail. A new notice, or the end of the last e-mail, may change when it is due.
    fn wait(&mut self, ctx: &mut Context<Self>) {
        ctx.cancel_future(self.timer);
        if let (false, Some(due)) = (self.sending, self.outbox.due()) {
            self.timer = ctx.run_later(due.saturating_duration_since(Instant::now()), Self::send);
        }
    }

    fn send(&mut self, ctx: &mut Context<Self>) {
        let batch = self.outbox.take(Instant::now());
        if batch.is_empty() {
            return self.wait(ctx);
        }
        self.sending = true;
        let (transport, text) = (self.transport.clone(), self.composer.compose(&batch));
        async move { transport.deliver(text?).await }
            .into_actor(self)
            .map(move |sent, mailer, ctx| {
                mailer.sending = false;
                mailer.handle_outcome(batch, sent);
                mailer.wait(ctx);
            })
            .spawn(ctx);
    }

    /// Reports the outcome of sending a batch to the outbox and the log.
    fn handle_outcome(&mut self, batch: Vec<MailEntry>, sent: Result<String, MailError>) {
        let (now, subject, count) = (Instant::now(), in_words(&batch), batch.len());
        let channel = self.channel;
        let error = match sent {
            Ok(answer) => {
                log::info!("{channel} sent by {} ({subject}): {answer}", self.transport.server());
                return self.outbox.succeeded(&batch, now);
            }
            Err(error) => error,
        };
        let lost = self.outbox.failed(batch, error.is_permanent(), now);
        if !lost.is_empty() {
            log::error!("{channel} given up after {} s ({}): {error}", self.patience.as_secs_f64(), in_words(&lost));
        }
        if lost.len() < count
            && let Some(next) = self.outbox.due()
        {
            let wait = next.saturating_duration_since(now).as_secs_f64();
            log::warn!("{channel} not sent, next try in {wait:.0} s ({subject}): {error}");
        }
    }
}

/// The first few entries, for a log line.
fn in_words(entries: &[MailEntry]) -> String {
    let (shown, others) = entries.split_at(entries.len().min(3));
    let shown: Vec<_> =
        shown.iter().map(|MailEntry { notice, .. }| format!("{} {}", notice.server, notice.event.words())).collect();
    let more = if others.is_empty() { String::new() } else { format!(" and {} more", others.len()) };
    format!("{}{more}", shown.join(", "))
}

impl Actor for Mailer {
    type Context = Context<Self>;
}

impl Handler<Notice> for Mailer {
    type Result = ();

    fn handle(&mut self, notice: Notice, ctx: &mut Self::Context) {
        self.outbox.add(notice, Instant::now());
        self.wait(ctx);
    }
}
