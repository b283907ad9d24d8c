//! Why simulations end: a small fixed set, for counters and tables.

/// Why a simulation has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndReason {
    /// Its client has left, or was disconnected.
    Left,
    /// Webots has exited by itself, without an error.
    Finished,
    /// It has reached the time limit.
    TimeLimit,
    /// It was paused for too long.
    Idle,
    /// The server was stopped.
    Stopped,
    /// The administrator has stopped it.
    Administrator,
    /// Its world could not be checked out.
    NoCheckout,
    /// Webots did not become ready.
    NoWebots,
    /// Webots was ready, and has ended with an error.
    Crashed,
    /// Webots sent no heartbeat.
    Hung,
    /// It has exceeded a limit of memory, disk or processes.
    Limit,
    /// An error of this server, its machine or its Docker.
    Fault,
}

impl EndReason {
    /// All of them.
    pub const ALL: [Self; 12] = [
        Self::Left,
        Self::Finished,
        Self::TimeLimit,
        Self::Idle,
        Self::Stopped,
        Self::Administrator,
        Self::NoCheckout,
        Self::NoWebots,
        Self::Crashed,
        Self::Hung,
        Self::Limit,
        Self::Fault,
    ];

    /// Its name in `/metrics` and in `simulations.csv`.
    pub fn label(self) -> &'static str {
        match self {
            Self::Left => "left",
            Self::Finished => "finished",
            Self::TimeLimit => "time_limit",
            Self::Idle => "idle",
            Self::Stopped => "stopped",
            Self::Administrator => "administrator",
            Self::NoCheckout => "no_checkout",
            Self::NoWebots => "no_webots",
            Self::Crashed => "crashed",
            Self::Hung => "hung",
            Self::Limit => "limit",
            Self::Fault => "fault",
        }
    }

    /// Its text on the monitor.
    pub fn words(self) -> &'static str {
        match self {
            Self::Left => "client gone",
            Self::Finished => "finished",
            Self::TimeLimit => "time limit",
            Self::Idle => "paused for too long",
            Self::Stopped => "server stopped",
            Self::Administrator => "stopped by the administrator",
            Self::NoCheckout => "no checkout",
            Self::NoWebots => "no start",
            Self::Crashed => "crashed",
            Self::Hung => "hung",
            Self::Limit => "limit exceeded",
            Self::Fault => "fault of this server",
        }
    }

    /// Whether its cause may have to be found, so that its output is kept for longer. A failed checkout has no output.
    pub fn is_abnormal(self) -> bool {
        matches!(self, Self::NoWebots | Self::Crashed | Self::Hung | Self::Limit | Self::Fault)
    }
}
