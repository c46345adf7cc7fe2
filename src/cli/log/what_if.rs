//! `dimos log what-if`: a log with a changed configuration.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::time::Instant;

use serde_json::json;

use super::progress;
use crate::blueprint::TaskTable;
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output::{self, Table, fixed, number};
use crate::replay::what_if::{Row, WhatIf, what_if};

/// Number of events that are printed.
const SHOWN: usize = 20;

/// Replays a log and prints the differences.
pub fn run(path: &Path, table: &TaskTable, set: &[(String, String)], to: Option<&Path>, json: bool) -> Result {
    let wrong = |to: &Path, e| {
        Failure::new(Exit::Failed, format!("cannot write {}: {e}", to.display())).hint("choose another file")
    };
    let file = to.map(|to| File::create_new(to).map_err(|e| wrong(to, e))).transpose()?;
    let mut rows = file.map(BufWriter::new);
    let mut failed = rows.as_mut().and_then(|rows| writeln!(rows, "tick,time,joint,logged,rerun").err());
    let began = Instant::now();
    let each = |row: Row<'_>| {
        if let (Some(rows), None) = (&mut rows, &failed) {
            let cell = |value: f64| if value.is_finite() { format!("{value:?}") } else { String::new() };
            let (logged, rerun) = (cell(row.logged), cell(row.rerun));
            failed = writeln!(rows, "{},{:.9},{},{logged},{rerun}", row.tick, row.time, row.joint).err();
        }
    };
    let found = what_if(path, table, set, each, &mut progress::bar(false));
    let found = found.map_err(|e| Failure::of(Exit::Usage, e))?;
    let ratio = found.length / began.elapsed().as_secs_f64().max(1e-9);
    failed = failed.or_else(|| rows.and_then(|mut rows| rows.flush().err()));
    if let (Some(to), Some(e)) = (to, failed) {
        return Err(wrong(to, e));
    }
    if json {
        let mut data = serde_json::to_value(&found).unwrap_or_default();
        data["times_real_time"] = json!(ratio);
        output::json(&data);
    } else {
        print(&found, ratio);
    }
    if let Some(why) = &found.incomplete {
        output::note(format_args!("warning: {why}"));
        return Ok(Exit::DATA_LOST);
    }
    Ok(Exit::Ok)
}

fn print(found: &WhatIf, ratio: f64) {
    let WhatIf { ticks, different, length, .. } = found;
    let ran = format!("{ticks} ticks ({length:.3} s), {ratio:.0} times faster than real time");
    let Some(first) = &found.first else { return output::line(format_args!("no difference: {ran}")) };
    output::line(format_args!("{different} ticks differ: {ran}"));
    let of = first.joint.as_ref().or(first.arm.as_ref()).map_or_else(String::new, |of| format!(" of {of}"));
    output::line(format_args!("first at tick {}, after {:.3} s: {}{of}", first.tick, first.time, first.what));
    output::line(format_args!("  in the log: {}", first.logged));
    output::line(format_args!("  what if:    {}", first.rerun));
    if !found.joints.is_empty() {
        let mut table = Table::new(&["JOINT", ">TICKS", ">LARGEST", ">AT s", ">IN THE LOG", ">WHAT IF"]);
        for joint in &found.joints {
            let (logged, rerun) = (number(joint.logged, 4), number(joint.rerun, 4));
            let (largest, time) = (fixed(joint.largest, 4), fixed(joint.time, 3));
            table.row([joint.joint.clone(), joint.ticks.to_string(), largest, time, logged, rerun]);
        }
        table.print();
    }
    for event in found.events.iter().take(SHOWN) {
        let whose = if event.logged { "in the log" } else { "what if" };
        output::line(format_args!("{:10.3} s  {whose:10}  {}", event.time, event.text));
    }
    if found.events.len() > SHOWN {
        output::line(format_args!("{:14}and {} more events: --json", "", found.events.len() - SHOWN));
    }
}
