//! Task: sends notices to the administrator on one channel, by mail or by webhook.
//!
//! Started with the registry for each channel that is configured; restarted after a panic. It receives [`Notice`]s.
//! [`Outbox`] decides what is sent, and when. One batch is sent at a time; notices that arrive meanwhile are queued.

use std::time::Instant;

use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::time::sleep_until;

use super::channel::Channel;
use super::notice_text::{notice_text, signature, summary};
use super::outbox::{Notice, Outbox, WaitingNotice};
use crate::session::config::SessionConfig;
use crate::shared::run::permanent;

/// Starts a mailer for each channel that is configured. Returns the senders for their notices.
pub fn start(config: &SessionConfig) -> Vec<UnboundedSender<Notice>> {
    let mail = Channel::mail(config).inspect_err(|why| log::info!("{why}"));
    let signature = signature(config);
    let timing = config.timing.clone();
    let start = |channel: Channel| {
        let (sender, mut notices) = unbounded_channel();
        let signature = signature.clone();
        let timing = timing.clone();
        actix_rt::spawn(async move {
            let name = format!("mailer of notices by {}", channel.name);
            let send = async || send_all(&channel, &signature, Outbox::new(&timing), &mut notices).await;
            permanent::restarted(&name, send).await;
        });
        sender
    };
    mail.into_iter().chain(Channel::webhook(config)).map(start).collect()
}

/// Sends the notices that arrive, until the server ends.
async fn send_all(channel: &Channel, signature: &str, mut outbox: Outbox, notices: &mut UnboundedReceiver<Notice>) {
    loop {
        let due = outbox.due();
        tokio::select! {
            notice = notices.recv() => match notice {
                Some(notice) => outbox.add(notice, Instant::now()),
                None => return,
            },
            () = sleep_until(due.unwrap_or_else(Instant::now).into()), if due.is_some() => {
                let batch = outbox.take(Instant::now());
                let sent = channel.deliver(&notice_text(&batch, signature)).await;
                handle_outcome(channel, &mut outbox, batch, sent);
            }
        }
    }
}

/// Reports the outcome of sending a batch to the outbox and the log.
fn handle_outcome(channel: &Channel, outbox: &mut Outbox, batch: Vec<WaitingNotice>, sent: Result<String, String>) {
    let now = Instant::now();
    let subject = summary(&batch);
    let name = channel.name;
    match sent {
        Ok(answer) => {
            log::info!("{name} sent by {} ({subject}): {answer}", channel.server);
            outbox.succeeded(&batch, now);
        }
        Err(error) => {
            let lost = outbox.failed(batch, now);
            if lost.is_empty() {
                log::warn!("{name} not sent, it is tried again ({subject}): {error}");
            } else {
                log::error!("{name} given up ({}): {error}", summary(&lost));
            }
        }
    }
}
