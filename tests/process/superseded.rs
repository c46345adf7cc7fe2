//! What was stopped stays stopped, with the real binary: plans, chunks and requests in a queue that are older than a
//! stop, a disable or another client's lease move nothing, and the log of such a run is reproducible.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;

use dimos::rpc::Code;
use dimos::rpc::api::{Chunk, ExecutePlan, Lease, Plan, PlanGoal, Planning, Release, State, Status};
use dimos::rpc::client::{Client, ClientError};
use rustix::process::Signal;
use serde_json::Value;

use crate::support::program::{Home, Started, eventually};

const COORDINATOR: &str = "
name: cell
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: mock}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
  - {name: chunk_arm, type: chunk, joint_names: {hardware: arm}, priority: 20}
";
const PLANNER: &str = "
name: lab
include: [cell.yaml]
planner:
  robots:
    - name: arm
      model_path: builtin:yourarm
      end_effector_link: flange
      joint_names: [joint1, joint2, joint3, joint4, joint5, joint6]
      joint_prefix: arm_
      coordinator_task_name: traj_arm
";
const GOAL: [f64; 6] = [0.3, -0.2, 0.4, 0.0, 0.4, 0.0];

fn up(blueprint: &str, arguments: &str) -> (Home, Started) {
    let home = Home::new();
    home.write("cell.yaml", COORDINATOR);
    home.write("lab.yaml", PLANNER);
    let run = home.run(&format!("{blueprint} {arguments}"));
    (home, run)
}

fn plan(client: &mut Client) -> u64 {
    let goal = PlanGoal { robot: "arm".into(), joints: Some(GOAL.to_vec()), ..PlanGoal::default() };
    let plan = client.call(Plan { goals: vec![goal], ..Plan::default() }).unwrap().plan;
    eventually("it is planned", || client.call(Planning { plan }).unwrap().state == "PLANNED");
    plan
}

fn execute(client: &mut Client, plan: u64) -> Result<(), (Code, String)> {
    match client.call(ExecutePlan { plan: Some(plan), ..ExecutePlan::default() }) {
        Ok(_) => Ok(()),
        Err(ClientError::Refused(refusal)) => Err((refusal.code, refusal.message)),
        Err(e) => panic!("{e}"),
    }
}

fn revive(home: &Home) {
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
}

#[test]
fn a_plan_is_executed_only_if_nothing_has_interrupted_the_arm_since() {
    let (home, run) = up("lab.yaml", "--record log.mcap");
    let (mut a, mut b) = (home.client(), home.client());
    home.dimos("plan arm 0.3 -0.2 0.4 0 0.4 0").with(0);
    home.dimos("stop").with(0);
    revive(&home);
    let after_stop = "arm was stopped by an operator after this motion was requested";
    home.dimos("execute").with(1).says(&[after_stop, "[SUPERSEDED]", "hint: "]);

    let plan_before = plan(&mut a);
    home.dimos("arm disable arm").with(0);
    home.dimos("arm enable arm").with(0);
    let after_disable = "arm was disabled after this motion was requested";
    assert_eq!(execute(&mut a, plan_before), Err((Code::Superseded, after_disable.into())));

    let plan_before = plan(&mut a);
    b.call(Lease::default()).unwrap();
    assert_eq!(execute(&mut a, plan_before).unwrap_err().0, Code::LeaseHeld);
    b.call(Release::default()).unwrap();
    let after_lease = "another client took the lease of arm after this motion was requested";
    assert_eq!(execute(&mut a, plan_before), Err((Code::Superseded, after_lease.into())));
    assert!(home.positions("arm").iter().all(|q| q.abs() < 1e-3), "nothing has moved");

    // The lease that the execution itself takes is no change.
    home.dimos("plan arm 0.3 -0.2 0.4 0 0.4 0").with(0);
    home.dimos("execute").with(0);
    assert!((home.positions("arm")[0] - GOAL[0]).abs() < 0.01);
    run.end(Signal::TERM).with(143);
    home.dimos("replay log.mcap --verify").with(0).shows(&["reproducible"]);
}

fn chunk(client: &mut Client, ahead: f64) {
    let stamp = client.call(State {}).unwrap().stamp;
    let actions = (0..=40).map(|k| vec![0.01 * f64::from(k), 0.0, 0.0, 0.0, 0.0, 0.0]).collect();
    let start = Some(stamp + ahead);
    client.call(Chunk { task: "chunk_arm".into(), actions, period: 0.05, start, gripper: None }).unwrap();
}

fn chunk_task(client: &mut Client) -> (String, String) {
    let tasks = client.call(Status {}).unwrap().tasks;
    let task = tasks.into_iter().find(|task| task.name == "chunk_arm").unwrap();
    (task.state, task.reason.unwrap_or_default())
}

#[test]
fn a_chunk_ends_with_the_connection_that_sent_it_or_with_its_lease() {
    let (home, _run) = up("cell.yaml", "--no-record");
    let mut watcher = home.client();
    for (ahead, disconnects) in [(1.5, true), (0.0, true), (1.5, false)] {
        let mut sender = home.client();
        chunk(&mut sender, ahead);
        assert_eq!(chunk_task(&mut watcher).0, "EXECUTING");
        std::thread::sleep(std::time::Duration::from_millis(300));
        if disconnects {
            drop(sender);
        } else {
            sender.call(Release::default()).unwrap();
        }
        eventually("the chunk ends", || chunk_task(&mut watcher).0 == "ABORTED");
        let (_, reason) = chunk_task(&mut watcher);
        assert!(reason.contains("has disconnected, or released arm"), "{reason}");
        std::thread::sleep(std::time::Duration::from_millis(300));
        let rests = home.positions("arm");
        std::thread::sleep(std::time::Duration::from_millis(2000));
        let since = home.positions("arm");
        assert!(rests.iter().zip(&since).all(|(a, b)| (a - b).abs() < 1e-3), "{rests:?} {since:?}");
        home.dimos("move arm 0 0 0 0 0 0 --speed 1").with(0);
    }
}

/// A client that does not wait for replies has requests in a queue: they are as old as the one that is handled.
#[test]
fn a_request_in_the_queue_of_a_connection_is_as_old_as_the_one_before_it() {
    let (home, _run) = up("cell.yaml", "--no-record");
    let planner = home.start("run lab.yaml");
    planner.until("attached");
    let mut queue = UnixStream::connect(home.path().join("run/dimos/cell.sock")).unwrap();
    planner.signal(Signal::STOP);
    let slow = r#"{"id": 1, "method": "planner", "params": {}}"#;
    let far =
        r#"{"id": 2, "method": "move", "params": {"arm": "arm", "target": [0.5, 0, 0, 0, 0, 0], "direct": true}}"#;
    queue.write_all(format!("{slow}\n{far}\n").as_bytes()).unwrap();
    std::thread::sleep(std::time::Duration::from_millis(200));
    home.dimos("stop").with(0);
    revive(&home);
    planner.signal(Signal::CONT);
    let mut replies = BufReader::new(queue.try_clone().unwrap()).lines();
    let mut reply = || serde_json::from_str::<Value>(&replies.next().unwrap().unwrap()).unwrap();
    assert_eq!(reply()["id"], 1);
    let refused = reply();
    assert_eq!((&refused["id"], &refused["error"]["code"]), (&Value::from(2), &Value::from("SUPERSEDED")), "{refused}");
    // Sent now, it moves.
    queue.write_all(format!("{far}\n").as_bytes()).unwrap();
    assert!(reply()["result"]["motion"].is_u64());
}

#[test]
fn an_arm_can_be_enabled_to_be_held_outside_its_limits() {
    let (home, _run) = up("cell.yaml", "--no-record");
    home.dimos("arm disable arm").with(0);
    assert!(home.dimos("arm enable arm --outside").with(0).out.contains("arm: ready"));
    home.dimos("arm enable arm --inside").with(2);
}
