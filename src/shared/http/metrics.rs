//! Counters and gauges in Prometheus' text format.

use prometheus::{Encoder, GaugeVec, Histogram, HistogramOpts, IntCounterVec, Opts, Registry, TextEncoder};

/// The metrics of one server.
///
/// Counters live as long as the server; gauges are set from its state on each request.
#[derive(Debug, Clone, Default)]
pub struct Metrics {
    counters: Registry,
}

/// The media type of [`Metrics::render`].
pub const CONTENT_TYPE: &str = prometheus::TEXT_FORMAT;

/// A gauge with its help text and its values, each with the values of its labels.
#[derive(Debug)]
pub struct Gauge<'text> {
    /// The metric's name; unique in a server.
    pub name: &'text str,
    /// Its help text, with its unit.
    pub help: &'text str,
    /// The names of its labels.
    pub labels: &'text [&'text str],
    /// Each value, after the values of its labels.
    pub values: Vec<(Vec<String>, f64)>,
}

impl<'text> Gauge<'text> {
    /// A gauge without labels.
    pub fn plain(name: &'text str, help: &'text str, value: f64) -> Self {
        Self {
            name,
            help,
            labels: &[],
            values: vec![(Vec::new(), value)],
        }
    }
}

impl Metrics {
    /// Adds a counter with one label.
    ///
    /// # Errors
    /// When the name is not a valid metric name, or is taken.
    pub fn counter(&self, name: &str, help: &str, label: &str) -> Result<IntCounterVec, prometheus::Error> {
        let counter = IntCounterVec::new(Opts::new(name, help), &[label])?;
        self.counters.register(Box::new(counter.clone()))?;
        Ok(counter)
    }

    /// Adds a histogram with these upper bounds.
    ///
    /// # Errors
    /// When the name is not a valid metric name, or is taken.
    pub fn histogram(&self, name: &str, help: &str, bounds: &[f64]) -> Result<Histogram, prometheus::Error> {
        let histogram = Histogram::with_opts(HistogramOpts::new(name, help).buckets(bounds.to_vec()))?;
        self.counters.register(Box::new(histogram.clone()))?;
        Ok(histogram)
    }

    /// Writes the counters and these gauges.
    ///
    /// # Errors
    /// When a gauge's name or a label is not valid.
    pub fn render(&self, gauges: &[Gauge<'_>]) -> Result<Vec<u8>, prometheus::Error> {
        let registry = Registry::new();
        for gauge in gauges {
            let family = GaugeVec::new(Opts::new(gauge.name, gauge.help), gauge.labels)?;
            for (labels, value) in &gauge.values {
                let labels: Vec<&str> = labels.iter().map(String::as_str).collect();
                family.get_metric_with_label_values(&labels)?.set(*value);
            }
            registry.register(Box::new(family))?;
        }
        let mut families = self.counters.gather();
        families.extend(registry.gather());
        let mut text = Vec::new();
        TextEncoder::new().encode(&families, &mut text)?;
        Ok(text)
    }
}
