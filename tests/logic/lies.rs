//! The coordinator between true arms and lying readings, and between true arms and honest ones, in virtual time: what
//! no true joint, no setpoint and no stop may ever do, whatever an arm says. Each case is a seed:
//! `DIMOS_LIE=123 cargo test --test logic lies::one -- --nocapture` shows every tick of it, `DIMOS_LIE=h123` of an
//! honest one. `make lies` runs a million.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::support::arm_rows::rows;
use crate::support::lies::KINDS;
use crate::support::motion_judge::{RULES, Rule, Violation};
use crate::support::recorded::{piper_move, ur3e};
use crate::support::shared::shared;
use crate::support::trial::Trial;
use crate::support::trial_script::{trial, trial_with};
use crate::support::trial_setup::kind_of;

/// Cases of each test.
const CASES: u64 = 500;
/// Cases of each rule that are printed in full.
const SHOWN: u64 = 4;

/// What was found, by case.
#[derive(Default)]
struct Findings {
    cases: u64,
    /// By row and kind: cases, and cases that broke a rule.
    table: BTreeMap<(usize, String), (u64, u64)>,
    /// By rule: cases, the worst, and its seed.
    worst: BTreeMap<Rule, (u64, f64, u64)>,
    shown: Vec<String>,
}

impl Findings {
    fn add(&mut self, seed: u64, honest: bool, found: &[Violation]) {
        let (row, kind) = kind_of(seed);
        let kind = if honest { "Honest".to_owned() } else { format!("{kind:?}") };
        self.cases += 1;
        let cell = self.table.entry((row, kind.clone())).or_default();
        *cell = (cell.0 + 1, cell.1 + u64::from(!found.is_empty()));
        for v in found {
            let worst = self.worst.entry(v.rule).or_insert((0, f64::NEG_INFINITY, seed));
            worst.0 += 1;
            if v.excess > worst.1 {
                (worst.1, worst.2) = (v.excess, seed);
            }
            if worst.0 <= SHOWN {
                self.shown.push(format!(
                    "DIMOS_LIE={}{seed} {} {kind}, rule {}, {:.3} s, joint {}: {} (excess {:.3e})",
                    if honest { "h" } else { "" },
                    rows()[row].name,
                    v.rule.name(),
                    v.at,
                    v.joint,
                    v.text,
                    v.excess
                ));
            }
        }
    }

    fn broken(&self) -> u64 {
        self.table.values().map(|(_, broken)| broken).sum()
    }

    /// Rows × kinds × number of cases that broke a rule; the worst of each rule.
    fn print(&self) {
        let kinds: Vec<String> = KINDS.iter().map(|kind| format!("{kind:?}")).chain(["Honest".to_owned()]).collect();
        let kinds: Vec<&String> = kinds.iter().filter(|k| self.table.keys().any(|(_, kind)| kind == *k)).collect();
        print!("{:16}", "cases broken");
        kinds.iter().for_each(|kind| print!("{:>8}", &kind[..kind.len().min(7)]));
        println!();
        for (i, row) in rows().iter().enumerate() {
            print!("{:16}", format!("{} {}", row.name, row.arm.dof));
            for kind in &kinds {
                print!("{:>8}", self.table.get(&(i, (*kind).clone())).map_or(0, |(_, broken)| *broken));
            }
            println!();
        }
        for rule in RULES {
            if let Some((cases, worst, seed)) = self.worst.get(&rule) {
                println!("rule {:12} {cases:8} cases, worst excess {worst:.3e} (seed {seed})", rule.name());
            }
        }
        println!("{} of {} cases broke a rule", self.broken(), self.cases);
    }

    #[track_caller]
    fn assert_none(&self) {
        self.print();
        self.shown.iter().for_each(|text| println!("{text}"));
        assert_eq!(self.broken(), 0, "cases of {} broke a rule", self.cases);
    }
}

fn judge(from: u64, honest: bool) {
    if std::env::var_os("DIMOS_LIES").is_some() {
        return;
    }
    let mut findings = Findings::default();
    for seed in from..from + CASES {
        findings.add(seed, honest, &trial(seed, honest, false));
    }
    findings.assert_none();
}

#[test]
fn lies_move_no_arm_part_1() {
    judge(0, false);
}

#[test]
fn lies_move_no_arm_part_2() {
    judge(CASES, false);
}

#[test]
fn lies_move_no_arm_part_3() {
    judge(2 * CASES, false);
}

#[test]
fn lies_move_no_arm_part_4() {
    judge(3 * CASES, false);
}

#[test]
fn honest_arms_are_not_held_part_1() {
    judge(0, true);
}

#[test]
fn honest_arms_are_not_held_part_2() {
    judge(CASES, true);
}

#[test]
fn honest_arms_are_not_held_part_3() {
    judge(2 * CASES, true);
}

#[test]
fn honest_arms_are_not_held_part_4() {
    judge(3 * CASES, true);
}

/// What recorded arms' readings did beside their targets, over honest arms of their rows.
#[test]
fn recorded_arms_are_not_held() {
    let Some(folder) = shared("recordings") else { return };
    let mut findings = Findings::default();
    for (name, (period, rows)) in [("piper", piper_move(&folder)), ("ur", ur3e(&folder))] {
        for seed in (0..40 * CASES).filter(|seed| self::rows()[kind_of(*seed).0].name == name).take(100) {
            let recorded = |trial: &mut Trial| trial.recorded = Some((period, rows.clone()));
            findings.add(seed, true, &trial_with(seed, true, false, recorded));
        }
    }
    findings.assert_none();
}

/// `DIMOS_LIES=1000000`: this many lies and as many honest cases, on all processors.
#[test]
fn as_many_as_are_asked_for() {
    let Some(cases) = std::env::var("DIMOS_LIES").ok().and_then(|n| n.parse::<u64>().ok()) else { return };
    let (next, findings) = (AtomicU64::new(0), Mutex::new([Findings::default(), Findings::default()]));
    std::panic::set_hook(Box::new(|_| {}));
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(2, usize::from) {
            scope.spawn(|| {
                loop {
                    let case = next.fetch_add(1, Ordering::Relaxed);
                    if case >= 2 * cases {
                        break;
                    }
                    let (seed, honest) = (case / 2, case % 2 == 1);
                    let found = trial(seed, honest, false);
                    findings.lock().unwrap()[usize::from(honest)].add(seed, honest, &found);
                    if (case + 1).is_multiple_of((2 * cases / 20).max(1)) {
                        println!("{} of {} cases", case + 1, 2 * cases);
                    }
                }
            });
        }
    });
    let _ = std::panic::take_hook();
    let findings = findings.into_inner().unwrap();
    findings.iter().for_each(Findings::print);
    findings.iter().flat_map(|all| &all.shown).for_each(|text| println!("{text}"));
    assert_eq!(findings.iter().map(Findings::broken).sum::<u64>(), 0, "cases broke a rule");
}

/// Shows every tick of the case `DIMOS_LIE`.
#[test]
fn one() {
    let Ok(case) = std::env::var("DIMOS_LIE") else { return };
    let honest = case.starts_with('h');
    let seed = case.trim_start_matches('h').parse().expect("DIMOS_LIE is a number, or h and a number");
    let mut findings = Findings::default();
    findings.add(seed, honest, &trial(seed, honest, true));
    findings.assert_none();
}
