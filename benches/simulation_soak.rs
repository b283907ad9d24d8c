//! Starts and stops simulations in a row, and compares the server before and after: processes, file descriptors,
//! ports, folders, threads and resident memory. Ends with exit code 1 if something grows.
//!
//! `cargo bench --bench simulation_soak [-- --starts N]`

#![allow(
    missing_docs,
    unreachable_pub,
    clippy::pedantic,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a measurement that fails ends with a panic"
)]

#[path = "../tests/simulation/soak.rs"]
mod soak;
#[path = "../tests/support/mod.rs"]
mod support;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let starts =
        arguments.iter().position(|one| one == "--starts").map_or(1000, |at| arguments[at + 1].parse().unwrap());
    let begin = std::time::Instant::now();
    let (before, after) = actix_rt::System::new().block_on(soak::soak(starts));
    println!("{starts} starts and stops in {:.0?}", begin.elapsed());
    println!("{:<24}{:>10}{:>10}", "", "before", "after");
    for ((name, before), (_, after)) in before.rows().iter().zip(after.rows()) {
        println!("{name:<24}{before:>10}{after:>10}");
    }
    let leaks = after.leaks_since(&before, starts);
    for leak in &leaks {
        println!("LEAK: {leak}");
    }
    std::process::exit(i32::from(!leaks.is_empty()));
}
