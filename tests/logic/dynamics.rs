//! Efforts, gravity and mass matrices of all descriptions at hand; Pinocchio is the judge. Nothing allocates.

use std::path::{Path, PathBuf};

use dimos::robot::builtin;
use dimos::robot::dynamics::{Dynamics, GRAVITY};
use dimos::robot::kinematics::Kinematics;
use dimos::robot::model::RobotModel;
use dimos::robot::random::Random;
use dimos::robot::urdf::from_text;
use serde_json::{Value, json};

use crate::support::python::ask_python;
use crate::support::shared::shared;

/// Configurations of each robot.
const EACH: usize = 4;
/// Largest difference of an effort from the judge's, per effort above 1.
const TOLERANCE: f64 = 1e-9;

fn descriptions() -> Option<Vec<(String, String)>> {
    let mut files = Vec::new();
    for folder in ["models", "xacro"] {
        collect(&shared(folder)?, &mut files);
    }
    // Robots of PyPI's example-robot-data, where it is installed.
    let venv = Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv/lib");
    for python in std::fs::read_dir(venv).into_iter().flatten().flatten() {
        collect(&python.path().join("site-packages/cmeel.prefix/share/example-robot-data/robots"), &mut files);
    }
    files.sort();
    let texts = files.iter().filter_map(|file| Some((file.display().to_string(), std::fs::read_to_string(file).ok()?)));
    let own = builtin::names().map(|name| (format!("builtin:{name}"), builtin::text(name).unwrap().to_owned()));
    Some(texts.chain(own).collect())
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            collect(&path, files);
        } else if path.extension().is_some_and(|extension| extension == "urdf") {
            files.push(path);
        }
    }
}

/// A robot at one configuration, and what is computed for it.
struct Case {
    name: String,
    effort: Vec<f64>,
    gravity: Vec<f64>,
    mass: Vec<f64>,
}

fn ask(name: &str, text: &str, model: &RobotModel, random: &mut Random) -> Option<Vec<(Case, Value)>> {
    let kinematics = Kinematics::whole(model).ok()?;
    let dof = kinematics.dof();
    if dof == 0 {
        return None;
    }
    let limits = kinematics.limits().to_vec();
    let mut dynamics = Dynamics::new(model, kinematics);
    let mimic: Vec<Value> = model
        .joints
        .iter()
        .filter_map(|joint| {
            let mimic = joint.mimic.filter(|_| joint.is_movable())?;
            Some(json!([joint.name, model.joints[mimic.leader].name, mimic.multiplier, mimic.offset]))
        })
        .collect();
    let mut cases = Vec::new();
    for k in 0..EACH {
        let gravity = if k == 0 { GRAVITY } else { [0; 3].map(|_| random.between(-9.0, 9.0)) };
        dynamics.set_gravity(gravity);
        let q: Vec<f64> = limits.iter().map(|l| random.between(l.lower.max(-3.0), l.upper.min(3.0))).collect();
        let [qd, qdd] = [2.0, 5.0].map(|most| (0..dof).map(|_| random.between(-most, most)).collect::<Vec<f64>>());
        let (mut effort, mut still, mut mass) = (vec![0.0; dof], vec![0.0; dof], vec![0.0; dof * dof]);
        let before = dimos::rt::counting::allocations();
        dynamics.inverse(&q, &qd, &qdd, &mut effort);
        dynamics.gravity(&q, &mut still);
        dynamics.mass_matrix(&q, &mut mass);
        assert_eq!(dimos::rt::counting::allocations(), before, "{name}: it allocates");
        let question = json!({"urdf": text, "joints": dynamics.names(), "mimic": mimic, "q": q, "qd": qd, "qdd": qdd,
            "gravity": gravity});
        cases.push((Case { name: name.to_owned(), effort, gravity: still, mass }, question));
    }
    Some(cases)
}

#[test]
fn dynamics_are_pinocchios() {
    let Some(descriptions) = descriptions() else { return };
    let mut random = Random::new(41);
    let (mut cases, mut questions) = (Vec::new(), Vec::new());
    for (name, text) in &descriptions {
        let Ok(model) = from_text("robot", text) else { continue };
        for (case, question) in ask(name, text, &model, &mut random).into_iter().flatten() {
            cases.push(case);
            questions.push(question);
        }
    }
    let Some(answers) = ask_python("dynamics.py", "pinocchio", &json!(questions)) else { return };
    let (mut compared, mut refused) = (Vec::new(), Vec::new());
    for (case, answer) in cases.iter().zip(answers.as_array().unwrap()) {
        if let Some(why) = answer.get("refused") {
            refused.push(format!("{}: {why}", case.name));
            continue;
        }
        let flat = |key: &str| -> Vec<f64> {
            let mut values = Vec::new();
            let mut add = |value: &Value| values.extend(value.as_array().unwrap().iter().filter_map(Value::as_f64));
            match answer[key][0].is_array() {
                true => answer[key].as_array().unwrap().iter().for_each(&mut add),
                false => add(&answer[key]),
            }
            values
        };
        for (key, own) in [("effort", &case.effort), ("gravity", &case.gravity), ("mass_matrix", &case.mass)] {
            let theirs = flat(key);
            assert_eq!(own.len(), theirs.len(), "{} {key}", case.name);
            for (own, theirs) in own.iter().zip(theirs) {
                let apart = (own - theirs).abs() / theirs.abs().max(1.0);
                assert!(apart <= TOLERANCE, "{} {key}: {own} instead of {theirs}", case.name);
            }
        }
        compared.push(&case.name);
    }
    compared.dedup();
    eprintln!("{} descriptions compared, {} refused by the judge: {refused:?}", compared.len(), refused.len() / EACH);
    assert!(compared.len() >= 50, "{} descriptions", compared.len());
}
