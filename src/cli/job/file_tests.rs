//! What the reader of jobs takes and refuses.

use super::*;

fn mistakes(text: &str) -> Vec<String> {
    let job = Job::parse("job.yaml".into(), text.as_bytes());
    let reports = job.tree.diags().iter().map(|diag| diag.located(&job.tree));
    let mut lines: Vec<_> = reports
        .map(|r| format!("{}:{}: {} | {}", r.line.unwrap(), r.column.unwrap(), r.message, r.hint.unwrap_or_default()))
        .collect();
    let at = |line: &String| line.splitn(3, ':').take(2).map(|n| n.parse::<u32>().unwrap()).collect::<Vec<_>>();
    lines.sort_by_key(at);
    lines
}

#[test]
fn every_mistake_is_reported_at_its_place() {
    let text = "\
repeet: 10
steps:
  - move: {joints: [1, x], speeed: 30%}
  - gripper: closed
  - wait: {input: do0}
  - wait: soon
  - mov: home
  - through: [home]
  - output: {do0: 2}
  - repeat: {times: 0, steps: [{move: }]}
  - move: {pose: {xyz: [1, 2]}, named: home}
  - move: {by: {xyz: [0, 0, 0]}, direct: true}
  - move: {joints: [0], linear: true}
  - [1]
  - move
";
    let found = mistakes(text);
    let expected = [
        "1:1: unknown key `repeet` | did you mean `repeat`?",
        "3:24: `x`: not a number",
        "3:28: unknown key `speeed` | did you mean `speed`?",
        "4:14: `closed`: not a number; give m or rad, `open` or `close`",
        "5:19: `do0`: must be a digital input",
        "6:11: `soon`: not a duration",
        "7:5: unknown step `mov` | did you mean `move`?",
        "8:14: needs two or more waypoints",
        "9:19: `2`: must be high or low",
        "10:21: `0`: must be a number of times",
        "10:",
        "11:11: needs one of named, joints, pose, by",
        "12:11: a direct motion needs `joints`",
        "13:25: `linear` needs a pose",
        "14:5: a step has one key",
        "15:5: `move` needs a value",
    ];
    for (found, expected) in found.iter().zip(expected) {
        assert!(found.starts_with(expected), "{found}\nexpected {expected}");
    }
    assert_eq!(found.len(), expected.len(), "{found:#?}");
}

#[test]
fn a_job_has_its_steps_with_their_lines() {
    let job = Job::parse(
        "pick.yaml".into(),
        b"speed: 30%\nrepeat: forever\non_fault: stop\nsteps:\n  - move: home\n  - repeat:\n      times: 2\n      steps:\n        - output: {do0: high, ao1: 2.5}\n  - reset\n",
    );
    assert!(!job.tree.has_errors());
    assert_eq!((job.repeat, job.on_fault.len(), job.count), (None, 0, 4));
    let Act::Move(motion) = &job.steps[0].act else { panic!("a motion") };
    assert_eq!((motion.speed, motion.goal.named.as_deref()), (0.3, Some("home")));
    let Act::Repeat { times: 2, steps } = &job.steps[1].act else { panic!("a loop") };
    let Act::Output(outputs) = &steps[0].act else { panic!("outputs") };
    assert_eq!(outputs, &BTreeMap::from([("do0".to_owned(), 1.0), ("ao1".to_owned(), 2.5)]));
    assert_eq!((steps[0].line, steps[0].text.as_str()), (9, "output: {do0: high, ao1: 2.5}"));
    assert_eq!((job.steps[2].line, job.steps[2].id), (10, 3));
}

#[test]
fn a_file_of_any_bytes_is_refused_and_never_a_panic() {
    for text in
        ["", "[]", "steps", "steps: 3", "steps: []", "a: b: c", "steps: [[[[]]]]", "steps: [{move: {}}]", "\u{0}"]
    {
        assert!(!mistakes(text).is_empty(), "{text:?}");
    }
    let deep = "steps: [".to_owned() + &"{repeat: {times: 1, steps: [".repeat(20) + "reset" + &"]}}".repeat(20) + "]";
    assert!(!mistakes(&deep).is_empty());
}
