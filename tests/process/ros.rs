//! The run as a node of ROS 2, as programs that are none of our code see it: zenoh-ros2-sdk, and a client of
//! eclipse-zenoh with the types and the bytes of rosbags.

use std::time::{Duration, Instant};

use dimos::rpc::api::Lease;
use serde_json::{Value, json};

use crate::support::network::CELL;
use crate::support::program::{Home, eventually};
use crate::support::ros::{Ros, RosClient};

const STILL: [f64; 6] = [0.0; 6];

/// Points from one position of the first joint to another, in a time [s].
fn way(from: f64, to: f64, time: f64) -> Value {
    let at = |first: f64| [first, 0.0, 0.0, 0.0, 0.0, 0.0];
    json!([[0.0, at(from), STILL], [time, at(to), STILL]])
}

fn first_joint(home: &Home) -> f64 {
    home.positions("arm")[0]
}

#[test]
fn their_sdk_finds_the_node_and_reads_its_topics() {
    let Some(ros) = Ros::new(&["zenoh_ros2_sdk", "git", "json5"]) else { return };
    let _router = ros.router();
    let (home, _run) = ros.run("include: [yourarm-planner]\n", "");
    let seen = ros.sdk(&home);
    for (topic, kind) in [
        ("/joint_states", "sensor_msgs/msg/JointState"),
        ("/tf", "tf2_msgs/msg/TFMessage"),
        ("/tf_static", "tf2_msgs/msg/TFMessage"),
        ("/robot_description", "std_msgs/msg/String"),
        ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
    ] {
        assert_eq!(seen["topics"][topic], json!([kind]), "{}", seen["topics"]);
    }
    assert_eq!(seen["services"]["/dimos/stop"], json!(["std_srvs/srv/Trigger"]));
    let goals = &seen["services"]["/traj_arm/follow_joint_trajectory/_action/send_goal"];
    assert_eq!(*goals, json!(["control_msgs/action/FollowJointTrajectory_SendGoal"]));
    assert_eq!(seen["publisher"], json!(["dimos", ":1:,1:,:,:,,"]));
    let states = &seen["joint_states"];
    let joints: Vec<String> = (1..=6).map(|joint| format!("arm_joint{joint}")).collect();
    assert_eq!(states["name"], json!(joints));
    assert!(states["count"].as_u64().unwrap() > 50, "{states}");
    assert!(states["age"].as_f64().unwrap().abs() < 1.0, "{states}");
    // A subscriber that comes later gets it all the same.
    let described = seen["robot_description"].as_array().unwrap();
    assert!(described.len() == 1 && described[0].as_str().unwrap().contains("<robot"), "{described:?}");
    let tree = seen["frames"]["tree"].as_object().unwrap();
    let mut frame = "arm_tcp";
    while frame != "map" {
        frame = tree[frame].as_str().unwrap();
    }
    assert!(seen["frames"]["rate"].as_u64().unwrap() > 5, "{}", seen["frames"]);
    let rows = &seen["diagnostics"];
    assert!(rows[0][0].as_str().unwrap().ends_with(": arm") && rows[0][1] == 0 && rows[0][2] == "ready", "{rows}");
    assert!(rows[1][0].as_str().unwrap().ends_with(": tick"), "{rows}");
}

#[test]
fn the_graph_has_the_types_of_each_distribution() {
    let Some(ros) = Ros::new(&[]) else { return };
    let _router = ros.router();
    for distro in ["jazzy", "kilted", "lyrical"] {
        let (_home, _run) = ros.run(CELL, &format!(", distro: {distro}, domain: 7, namespace: /cell1/left"));
        let mut client = ros.client(json!({"domain": 7, "distro": distro, "namespace": "cell1/left"}));
        let (tokens, hashes) = (client.does("tokens", json!({})), client.does("hashes", json!({})));
        let tokens: Vec<&str> = tokens.as_array().unwrap().iter().map(|token| token.as_str().unwrap()).collect();
        assert!(tokens.contains(&"NN/%/%cell1%left/dimos"), "{tokens:?}");
        let mut seen = 0;
        for token in tokens {
            let Some((_, part)) = token.split_once("/%/%cell1%left/dimos/%cell1%left%") else { continue };
            let [_, kind, hash, _] = part.split('/').collect::<Vec<_>>()[..] else { panic!("{token}") };
            assert_eq!(hashes[kind], *hash, "{distro}: {kind}");
            seen += 1;
        }
        // Five topics, four services, and the action's three services and two topics.
        assert_eq!(seen, 14, "{distro}");
        assert!(client.does("joint_states", json!({"seconds": 0.5}))["count"].as_u64().unwrap() > 10);
        let hardware = client.does("hardware", json!({}));
        assert_eq!(
            (&hardware[0][0], &hardware[0][1], &hardware[0][2]),
            (&json!("arm"), &json!("mock"), &json!("active"))
        );
    }
}

#[test]
fn goals_are_executed_watched_and_answered() {
    let Some(ros) = Ros::new(&[]) else { return };
    let _router = ros.router();
    for distro in ["jazzy", "lyrical"] {
        let (home, _run) = ros.run(CELL, &format!(", command: true, distro: {distro}"));
        let mut client = ros.client(json!({"distro": distro}));
        client.does("watch", json!({"task": "traj_arm"}));
        let goal = client.goal(way(0.0, 0.4, 1.5), json!({}));
        eventually("ROS has the lease", || home.status()["arms"][0]["commander"]["program"] == "ROS 2");
        assert_eq!(client.does("result", json!({"goal": goal})), json!(["SUCCEEDED", 0, ""]));
        assert!((first_joint(&home) - 0.4).abs() < 2e-3);
        eventually("the lease is free", || home.status()["arms"][0]["commander"].is_null());
        let fed_back = client.does("fed_back", json!({"goal": goal}));
        let fed_back = fed_back.as_array().unwrap();
        assert!(fed_back.len() >= 10, "{} in 1.5 s", fed_back.len());
        let middle = &fed_back[fed_back.len() / 2];
        let (desired, actual) = (middle[1][0].as_f64().unwrap(), middle[2][0].as_f64().unwrap());
        assert!((0.02..0.38).contains(&desired) && (desired - actual).abs() < 0.1, "{middle}");
        assert!((middle[3][0].as_f64().unwrap() - (desired - actual)).abs() < 1e-9, "{middle}");
        assert_eq!(middle[4], if distro == "jazzy" { Value::Null } else { json!(0) });
        assert_eq!(client.does("states", json!({"goal": goal})), json!(["EXECUTING", "SUCCEEDED"]));

        // A first point that is later than the start: from where the arm is.
        let back = json!([[1.0, STILL, STILL]]);
        assert_eq!(client.goes(back, json!({})), json!(["SUCCEEDED", 0, ""]));
        assert!(first_joint(&home).abs() < 2e-3);
    }
}

#[test]
fn a_cancelled_goal_ends_at_rest_on_its_way() {
    let Some(ros) = Ros::new(&[]) else { return };
    let _router = ros.router();
    let (home, _run) = ros.run(CELL, ", command: true");
    let mut client = ros.client(json!({}));
    client.does("watch", json!({"task": "traj_arm"}));
    let goal = client.goal(way(0.0, 1.0, 8.0), json!({}));
    eventually("it moves", || first_joint(&home) > 0.05);
    assert_eq!(client.does("cancel", json!({"task": "traj_arm", "goal": goal})), json!([0, [goal]]));
    let began = Instant::now();
    assert_eq!(client.does("result", json!({"goal": goal})), json!(["CANCELED", 0, "cancelled"]));
    assert!(began.elapsed() < Duration::from_secs(3));
    let at = first_joint(&home);
    assert!((0.05..0.9).contains(&at), "{at}");
    std::thread::sleep(Duration::from_millis(200));
    assert!((first_joint(&home) - at).abs() < 1e-6, "it rests");
    assert_eq!(client.does("states", json!({"goal": goal})), json!(["EXECUTING", "CANCELING", "CANCELED"]));
    // It has ended; there is no other; all of none.
    assert_eq!(client.does("cancel", json!({"task": "traj_arm", "goal": goal})), json!([3, []]));
    assert_eq!(client.does("cancel", json!({"task": "traj_arm", "goal": "11".repeat(16)})), json!([2, []]));
    assert_eq!(client.does("cancel", json!({"task": "traj_arm"})), json!([0, []]));
    assert_eq!(client.does("result_of_unknown", json!({"task": "traj_arm"})), "UNKNOWN");
}

#[test]
fn a_goal_that_cannot_be_reached_says_why() {
    let Some(ros) = Ros::new(&[]) else { return };
    let _router = ros.router();
    let droops = "
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: yourarm, address: sim, options: {sim: {droop: 0.002}}}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
";
    let (home, _run) = ros.run(droops, ", command: true");
    let mut client = ros.client(json!({}));
    let at = home.positions("arm");
    let moved = |by: f64| [&[at[0] + by], &at[1..]].concat();
    let to = |by: f64, time: f64| json!([[time, moved(by), STILL]]);
    let ends = |client: &mut RosClient, points: Value, more: Value, code: i32, says: &str| {
        let result = client.goes(points, more);
        assert_eq!((&result[0], &result[1]), (&json!("ABORTED"), &json!(code)), "{result}");
        assert!(result[2].as_str().unwrap().contains(says), "{result}");
    };
    ends(&mut client, json!([]), json!({}), -1, "a motion needs at least 2");
    ends(&mut client, json!([[0.0, moved(0.5), STILL], [1.0, at, STILL]]), json!({}), -1, "START_STATE_MISMATCH");
    ends(&mut client, to(0.5, 0.01), json!({}), -1, "OUT_OF_LIMITS");
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_secs_f64();
    ends(&mut client, to(0.1, 1.0), json!({"stamp": now - 60.0}), -3, "the trajectory ended ");
    ends(&mut client, to(0.1, 1.0), json!({"stamp": now + 60.0}), -1, "it would start in ");
    let other = json!({"joints": ["arm_joint1", "arm_joint2"]});
    ends(
        &mut client,
        json!([[1.0, [0.0, 0.0], [0.0, 0.0]]]),
        other,
        -2,
        "traj_arm has the joints arm_joint1, arm_joint2",
    );
    ends(&mut client, to(0.2, 2.0), json!({"path": {"arm_joint1": 1e-7}}), -4, "arm_joint1 was 0.");
    // It droops by 0.002 rad: within the tolerance of the task, not within the goal's.
    ends(&mut client, to(0.1, 1.0), json!({"end": {"arm_joint2": 1e-4}, "late": 0.2}), -5, "arm_joint2 was 0.00");
    // Someone else has the arm.
    let mut other = home.client();
    other.call(Lease::default()).unwrap();
    ends(&mut client, to(0.1, 1.0), json!({}), -1, "LEASE_HELD");
}

#[test]
fn without_command_ros_reads_and_ends_motion() {
    let Some(ros) = Ros::new(&[]) else { return };
    let _router = ros.router();
    let (home, run) = ros.run(CELL, "");
    let mut client = ros.client(json!({}));
    assert!(client.goal(way(0.0, 0.3, 1.0), json!({})).is_null(), "the goal is rejected");
    run.until("ROS may not move the arms");
    let controllers = client.does("controllers", json!({}));
    assert_eq!(controllers[0][0], "traj_arm");
    assert_eq!((&controllers[0][1], controllers[0][3].as_array().unwrap().len()), (&json!("active"), 6));
    home.dimos("move arm 0.8 0 0 0 0 0 --speed 0.1 --no-wait").with(0);
    eventually("it moves", || first_joint(&home) > 0.02);
    let cancelled = client.does("trigger", json!({"name": "dimos/cancel"}));
    assert_eq!(cancelled, json!([true, "decelerating to rest: traj_arm"]));
    eventually("it rests", || home.status()["tasks"][0]["state"] != "EXECUTING");
    assert!(first_joint(&home) < 0.7);
    assert_eq!(client.does("trigger", json!({"name": "dimos/stop"})), json!([true, "arm: confirmed"]));
    assert_eq!(home.status()["arms"][0]["phase"], "held");
}

/// The router may come after the run, and go.
#[test]
fn a_router_that_comes_and_goes_is_waited_for() {
    let Some(ros) = Ros::new(&[]) else { return };
    let (home, run) = ros.run_alone(CELL, "");
    let face = |home: &Home| home.status()["share"]["faces"][0].clone();
    eventually("it says that the router is missing", || {
        face(&home)["reason"].as_str().is_some_and(|reason| reason.contains("rmw_zenohd"))
    });
    run.until("ros does not serve: no router at tcp/127.0.0.1:");
    for _ in 0..2 {
        let router = ros.router();
        eventually("the face serves", || face(&home)["serves"] == true);
        let mut client = ros.client(json!({}));
        assert!(client.does("joint_states", json!({"seconds": 0.5}))["count"].as_u64().unwrap() > 10);
        drop(client);
        drop(router);
        eventually("it serves no more", || face(&home)["serves"] == false);
    }
    assert_eq!(home.status()["arms"][0]["phase"], "ready");
    drop(run);
    let home = Home::new();
    let _run = home.run("coordinator-mock --no-record");
    let by_hand = home.start(&format!("share --ros tcp/127.0.0.1:{}", ros.port));
    by_hand.until("warning: ros does not serve: no router at tcp/127.0.0.1:");
}

/// N12: the encoding of ROS.
#[test]
fn damaged_requests_cost_their_sender_only() {
    let Some(ros) = Ros::new(&[]) else { return };
    let _router = ros.router();
    let (home, _run) = ros.run(CELL, ", command: true");
    let mut client = ros.client(json!({}));
    for seed in [1, 2, 3] {
        client.does("garbage", json!({"task": "traj_arm", "seed": seed, "count": 300}));
    }
    assert_eq!(client.goes(way(first_joint(&home), 0.1, 1.0), json!({})), json!(["SUCCEEDED", 0, ""]));
    assert_eq!(home.status()["arms"][0]["phase"], "ready");
}

/// `make judge-hiroz` builds that judge, which compiles zenoh once more, and asks for this one.
#[test]
fn hiroz_sends_goals_cancels_and_stops() {
    let Ok(judge) = std::env::var("DIMOS_HIROZ") else { return };
    let Some(ros) = Ros::new(&[]) else { return };
    let _router = ros.router();
    let (home, _run) = ros.run(CELL, ", command: true");
    let output = std::process::Command::new(judge).args([&ros.port.to_string(), "arm"]).output().unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{out}\n{err}");
    let seen: Value = serde_json::from_str(out.lines().last().unwrap_or_default()).unwrap();
    assert_eq!((&seen["server"], &seen["result"]), (&json!(true), &json!([0, ""])), "{seen}");
    assert!(seen["feedback"][0].as_u64().unwrap() > 10 && seen["feedback"][1][0] == 6, "{seen}");
    assert_eq!((&seen["cancel"], &seen["cancelled"]), (&json!([0, 1]), &json!([0, "cancelled"])));
    assert_eq!(seen["stop"], json!([true, "arm: confirmed"]));
    assert_eq!(home.status()["arms"][0]["phase"], "held");
}
