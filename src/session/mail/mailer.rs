//! Actor: sends notices to the administrator on one channel, by mail or by webhook.
//!
//! Created by the registry for each channel that is configured, again if it has panicked. It accepts [`Notice`]s.
//! [`Outbox`] decides what is sent, and when. One batch is sent at a time; nothing waits for it.

use std::time::Instant;

use actix::prelude::*;

use super::channel::Channel;
use super::notice_text::{NoticeText, signature, summary};
use super::outbox::{MailEntry, Notice, Outbox};
use crate::session::config::SessionConfig;
use crate::shared::run::Supervisor;

/// The actor.
pub struct Mailer {
    channel: Channel,
    signature: String,
    outbox: Outbox,
    sending: bool,
    /// The timer of the next batch.
    timer: SpawnHandle,
}

/// Starts a mailer for each channel that is configured.
pub fn start(config: &SessionConfig) -> Supervisor<&'static str, Mailer> {
    let mail = Channel::mail(config).inspect_err(|why| log::info!("{why}"));
    let channels: Vec<Channel> = mail.into_iter().chain(Channel::webhook(config)).collect();
    let names: Vec<&'static str> = channels.iter().map(Channel::name).collect();
    let (signature, outbox) = (signature(config), Outbox::new(&config.timing));
    let mut mailers = Supervisor::new("mailer of notices by", move |name| {
        let channel = channels.iter().find(|channel| channel.name() == *name)?.clone();
        let (signature, outbox, timer) = (signature.clone(), outbox.clone(), SpawnHandle::default());
        Some(Mailer { channel, signature, outbox, sending: false, timer }.start())
    });
    for name in names {
        mailers.add(name);
    }
    mailers
}

impl Mailer {
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
        let (channel, text) = (self.channel.clone(), NoticeText::new(&batch, &self.signature));
        async move { channel.deliver(text).await }
            .into_actor(self)
            .map(move |sent, mailer, ctx| {
                mailer.sending = false;
                mailer.handle_outcome(batch, sent);
                mailer.wait(ctx);
            })
            .spawn(ctx);
    }

    /// Reports the outcome of sending a batch to the outbox and the log.
    fn handle_outcome(&mut self, batch: Vec<MailEntry>, sent: Result<String, String>) {
        let (now, subject, channel) = (Instant::now(), summary(&batch), self.channel.name());
        let error = match sent {
            Ok(answer) => {
                log::info!("{channel} sent by {} ({subject}): {answer}", self.channel.server);
                return self.outbox.succeeded(&batch, now);
            }
            Err(error) => error,
        };
        let lost = self.outbox.failed(batch, now);
        if !lost.is_empty() {
            log::error!("{channel} given up ({}): {error}", summary(&lost));
        } else if let Some(next) = self.outbox.due() {
            let wait = next.saturating_duration_since(now).as_secs_f64();
            log::warn!("{channel} not sent, next try in {wait:.0} s ({subject}): {error}");
        }
    }
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
