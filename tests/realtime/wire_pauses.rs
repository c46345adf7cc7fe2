//! A run that is stopped for some milliseconds at full speed, at the rate of its shipped blueprint, and messages that
//! get lost: where the arm truly goes beside its straight line of the joints, and how the motion ends. pylibfranka
//! drives the emulated FR3 beside it. `make pauses` plays 25 of each; `DIMOS_WIRE_ARM=franka` only those of that arm.

use std::fmt::Write as _;
use std::time::Duration;

use crate::support::python::python_with;
use crate::support::wire::paused::Case;
use crate::support::wire::paused_peer::Peer;
use crate::support::wire::paused_run::{Bed, Figures, Gap};

/// The arms.
static CASES: [Case; 7] = [
    Case {
        name: "franka",
        rate: 1000.0,
        ends: [&[-1.0, -0.6, -0.8, -2.2, -0.8, 1.2, -1.0], &[1.0, 0.4, 0.8, -1.0, 0.8, 2.6, 1.0]],
        options: r#"{"model": "fr3"}"#,
        loses: true,
    },
    Case {
        name: "ur",
        rate: 250.0,
        ends: [&[-1.5, -1.4, 1.0, -1.5, -1.5, -1.5], &[1.5, -0.8, 1.9, 1.0, 0.5, 1.5]],
        options: "{}",
        loses: false,
    },
    Case {
        name: "xarm",
        rate: 100.0,
        ends: [&[-1.5, -0.6, -1.2, -1.5, 0.6, -1.5], &[1.5, 0.4, -0.4, 1.5, 1.6, 1.5]],
        options: "{}",
        loses: false,
    },
    Case {
        name: "piper",
        rate: 100.0,
        ends: [&[-1.5, 0.6, -1.6, -1.2, -0.8, -1.7], &[1.5, 1.6, -0.6, 1.2, 0.8, 1.7]],
        options: "{}",
        loses: true,
    },
    Case {
        name: "so101",
        rate: 100.0,
        ends: [&[-1.2, -1.0, -1.0, -1.0, -1.5], &[1.2, 1.0, 1.0, 1.0, 1.5]],
        options: "{}",
        loses: true,
    },
    Case {
        name: "yourarm",
        rate: 100.0,
        ends: [&[-1.5, -0.8, 0.2, -1.5, 0.2, -1.5], &[1.5, 0.4, 1.4, 1.5, 1.4, 1.5]],
        options: "{}",
        loses: false,
    },
    Case {
        name: "remote",
        rate: 100.0,
        ends: [&[-1.5, -0.8, 0.2, -1.5, 0.2, -1.5], &[1.5, 0.4, 1.4, 1.5, 1.4, 1.5]],
        options: "{}",
        loses: false,
    },
];

fn row(name: &str, gap: &str, figures: &Figures) -> String {
    let mut row = format!(
        "| {name} | {gap} | {} of {} | {:.2} | {:.2} | {:.2} |",
        figures.completed,
        figures.all,
        1e3 * figures.off,
        1e3 * figures.back,
        figures.ratio
    );
    if let Some(first) = figures.others.first() {
        let _ = write!(row, " else {first}");
    }
    row
}

/// Plays all gaps of an arm. Returns rows of the table, and what broke a rule.
fn play(case: &Case, pauses: &[u64], many: Option<usize>) -> (Vec<String>, Vec<String>) {
    let (mut table, mut failures, times) = (Vec::new(), Vec::new(), many.unwrap_or(1));
    let mut bed = Bed::new(case, 0.0);
    for ms in pauses {
        let figures = bed.play(Gap::Pause(Duration::from_millis(*ms)), times, &mut failures);
        table.push(row(case.name, &format!("{ms} ms"), &figures));
    }
    for share in [0.005, 0.02].into_iter().filter(|_| case.loses && many.is_some()) {
        let mut bed = Bed::new(case, if case.name == "franka" { share } else { 0.0 });
        let figures = bed.play(Gap::Loss(share), times, &mut failures);
        table.push(row(case.name, &format!("{} % lost", 100.0 * share), &figures));
    }
    (table, failures)
}

#[test]
fn pauses_on_the_wire_leave_arms_on_their_lines() {
    let many = std::env::var("DIMOS_WIRE_PAUSES").ok().and_then(|n| n.parse().ok());
    let pauses: &[u64] = if many.is_some() { &[2, 5, 8, 12, 19, 25, 50, 90] } else { &[5, 12, 50] };
    let times = many.unwrap_or(1);
    let only = std::env::var("DIMOS_WIRE_ARM").ok();
    let chosen = |case: &&Case| only.as_ref().is_none_or(|only| only == case.name);
    let (mut failures, mut table) = (Vec::new(), Vec::new());
    // Arms with a setpoint every 10 ms side by side; the others, which want theirs in time, alone.
    std::thread::scope(|scope| {
        let slow = CASES.iter().filter(chosen).filter(|case| case.rate <= 100.0);
        let threads: Vec<_> = slow.map(|case| scope.spawn(|| play(case, pauses, many))).collect();
        for (rows, found) in threads.into_iter().map(|thread| thread.join().unwrap()) {
            table.extend(rows);
            failures.extend(found);
        }
    });
    for case in CASES.iter().filter(chosen).filter(|case| case.rate > 100.0) {
        let (rows, found) = play(case, pauses, many);
        table.extend(rows);
        failures.extend(found);
    }
    if only.is_none_or(|only| only == "franka")
        && let Some(python) = python_with(&["pylibfranka"])
    {
        let mut peer = Peer::new(&python, &CASES[0]);
        for ms in pauses {
            let figures = peer.play(Duration::from_millis(*ms), times);
            table.push(row("pylibfranka", &format!("{ms} ms"), &figures));
        }
    }
    println!(
        "| arm | gap | completed | off its line [mm, mrad] | back [mrad] | of its planned time |\n|---|---|---|---|---|---|"
    );
    table.iter().for_each(|row| println!("{row}"));
    assert!(failures.is_empty(), "{} failures:\n{}", failures.len(), failures.join("\n"));
}
