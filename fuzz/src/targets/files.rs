//! Files that people write: blueprints, calibrations, options, reports.

use dimos::arms::{self, so101};
use dimos::blueprint::{Found, Overrides, SearchPath, Source, load_from};
use dimos::hardware::conformance::first_day::report::Report;
use dimos::hardware::registry::AdapterConfig;

use crate::{Target, bug, file};

/// Blueprints.
pub const BLUEPRINT: Target = Target {
    name: "blueprint",
    about: "a blueprint, or errors with places",
    run: blueprint,
    seeds: || {
        ["coordinator-yourarm", "coordinator-dual-mock", "yourarm-planner", "ur5e-robotiq", "coordinator-so101"]
            .map(|name| file(&format!("blueprints/{name}.yaml")))
            .into_iter()
            .chain([file("tests/fixtures/blueprints/full.yaml")])
            .filter(|seed| !seed.is_empty())
            .collect()
    },
};

fn blueprint(data: &[u8]) {
    let found = Found { name: "fuzz".to_owned(), source: Source::Embedded, bytes: data.to_vec() };
    let search = SearchPath { folders: Vec::new() };
    let loaded = load_from(&search, &found, &Overrides::default(), &arms::registry());
    assert_eq!(loaded.blueprint.is_none(), loaded.errors() > 0, "a blueprint, or a reason why not");
    assert!(loaded.diagnostics().len() <= 100);
    loaded.render(false);
    for report in loaded.reports() {
        assert!(!report.message.is_empty() && report.line.is_some(), "no place: {}", report.message);
    }
    loaded.to_json();
    let Some(blueprint) = &loaded.blueprint else { return };
    bug(1, blueprint.arms.len() >= 3);
    bug(2, blueprint.tasks.iter().any(|task| task.joints.len() == 5));
    bug(3, blueprint.arms.iter().any(|arm| arm.address == "127.0.0.2"));
}

/// Calibrations of an SO-101.
pub const CALIBRATION: Target = Target {
    name: "calibration",
    about: "ranges of counts that can be used, or an error",
    run: calibration,
    seeds: || {
        let joint = |id: u8, offset: i32| serde_json::json!({"id": id, "drive_mode": 0, "homing_offset": offset, "range_min": 700 + offset, "range_max": 3400});
        let names = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"];
        let all = names.iter().enumerate().map(|(i, name)| ((*name).to_owned(), joint(i as u8 + 1, 7 * i as i32)));
        vec![serde_json::Value::Object(all.collect()).to_string().into_bytes()]
    },
};

fn calibration(data: &[u8]) {
    let folder = tempfile::tempdir_in(super::logs::memory()).expect("a folder");
    let path = folder.path().join("arm.json");
    std::fs::write(&path, data).expect("a file");
    let Ok(calibration) = so101::calibration::Calibration::load(&path, 1) else { return };
    for range in &calibration.0 {
        let (lower, upper) = range.angles();
        assert!(lower.is_finite() && upper.is_finite() && lower < upper, "{lower} to {upper} rad");
        bug(1, upper - lower < 0.1);
        bug(2, lower > 0.0);
        bug(3, upper - lower > 6.0);
    }
}

/// Options of every adapter.
pub const OPTIONS: Target = Target {
    name: "options",
    about: "limits that are finite and ordered, or an error; nothing is connected",
    run: options,
    seeds: || {
        [
            r#"0{"initial_positions": [0,0,0,0,0,0], "gripper": true}"#,
            r#"1{"sim": {"lag": 0.05, "droop": 0.01, "faults": [{"kind": "stall", "at": 1, "duration": 0.5}]}}"#,
            r#"2{"model": "xarm7", "tool_speed": 0.5}"#,
            r#"3{"model": "piper_h", "sim": {"gripper": false}}"#,
            r#"5{"model": "ur10e", "payload": {"mass": 1.0}}"#,
        ]
        .map(|text| text.as_bytes().to_vec())
        .into()
    },
};

fn options(data: &[u8]) {
    let Some((first, rest)) = data.split_first() else { return };
    let Ok(options) = serde_json::from_slice(rest) else { return };
    let registry = arms::registry();
    let row = registry.rows()[usize::from(first.wrapping_sub(b'0')) % registry.rows().len()];
    for dof in row.dof.0..=row.dof.1.min(row.dof.0 + 2) {
        let config = AdapterConfig {
            hardware_id: "arm".into(),
            address: String::new(),
            dof,
            options: serde_json::Value::clone(&options),
        };
        let Ok(checked) = (row.check)(&config) else { continue };
        let limits = checked.limits.with_defaults();
        let all = [&limits.position_lower, &limits.position_upper, &limits.velocity_max, &limits.acceleration_max];
        assert!(all.iter().all(|list| list.len() == dof && list.iter().all(|v| v.is_finite())), "{limits:?}");
        assert!(limits.position_lower.iter().zip(&limits.position_upper).all(|(low, high)| low <= high), "{limits:?}");
        bug(1, row.name == "xarm" && dof == 7 && options.get("model").is_some());
        bug(2, row.name == "piper" && options.pointer("/sim/gripper").is_some());
        bug(3, options.pointer("/sim/faults/0/kind").is_some_and(|kind| kind == "silent"));
    }
}

/// Reports of a first day.
pub const REPORT: Target = Target {
    name: "report",
    about: "a report, or an error, in bounded memory",
    run: report,
    seeds: || vec![b"{}".to_vec()],
};

fn report(data: &[u8]) {
    let folder = tempfile::tempdir_in(super::logs::memory()).expect("a folder");
    let path = folder.path().join("arm.report");
    // The engine cannot compress: a first byte says whether it is done for it.
    let bytes = match data.split_first() {
        Some((1, rest)) => rest.to_vec(),
        Some((_, rest)) => compressed(rest),
        None => return,
    };
    std::fs::write(&path, bytes).expect("a file");
    let head = Report::read_head(&path);
    if let Ok((report, chunks)) = Report::read(&path) {
        assert!(head.is_ok());
        assert!(chunks.iter().map(|chunk| chunk.bytes.len()).sum::<usize>() < 256 << 20);
        bug(1, report.dof == 6);
        bug(2, !chunks.is_empty());
        bug(3, report.connections.len() == 2);
    }
}

/// Frames of zstd that hold bytes as they are.
fn compressed(bytes: &[u8]) -> Vec<u8> {
    let mut out = vec![0x28, 0xB5, 0x2F, 0xFD, 0x00, 0x58];
    for (i, block) in bytes.chunks(64 << 10).enumerate() {
        let last = u32::from((i + 1) * (64 << 10) >= bytes.len());
        out.extend(&(last | (block.len() as u32) << 3).to_le_bytes()[..3]);
        out.extend(block);
    }
    if bytes.is_empty() {
        out.extend([1, 0, 0]);
    }
    out
}
