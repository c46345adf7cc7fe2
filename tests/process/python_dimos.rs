//! Python dimos 0.0.15, unmodified, with a run of ours as its `ControlCoordinator`. Each check is made of its own
//! coordinator too, so that the judge is judged.

use std::time::{Duration, Instant};

use rustix::process::Signal;
use serde_json::{Value, json};

use crate::support::certificates::Authority;
use crate::support::network::{CELL, free_port, is_built};
use crate::support::program::{Home, Started, eventually};
use crate::support::python_dimos::Bus;

/// A run that Python dimos commands, and its bridge.
fn cell(bus: &Bus, more: &str) -> (Home, Started, Started) {
    let home = Home::new();
    home.write("cell.yaml", CELL);
    let run = home.run("cell.yaml --no-record");
    let bridge = bus.bridge(&home, more);
    bridge.until("of Python dimos on this computer");
    (home, run, bridge)
}

fn status(result: &Value) -> &str {
    result[1].as_str().unwrap_or_else(|| panic!("{result}"))
}

/// Check A: what their RPC client sees.
fn check_client(seen: &Value) {
    let joints: Vec<String> = (1..=6).map(|j| format!("arm/joint{j}")).collect();
    assert_eq!(seen["list_joints"], json!(joints));
    // The mock of ours has a gripper too.
    assert_eq!((&seen["list_hardware"], &seen["list_tasks"][0]), (&json!(["arm"]), &json!("joint_trajectory")));
    let positions = seen["get_joint_positions"].as_object().unwrap();
    assert!(joints.iter().all(|joint| positions[joint].is_f64()) && positions.len() == 6, "{positions:?}");
    assert!(seen["get_tick_count"].as_u64().unwrap() > 0);
    let states = &seen["states"];
    assert!(states["count"].as_u64().unwrap() > 50, "{states}");
    assert_eq!((&states["name"], &states["frame_id"]), (&json!(joints), &json!("coordinator")));
    assert!(states["age"].as_f64().unwrap().abs() < 0.5, "{states}");
    assert_eq!(states["widths"][0], 6);

    assert_eq!(seen["execute"], json!(["TrajectoryExecutionResult", "ACCEPTED", ""]));
    assert_eq!(seen["ended"], "COMPLETED");
    for moved in seen["moved"].as_array().unwrap() {
        assert!((moved.as_f64().unwrap() - 0.2).abs() < 0.01, "{}", seen["moved"]);
    }
    assert_eq!(seen["status"], json!(["TrajectoryStatus", "COMPLETED", 1.0, 0.0]));
    assert_eq!(status(&seen["again"]), "START_STATE_MISMATCH");
    assert_eq!(status(&seen["by_task"]), "ACCEPTED");
    assert_eq!(seen["active"][0], "joint_trajectory");
    let within = &seen["status_within"];
    assert_eq!(within[0], "EXECUTING");
    assert!(
        within.as_array().unwrap()[1..].iter().all(|part| (0.01..0.99).contains(&part.as_f64().unwrap())),
        "{within}"
    );
    assert_eq!(seen["cancel"], json!(["TrajectoryCancellationResult", "CANCELLED", ""]));
    assert_eq!(seen["cancelled"], "ABORTED");
    assert_eq!(status(&seen["cancel_again"]), "ALREADY_STOPPED");

    assert_eq!((&seen["unknown_task"], &seen["describe_unknown"]), (&Value::Null, &Value::Null));
    let commands = seen["describe"]["commands"].as_object().unwrap();
    assert_eq!(commands.keys().collect::<Vec<_>>(), ["cancel", "execute", "get_state", "get_status"]);
    assert_eq!(commands["execute"]["params"], json!(["trajectory", "current_positions"]));
    let error = |what: &str| (seen[what][0].as_str().unwrap(), seen[what][1].as_str().unwrap());
    let (class, text) = error("unknown_method");
    assert_eq!(class, "AttributeError");
    assert!(text.contains("declared commands: ['cancel', 'execute', 'get_state', 'get_status']"), "{text}");
    let (class, text) = error("unknown_argument");
    assert_eq!(class, "TypeError");
    assert!(text.contains("unexpected argument(s) ['hard']; accepts []"), "{text}");
    assert_eq!(status(&seen["unknown_joint"]), "INVALID_TRAJECTORY");
    assert_eq!(seen["estop"], true);
}

#[test]
fn their_client_reads_states_and_executes_as_with_their_own_coordinator() {
    let Some(bus) = Bus::new() else { return };
    let theirs = bus.coordinator();
    check_client(&bus.does("client"));
    assert_eq!(theirs.end()["state"], "ABORTED");

    let (home, run, _bridge) = cell(&bus, "--command");
    let seen = bus.does("client");
    check_client(&seen);
    let text = seen["unknown_joint"][2].as_str().unwrap();
    assert!(text.contains("no joint is named `elbow`; the joints are arm/joint1, arm/joint2"), "{text}");
    assert_eq!(home.status()["arms"][0]["phase"], "held", "set_estop stops");
    drop(run);
}

/// Check B: what their planner's executor sees.
fn check_execution(seen: &Value) {
    assert_eq!(seen["blocking"], json!(["COMPLETED", ""]));
    assert_eq!(seen["not_blocking"], json!(["ACCEPTED", ""]));
    assert_eq!(seen["second"], json!(["REJECTED", "Another trajectory is active"]));
    assert_eq!(seen["cancel"][0], "ABORTED");
    assert_eq!(seen["next"], json!(["COMPLETED", ""]));
    assert_eq!(seen["idle"], json!(["COMPLETED", ""]));
}

#[test]
fn their_planner_executes_as_through_their_own_coordinator() {
    let Some(bus) = Bus::new() else { return };
    let theirs = bus.coordinator();
    let seen = bus.does("execution");
    check_execution(&seen);
    // Theirs replaces a motion that is being executed; a run refuses.
    assert_eq!(seen["other"][0], "ACCEPTED");
    drop(theirs);

    let (home, _run, _bridge) = cell(&bus, "--command");
    let seen = bus.does("execution");
    check_execution(&seen);
    assert_eq!(seen["other"][0], "REJECTED", "{seen}");
    // Nothing keeps the lease.
    eventually("the lease is free", || home.status()["arms"][0]["commander"].is_null());
}

#[test]
fn without_leave_it_reads_and_ends_motion_only() {
    let Some(bus) = Bus::new() else { return };
    let (home, _run, _bridge) = cell(&bus, "");
    let seen = bus.does("client");
    for refused in ["execute", "by_task"] {
        assert_eq!(status(&seen[refused]), "INVALID_TRAJECTORY");
        assert!(seen[refused][2].as_str().unwrap().contains("start its bridge with --command"), "{seen}");
    }
    assert_eq!((&seen["ended"], status(&seen["cancel"])), (&json!("IDLE"), "ALREADY_STOPPED"));
    assert_eq!(home.positions("arm")[0], 0.0);
    assert_eq!(seen["estop"], true);
    assert_eq!(home.status()["arms"][0]["phase"], "held");
}

#[test]
fn names_domain_and_lease_are_as_configured() {
    let Some(bus) = Bus::new() else { return };
    let joints = "--joint arm_joint2=arm/shoulder --joint arm_joint6=tool/spin";
    let (home, _run, _bridge) = cell(&bus, &format!("--command --name Cell7 --domain lab {joints}"));
    let seen = bus.does("mapped Cell7 lab");
    let named = json!(["arm/joint1", "arm/shoulder", "arm/joint3", "arm/joint4", "arm/joint5", "tool/spin"]);
    assert_eq!((&seen["joints"], &seen["states"]), (&named, &named));
    assert_eq!(status(&seen["execute"]), "ACCEPTED");
    let moved = home.positions("arm");
    assert!((moved[1] - 0.1).abs() < 0.01 && moved[0] == 0.0, "{moved:?}");
    // It has the lease with a motion, and for one second after.
    assert_eq!(status(&seen["held"]), "ACCEPTED");
    eventually("the lease is taken", || home.status()["arms"][0]["commander"]["program"] == "Python dimos");
    home.dimos("move arm 0 0 0 0 0 0").with(1).says(&["arm is commanded by Python dimos", "[LEASE_HELD]"]);
    eventually("the lease is free", || home.status()["arms"][0]["commander"].is_null());
    home.dimos("move arm 0 0 0 0 0 0").with(0);
}

#[test]
fn a_gripper_is_a_task_from_0_closed_to_1_open() {
    let Some(bus) = Bus::new() else { return };
    let home = Home::new();
    let _run = home.run("coordinator-yourarm --no-record");
    let bridge = bus.bridge(&home, "--command");
    bridge.until("of Python dimos on this computer");
    let seen = bus.does("gripper");
    assert_eq!(seen["tasks"], json!(["joint_trajectory", "arm_gripper"]));
    assert_eq!((&seen["set"], &seen["beyond"], &seen["two"]), (&json!(true), &json!(false), &json!(false)));
    let value = |what: &str| seen[what][0].as_f64().unwrap_or_else(|| panic!("{seen}"));
    assert!((value("normalized") - 0.5).abs() < 0.05 && (value("native") - 0.04).abs() < 0.004, "{seen}");
    assert_eq!(seen["by_name"], true);
}

#[test]
fn n12_garbage_costs_its_sender_only() {
    let Some(bus) = Bus::new() else { return };
    let (home, _run, bridge) = cell(&bus, "--command");
    let line = |method: &str, hex: &str, attachment: &str| {
        format!("{}\n", json!({"method": method, "hex": hex, "attachment": attachment, "timeout": 1.0}))
    };
    // os.system("touch owned"), by a pickle that CPython executes when it reads it.
    let system = b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x0btouch owned\x85R\x85}\x86.";
    let system: String = system.iter().map(|byte| format!("{byte:02x}")).collect();
    let bomb = format!("80045d94{}2e", "285d94".repeat(2000));
    let nothing = "8004297d862e";
    let input = [
        line("execute_trajectory", &system, ""),
        line("task_invoke", &bomb, ""),
        line("list_joints", "00ff", ""),
        line("levitate", nothing, ""),
        line("add_task", "ffff", ""),
        line("list_joints", nothing, ""),
        // An attachment: do it, do not answer.
        line("list_joints", nothing, "nowait"),
        line("list_joints", "00ff", "nowait"),
        line("*", nothing, ""),
        line("list_joints", nothing, ""),
    ]
    .concat();
    let began = Instant::now();
    let answers = bus.says("raw", &input);
    assert!(began.elapsed() < Duration::from_secs(15), "{:?}", began.elapsed());
    assert_eq!(answers.len(), 10, "{answers:?}");
    for (at, class) in
        ["TypeError", "TypeError", "TypeError", "AttributeError", "NotImplementedError"].iter().enumerate()
    {
        let answer = &answers[at]["answers"][0];
        assert_eq!((&answer["ok"], &answer["encoding"]), (&json!(false), &json!("dimos/rpc-exception")), "{answer}");
        let hex: String = class.bytes().map(|byte| format!("{byte:02x}")).collect();
        assert!(answer["hex"].as_str().unwrap().contains(&hex), "{at}: {answer}");
    }
    let ok = |at: usize| answers[at]["answers"][0]["ok"] == true;
    assert!(ok(5) && ok(9), "{answers:?}");
    let silent = |at: usize| answers[at]["answers"].as_array().unwrap().iter().all(|answer| answer["ok"] != true);
    assert!((6..9).all(silent), "{answers:?}");
    assert!(!home.path().join("owned").exists(), "a pickle was executed");
    bridge.end(Signal::INT).with(0);
}

#[test]
fn n13_of_two_coordinators_on_a_bus_ours_is_refused_or_ends() {
    let Some(bus) = Bus::new() else { return };
    // Before: it does not serve.
    let theirs = bus.coordinator();
    let home = Home::new();
    home.write("cell.yaml", CELL);
    let run = home.run("cell.yaml --no-record");
    let refusal = "another ControlCoordinator with arm is on the bus of Python dimos; both would move";
    bus.bridge(&home, "--command").wait().with(1).says(&[refusal, "hint: end that one"]);
    drop(theirs);
    drop(run);

    // After: it ends within 5.5 s, and its motion is cancelled.
    let (home, _run, bridge) = cell(&bus, "--command");
    let slow = bus.says("begin", "").pop().unwrap();
    assert_eq!(status(&slow), "ACCEPTED");
    let _theirs = bus.coordinator();
    let began = Instant::now();
    bridge.wait().with(1).says(&[refusal]);
    assert!(began.elapsed() < Duration::from_millis(5800), "{:?}", began.elapsed());
    eventually("the motion is cancelled", || home.status()["tasks"][0]["state"] == "ABORTED");
    eventually("the lease is free", || home.status()["arms"][0]["commander"].is_null());
    // Theirs is the only one.
    check_client(&bus.does("client"));
    assert!(home.positions("arm")[0] < 0.9);
}

#[test]
fn a_run_on_another_computer_is_served_with_the_role_of_the_certificate() {
    let Some(bus) = Bus::new() else { return };
    if !is_built() {
        return;
    }
    let home = Home::new();
    let Some(lab) = Authority::create(&home.path().join("lab")) else { return };
    lab.sign("cell1", "DNS:localhost,IP:127.0.0.1", 30);
    ["alice", "bob"].iter().for_each(|user| lab.sign(user, &format!("DNS:{user}"), 30));
    let port = free_port();
    home.write(
        "cell.yaml",
        &format!(
            "{CELL}share: {{listen: ['tls/127.0.0.1:{port}'], users: {{alice: operator, bob: observer}},
  identity: {{ca: lab/ca.pem, cert: lab/cell1.pem, key: lab/cell1.key}}}}\n"
        ),
    );
    let _run = home.run("cell.yaml --no-record");
    for (user, accepted) in [("bob", "INVALID_TRAJECTORY"), ("alice", "ACCEPTED")] {
        let far = Home::new();
        let bridge =
            bus.bridge(&far, &format!("--command --at tls/localhost:{port} --user {user} --identity {}", lab.file("")));
        bridge.until("of Python dimos on this computer");
        let seen = bus.does("far");
        assert_eq!((seen["joints"].as_array().unwrap().len(), status(&seen["execute"])), (6, accepted), "{seen}");
        assert!(seen["states"].as_u64().unwrap() > 50, "{seen}");
        bridge.end(Signal::INT).with(0);
    }
    assert!((home.positions("arm")[0] - 0.1).abs() < 0.01);
}

#[test]
fn a_killed_bridge_leaves_nothing_moving() {
    let Some(bus) = Bus::new() else { return };
    let (home, run, bridge) = cell(&bus, "--command");
    assert_eq!(status(&bus.does("begin")), "ACCEPTED");
    bridge.signal(Signal::KILL);
    eventually("the motion is cancelled", || home.status()["tasks"][0]["state"] == "ABORTED");
    eventually("the lease is free", || home.status()["arms"][0]["commander"].is_null());
    drop(run);
    // A bridge ends with its run.
    let (_home, run, bridge) = cell(&bus, "");
    run.end(Signal::INT).with(130);
    bridge.wait().with(0).says(&["the run is gone"]);
}
