//! scratch
#![allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::indexing_slicing, clippy::float_cmp)]
mod dispatch;
mod world;
use dispatch::*;
use world::*;
fn main() {
    let only: Vec<String> = std::env::args().skip(1).collect();
    let t = std::time::Instant::now();
    for servers in [5usize, 50, 500] {
        for sizes in [Sizes::Equal, Sizes::Mixed] {
            for arrivals in [Arrivals::Steady, Arrivals::Moment, Arrivals::Minute, Arrivals::TooMany, Arrivals::Crowd] {
                for sessions in [Sessions::Exponential, Sessions::Heavy] {
                    for refresh in [0.1, 1.0, 3.0, 10.0] {
                        let s = Scenario { arrivals, refresh, servers, sizes, sessions };
                        let name = format!("{servers:>3} {sizes:?} {arrivals:?} {sessions:?} {refresh}");
                        if !only.iter().all(|o| o.starts_with('-') || name.contains(o)) { continue; }
                        let seeds = match servers { 5 => 6, 50 => 3, _ => 1 };
                        print!("{name:34}");
                        for policy in 0..6 {
                            let mut m = Outcome::default();
                            for seed in 1..=seeds {
                                let o = match policy {
                                    0 => run(&s, seed, &mut Own::new(servers, true)),
                                    1 => run(&s, seed, &mut Own::new(servers, false)),
                                    2 => run(&s, seed, &mut Rival::new(servers, Rule::LeastReported, seed)),
                                    3 => run(&s, seed, &mut Rival::new(servers, Rule::Random, seed)),
                                    4 => run(&s, seed, &mut Rival::new(servers, Rule::TwoChoices, seed)),
                                    _ => run(&s, seed, &mut Rival::new(servers, Rule::RoundRobin, seed)),
                                };
                                m.highest += o.highest / seeds as f64; m.overload += o.overload / seeds as f64; m.refused += o.refused / seeds as f64;
                            }
                            print!(" |{:5.0} {:5.2} {:4.1}", m.highest, m.overload, m.refused);
                        }
                        println!();
                    }
                }
            }
        }
    }
    println!("{:?}", t.elapsed());
}
