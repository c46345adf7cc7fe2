//! The crates that others may use: their examples do what their READMEs say.

use std::path::PathBuf;
use std::process::{Command, Output};

use crate::support::crates::programs;
use crate::support::program::Home;
use crate::support::skip::skip;

/// Runs an example, if it was built.
fn example(home: &Home, name: &str, arguments: &[&str]) -> Option<Output> {
    let path: PathBuf = programs().join("examples").join(name);
    if !path.exists() {
        skip("examples (cargo build --workspace --examples)");
        return None;
    }
    Some(Command::new(path).args(arguments).current_dir(home.path()).output().unwrap())
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

#[test]
fn a_planner_plans_around_a_wall() {
    let home = Home::new();
    let Some(planned) = example(&home, "around_a_wall", &[]) else { return };
    assert!(text(&planned.stderr).contains("proven to keep 1"), "{}", text(&planned.stderr));
    let motion = text(&planned.stdout);
    let rows: Vec<Vec<f64>> =
        motion.lines().skip(1).map(|line| line.split(',').map(|n| n.parse().unwrap()).collect()).collect();
    assert!(rows.len() > 3 && rows.iter().all(|row| row.len() == 7), "{motion}");
    assert_eq!((rows[0][1], rows.last().unwrap()[1]), (-0.9, 0.9));
    assert!(rows.windows(2).all(|pair| pair[0][0] < pair[1][0]), "{motion}");
    assert_eq!(example(&home, "around_a_wall", &[]).unwrap().stdout, planned.stdout, "the same motion again");
}

#[test]
fn a_description_is_read_with_its_mistakes() {
    let home = Home::new();
    let arguments = ["builtin:yourarm", "flange", "0", "-0.3", "0.6", "0", "0.8", "0"];
    let Some(shown) = example(&home, "where_is_it", &arguments) else { return };
    let ours = home.dimos("model fk builtin:yourarm 0 -0.3 0.6 0 0.8 0 --link flange --json").with(0).json();
    let x = format!("xyz [{:.4}, ", ours["xyz"][0].as_f64().unwrap());
    assert!(text(&shown.stdout).contains(&x), "{}", text(&shown.stdout));
    home.write("bad.urdf", "<robot name='r'>\n  <link name='a'/>\n  <joint name='j' type='hinge'/>\n</robot>\n");
    let refused = example(&home, "where_is_it", &["bad.urdf", "a"]).unwrap();
    assert!(!refused.status.success() && text(&refused.stderr).contains("bad.urdf:3"), "{}", text(&refused.stderr));
}

#[test]
fn settings_show_every_mistake() {
    let home = Home::new();
    home.write("settings.yaml", "cameras:\n  - {name: front, rate: 300}\n  - {nam: back, rate: fast}\n");
    let Some(shown) = example(&home, "every_mistake", &["settings.yaml"]) else { return };
    let shown = text(&shown.stderr);
    for part in ["settings.yaml:2:25", "settings.yaml:3:6", "settings.yaml:3:23", "did you mean `name`?", "3 mistakes"]
    {
        assert!(shown.contains(part), "{part}: {shown}");
    }
}
