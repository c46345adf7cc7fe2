//! `docs/verified.md` is generated from the reports of real arms in `docs/reports`. `DIMOS_REGENERATE=1 cargo test
//! --test logic verified` writes it.

use std::path::{Path, PathBuf};

use dimos::hardware::conformance::first_day::replay::replay;
use dimos::hardware::conformance::first_day::report::Report;

const INTRODUCTION: &str = "\
# Verified arms

What [the first day](first-day.md) at real arms has found. Emulated arms do not count: they are what the vendors'
documents say, and what we understood.

This page is generated from `docs/reports`. Regenerate it with `make verified`.

";
/// The figures of the table: step, and the beginning of the figure's name.
const FIGURES: [(&str, &str); 4] =
    [("gaps", "gap tolerance"), ("stops", "deceleration of a stop"), ("lag", "lag"), ("measured", "reported motion")];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn reports() -> Vec<PathBuf> {
    let files = std::fs::read_dir(root().join("docs/reports")).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = files.filter(|path| path.extension().is_some_and(|ending| ending == "day")).collect();
    files.sort();
    files
}

fn row(report: &Report) -> String {
    let figure = |(step, name): (&str, &str)| {
        let step = report.steps.iter().find(|made| made.step == step)?;
        let figure = step.figures.iter().find(|figure| figure.name.starts_with(name))?;
        Some(format!("{:.1} {}", figure.value, figure.unit))
    };
    let mut cells = vec![
        format!("{} {}", report.vendor, report.model),
        report.firmware.clone().unwrap_or_else(|| "not reported".into()),
        report.when.split('T').next().unwrap_or_default().to_owned(),
    ];
    cells.extend(FIGURES.map(|wanted| figure(wanted).unwrap_or_else(|| "-".into())));
    format!("| {} |\n", cells.join(" | "))
}

fn page(reports: &[Report]) -> String {
    let mut text = INTRODUCTION.to_owned();
    if reports.is_empty() {
        text += "No real arm has been driven yet.\n";
        return text;
    }
    text += "| arm | firmware | date | gap tolerance | deceleration of a stop | lag | a pushed joint |\n";
    text += "|---|---|---|---:|---:|---:|---:|\n";
    text.extend(reports.iter().map(row));
    text
}

fn read(path: &Path) -> Report {
    let report = Report::read_head(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    assert!(!report.simulated, "{}: the arm was emulated", path.display());
    report
}

#[test]
fn the_page_is_generated_from_the_reports() {
    let made = page(&reports().iter().map(|path| read(path)).collect::<Vec<_>>());
    let path = root().join("docs/verified.md");
    if std::env::var_os("DIMOS_REGENERATE").is_some() {
        std::fs::write(&path, &made).unwrap();
    }
    assert_eq!(std::fs::read_to_string(&path).unwrap_or_default(), made, "make verified");
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let words = readme.split_whitespace().collect::<Vec<_>>().join(" ");
    let none = words.contains("no real arm has been driven yet");
    assert_eq!(none, reports().is_empty(), "README.md says whether a real arm has been driven");
}

/// What an arm did becomes a test.
#[test]
fn the_emulators_do_what_the_arms_of_the_reports_did() {
    let registry = dimos::arms::registry();
    for path in reports() {
        let (report, chunks) = Report::read(&path).unwrap();
        let arm = registry.get(&report.adapter).unwrap();
        let comparison = replay(&report, &chunks, arm, &mut |_| {}, &|| false).unwrap();
        assert!(comparison.same(), "{}: {comparison:#?}", path.display());
    }
}

/// The generator itself, with a report that no arm has made.
#[test]
fn a_report_becomes_a_row() {
    let report = r#"{"format": "dimos first day", "version": 1, "dimos": "0", "when": "2026-03-04T10:00:00Z", "adapter": "ur",
        "simulated": false, "vendor": "Universal Robots", "model": "UR5e", "dof": 6, "firmware": "5.11.1", "options": {},
        "pose": [], "connections": [], "cut": false, "steps": [{"step": "gaps", "outcome": "measured", "detail": "",
        "time": [0, 1], "figures": [{"name": "gap tolerance", "value": 19.96, "unit": "ms"}]}]}"#;
    let page = page(&[serde_json::from_str(report).unwrap()]);
    assert!(page.ends_with("| Universal Robots UR5e | 5.11.1 | 2026-03-04 | 20.0 ms | - | - | - |\n"), "{page}");
}
