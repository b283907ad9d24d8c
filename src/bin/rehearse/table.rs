//! The numbers of a rehearsal as text for users. Pure.

use std::collections::BTreeMap;
use std::fmt;

use crate::line::Line;
use crate::real_time_factors::RealTimeFactors;
use crate::report::Report;

/// All tables, and the verdict below them.
pub(crate) fn text(report: &Report) -> String {
    let mut parts = vec![format!(
        "Rehearsal of {}: {}\n{}",
        report.fleet, report.played, report.world
    )];
    parts.push(seats(report));
    if !report.times.is_empty() {
        parts.push(times(report));
    }
    if let Some(line) = &report.line {
        parts.push(self::line(line));
    }
    if !report.servers.is_empty() {
        parts.push(servers(report));
    }
    let mut verdict = report.verdict.clone();
    if let Some(expected) = report.expected {
        let met = if report.is_as_expected() {
            "as expected"
        } else {
            "NOT as expected"
        };
        verdict = format!("{verdict} {expected} had to: {met}.");
    }
    parts.push(verdict);
    parts.join("\n\n")
}

fn seats(report: &Report) -> String {
    let seats = &report.seats;
    let mut table = Table::new(&["Seats", ""]);
    let mut add = |what: &str, number: u32| table.add(vec![what.to_owned(), number.to_string()]);
    add("asked for", seats.asked);
    add("given", seats.given);
    add("of these fit: to the end, in real time", seats.fit);
    for (why, number) in reasons(&seats.refused) {
        add(&format!("refused: {why}"), *number);
    }
    for (why, number) in reasons(&seats.broke_off) {
        add(&format!("broke off: {why}"), *number);
    }
    if seats.unseen > 0 {
        add("ran, their end unseen", seats.unseen);
    }
    if seats.unmeasured > 0 {
        add("ran, too briefly to tell their pace", seats.unmeasured);
    }
    if seats.left > 0 {
        add("left before it ran", seats.left);
    }
    table.to_string()
}

fn reasons(reasons: &BTreeMap<String, u32>) -> impl Iterator<Item = (&String, &u32)> {
    let mut all: Vec<(&String, &u32)> = reasons.iter().collect();
    all.sort_by(|one, other| other.1.cmp(one.1));
    all.into_iter()
}

fn times(report: &Report) -> String {
    let mut table = Table::new(&["Until it runs", "median", "95 %", "worst"]);
    for row in &report.times {
        let seconds = [row.median, row.p95, row.worst].map(|time| format!("{time:.1} s"));
        table.add(std::iter::once(row.step.to_owned()).chain(seconds).collect::<Vec<_>>());
    }
    table.to_string()
}

fn line(line: &Line) -> String {
    let mut table = Table::new(&["Those who waited", ""]);
    let mut add = |what: &str, found: String| table.add(vec![what.to_owned(), found]);
    add("clients", line.waited.to_string());
    if let Some(longest) = line.longest {
        add("most ahead of one when it came", longest.to_string());
    }
    add("overtakings", line.overtakings.to_string());
    add("most overtakings of one", line.most_overtaken.to_string());
    let (idle, percent) = (line.idle, 100.0 * line.idle_share);
    add(
        "slots free meanwhile, all together",
        format!("{idle:.1} s, {percent:.1} %"),
    );
    let (median, worst) = (line.idle_median, line.idle_worst);
    add("a slot that became free, median", format!("{median:.3} s"));
    add("a slot that became free, worst", format!("{worst:.3} s"));
    table.to_string()
}

fn servers(report: &Report) -> String {
    let mut table = Table::new(&[
        "Simulation server",
        "seats",
        "at once",
        "peak load",
        "real time, 5 %",
        "median",
    ]);
    for server in &report.servers {
        let load = server
            .peak_load
            .map_or_else(|| "-".to_owned(), |load| format!("{load:.0} %"));
        let [p5, median] = pace(server.pace);
        table.add(vec![
            server.address.clone(),
            server.seats.to_string(),
            server.most_at_once.to_string(),
            load,
            p5,
            median,
        ]);
    }
    if report.servers.len() > 1 {
        let [p5, median] = pace(report.pace);
        let given = report.seats.given.to_string();
        table.add(vec!["all".to_owned(), given, String::new(), String::new(), p5, median]);
    }
    table.to_string()
}

fn pace(factors: Option<RealTimeFactors>) -> [String; 2] {
    factors.map_or_else(
        || ["-".to_owned(), "-".to_owned()],
        |all| [all.p5, all.median].map(|one| format!("{one:.2}")),
    )
}

/// A table in Markdown whose columns are aligned: texts in the first, numbers in the others.
struct Table {
    header: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    fn new(header: &[&str]) -> Self {
        Self {
            header: header.iter().map(|title| (*title).to_owned()).collect(),
            rows: Vec::new(),
        }
    }

    fn add(&mut self, row: Vec<String>) {
        self.rows.push(row);
    }
}

impl fmt::Display for Table {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let all = || std::iter::once(&self.header).chain(&self.rows);
        let width = |column: usize| {
            all()
                .filter_map(|row| row.get(column))
                .map(|cell: &String| cell.chars().count())
                .max()
        };
        let widths: Vec<usize> = (0..self.header.len())
            .map(|column| width(column).unwrap_or(0))
            .collect();
        for (number, row) in all().enumerate() {
            if number > 0 {
                writeln!(out)?;
            }
            for (column, (cell, width)) in row.iter().zip(&widths).enumerate() {
                if column == 0 {
                    write!(out, "| {cell:<width$} |")?;
                } else {
                    write!(out, " {cell:>width$} |")?;
                }
            }
            if number == 0 {
                let lines: Vec<String> = widths.iter().map(|width| "-".repeat(width + 2)).collect();
                write!(out, "\n|{}|", lines.join("|"))?;
            }
        }
        Ok(())
    }
}
