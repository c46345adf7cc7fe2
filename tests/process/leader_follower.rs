//! The shipped blueprint of a leader and a follower as a user runs it: two SO-101 on their emulators, of which the
//! leader has its motors off and is moved by hand.

use rustix::process::Signal;

use crate::support::program::{Home, eventually};

/// A hand moves the second joint of the leader after 5 s, in half a second.
const HAND: &str = "
name: hand
include: [leader-follower]
hardware:
  - hardware_id: leader
    options: {sim: {faults: [{at: 5, duration: 0.5, kind: pushed, joint: 2, amount: 0.7}]}}
";

/// The report of the follow task.
fn report(home: &Home) -> serde_json::Value {
    home.dimos("task invoke follow_leader state --json").with(0).json()
}

/// The largest distance of a joint of the follower from the leader's [rad].
fn apart(home: &Home) -> f64 {
    let (leader, follower) = (home.positions("leader"), home.positions("follower"));
    leader.iter().zip(follower).map(|(leader, follower)| (leader - follower).abs()).fold(0.0, f64::max)
}

#[test]
fn a_follower_goes_where_a_hand_moves_a_leader_without_power() {
    let home = Home::new();
    home.write("hand.yaml", HAND);
    let run = home.run("hand.yaml");
    let start = home.positions("leader");
    home.dimos("task invoke follow_leader start").with(0).shows(&["EXECUTING", "leader"]);
    home.dimos("task invoke follow_leader start").with(1).says(&["executing already"]);
    let moved = || (home.positions("leader")[1] - start[1]).abs() > 0.3;
    eventually("the hand has moved the leader", moved);
    eventually("the follower is in step with it", || {
        let task = report(&home);
        assert_eq!(task["state"], "EXECUTING", "{task}");
        let near = task["distance"].as_f64().is_some_and(|distance| distance < 0.03);
        near && task["reason"] == "in step with its leader" && apart(&home) < 0.03
    });
    home.dimos("status").with(0).shows(&["follow_leader is EXECUTING: in step with its leader", "leader    disabled"]);
    // A motion of the follower ends it.
    home.dimos("move follower 0 0 0 0 0").with(0);
    assert_eq!(report(&home)["state"], "IDLE");
    home.dimos("task invoke follow_leader start").with(0);
    eventually("it is back", || report(&home)["reason"] == "in step with its leader");
    home.dimos("task invoke follow_leader stop").with(0).shows(&["follow_leader: CANCELLED"]);
    run.end(Signal::INT).with(130);
    home.dimos("replay --last --verify").with(0).shows(&["reproducible"]);
}
