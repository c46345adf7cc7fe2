//! One commander at a time, with the real binary: which client may move an arm, who is refused and why, and what
//! becomes of an arm whose commander is gone.

use std::io::{BufRead, BufReader, Write};
use std::net::Shutdown as Half;
use std::os::unix::net::UnixStream;

use dimos::rpc::Code;
use dimos::rpc::api::{Lease, Motion, Move, OnBehalfOf, RegisterGateway, Release, State, Status, Velocity};
use dimos::rpc::client::{Client, ClientError};
use dimos::rpc::report::CommanderReport;
use serde_json::Value;

use crate::support::program::{Home, Started, eventually};

const BLUEPRINT: &str = "
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: mock}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 20}
";

fn up(arguments: &str) -> (Home, Started) {
    let home = Home::new();
    home.write("streams.yaml", BLUEPRINT);
    let run = home.run(&format!("streams.yaml --no-record {arguments}"));
    (home, run)
}

fn target(velocity: f64) -> Velocity {
    Velocity { task: "velocity_arm".into(), velocities: vec![velocity, 0.0, 0.0, 0.0, 0.0, 0.0] }
}

fn raw(home: &Home) -> UnixStream {
    UnixStream::connect(home.path().join("run/dimos/streams.sock")).unwrap()
}

fn commander(client: &mut Client) -> Option<CommanderReport> {
    client.call(Status {}).unwrap().arms.remove(0).commander
}

fn is_at_rest(client: &mut Client) -> bool {
    let state = client.call(State {}).unwrap();
    state.arms[0].joints.iter().all(|j| j.velocity.is_some_and(|v| v.abs() < 1e-3))
}

#[test]
fn one_commands_and_everyone_reads_cancels_and_stops() {
    let (home, _run) = up("");
    let (mut one, mut two) = (home.client(), home.client());
    one.call(target(0.1)).unwrap();
    let holder = commander(&mut two).expect("the first target took the lease");
    assert_eq!(holder.pid, Some(std::process::id() as i32));
    assert!(holder.program.starts_with("process"), "{holder:?}");

    let named = format!("arm is commanded by {} (pid {}) for ", holder.program, std::process::id());
    for verb in ["move arm 0 0 0 0 0 0", "arm gripper arm 0.02", "arm disable arm", "arm enable arm", "arm reset arm"] {
        let refused = home.dimos(verb).with(1).says(&[&named, "[LEASE_HELD]", "hint: "]);
        assert_eq!(refused.out, "", "{verb}");
    }
    let Err(ClientError::Refused(refusal)) = two.call(target(-0.1)) else { panic!("two commanders") };
    assert_eq!((refusal.code, &refusal.data.unwrap()["arm"]), (Code::LeaseHeld, &Value::from("arm")));
    assert!(matches!(two.call(Lease::default()), Err(ClientError::Refused(e)) if e.code == Code::LeaseHeld));
    assert!(home.dimos("status").with(0).out.contains(&named));
    home.dimos("state").with(0);

    home.dimos("cancel").with(0);
    assert!(home.dimos("stop").with(0).out.contains("confirmed"));
    home.dimos("arm reset arm").with(1).says(&["[LEASE_HELD]"]);
    drop(one);
    eventually("the lease ends with its connection", || commander(&mut two).is_none());
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    assert!(commander(&mut two).is_none(), "making an arm ready takes no lease");
    home.dimos("move arm 0.1 0 0 0 0 0").with(0);
}

#[test]
fn a_lease_is_given_back_when_it_is_released() {
    let (home, _run) = up("");
    let (mut one, mut two) = (home.client(), home.client());
    assert_eq!(one.call(Lease { arm: Some("arm".into()) }).unwrap().arms, ["arm"]);
    assert_eq!(one.call(Lease::default()).unwrap().arms, ["arm"], "it holds it already");
    assert!(two.call(target(0.1)).is_err());
    assert_eq!(two.call(Release::default()).unwrap().arms, Vec::<String>::new(), "it is not its own");
    assert_eq!(one.call(Release::default()).unwrap().arms, ["arm"]);
    two.call(target(0.1)).unwrap();
    let unknown = two.call(Lease { arm: Some("rarm".into()) }).unwrap_err();
    assert_eq!(unknown.hint().as_deref(), Some("did you mean `arm`?"));
}

#[test]
fn the_stream_of_a_commander_that_is_gone_goes_stale_and_its_trajectory_goes_on() {
    let (home, _run) = up("");
    let mut watcher = home.client();
    let mut killed = home.client();
    killed.call(target(0.2)).unwrap();
    eventually("the arm moves", || !is_at_rest(&mut watcher));
    drop(killed);
    eventually("the lease is free", || commander(&mut watcher).is_none());
    eventually("the arm is at rest", || is_at_rest(&mut watcher));
    let status = watcher.call(Status {}).unwrap();
    assert_eq!(status.arms[0].phase, "ready", "a stream that ends is no fault");
    home.dimos("cancel --task velocity_arm").with(0);

    let away = home.start("move arm 0.8 0 0 0 0 0");
    away.until("motion ");
    let holder = commander(&mut watcher).expect("`move` holds the lease while it waits");
    assert_eq!((holder.pid, holder.program.as_str()), (Some(away.pid() as i32), "dimos move"));
    away.end(rustix::process::Signal::KILL);
    eventually("the lease is free", || commander(&mut watcher).is_none());
    eventually("the trajectory reached its end", || {
        let position = watcher.call(State {}).unwrap().arms[0].joints[0].position;
        (position.unwrap() - 0.8).abs() < 0.01
    });
}

#[test]
fn a_half_closed_commander_is_answered_and_gives_up_its_lease() {
    let (home, _run) = up("");
    let mut raw = raw(&home);
    let request = serde_json::json!({"id": 1, "method": "velocity", "params": target(0.05)});
    raw.write_all(format!("{request}\n{request}\n{request}\n").as_bytes()).unwrap();
    raw.shutdown(Half::Write).unwrap();
    let replies: Vec<Value> =
        BufReader::new(raw).lines().map(|line| serde_json::from_str(&line.unwrap()).unwrap()).collect();
    assert_eq!(replies.len(), 3);
    assert!(replies.iter().all(|r| r["result"].is_object()), "{replies:?}");
    let mut other = home.client();
    eventually("the lease is free", || other.call(target(0.0)).is_ok());
}

#[test]
fn what_a_commander_sent_before_it_went_is_not_begun_after_it() {
    let (home, _run) = up("--set coordinator.tick_rate=10");
    let mut watcher = home.client();
    let mut raw = raw(&home);
    // More than the tick takes in several seconds; the quick ones are at the end.
    let line = |velocity| format!("{}\n", serde_json::json!({"method": "velocity", "params": target(velocity)}));
    let slow = line(0.05).repeat(4000);
    raw.set_write_timeout(Some(std::time::Duration::from_millis(300))).unwrap();
    let whole = raw.write_all((slow + &line(0.5).repeat(4000)).as_bytes());
    assert!(whole.is_err(), "the run takes no more than its bounds");
    eventually("the arm moves", || !is_at_rest(&mut watcher));
    drop(raw);
    let mut fastest = 0.0_f64;
    eventually("the lease is free and the arm at rest", || {
        let joints = watcher.call(State {}).unwrap().arms.remove(0).joints;
        fastest = fastest.max(joints[0].velocity.unwrap_or_default());
        commander(&mut watcher).is_none() && is_at_rest(&mut watcher)
    });
    assert!(fastest < 0.1, "{fastest} rad/s: targets of a client that is gone were followed");
}

#[test]
fn arms_have_leases_of_their_own() {
    let home = Home::new();
    let _run = home.run("coordinator-dual-mock --no-record");
    let (mut left, mut right) = (home.client(), home.client());
    let motion = |arm: &str, dof| Move::new(arm, vec![0.3; dof], 0.3);
    left.call(motion("left_arm", 7)).unwrap();
    right.call(motion("right_arm", 6)).unwrap();
    assert!(matches!(right.call(Lease::default()), Err(ClientError::Refused(e)) if e.message.contains("left_arm")));
    home.dimos("arm disable right_arm").with(1).says(&["right_arm is commanded by"]);
}

#[test]
fn motions_of_a_connection_that_speaks_for_another_client_end_with_it() {
    let (home, _run) = up("");
    let mut watcher = home.client();
    for cancel_at_end in [true, false] {
        let mut gateway = home.client();
        let client = "alice (dimos jog on laptop)".to_owned();
        gateway.call(OnBehalfOf { client: client.clone(), cancel_at_end }).unwrap();
        let twice = gateway.call(OnBehalfOf { client: client.clone(), cancel_at_end: false });
        assert!(matches!(twice, Err(ClientError::Refused(e)) if e.code == Code::InvalidParams));
        let target = if cancel_at_end { 0.8 } else { 0.0 };
        let motion = gateway.call(Move::new("arm", vec![target, 0.0, 0.0, 0.0, 0.0, 0.0], 0.3)).unwrap().motion;
        assert_eq!(commander(&mut watcher).unwrap().program, client);
        home.dimos("move arm 0 0 0 0 0 0").with(1).says(&["arm is commanded by alice (dimos jog on laptop) (pid "]);
        eventually("the arm moves", || !is_at_rest(&mut watcher));
        drop(gateway);
        eventually("the lease is free", || commander(&mut watcher).is_none());
        eventually("the motion ends", || watcher.call(Motion { motion }).unwrap().done);
        let reached = watcher.call(Motion { motion }).unwrap().state == "COMPLETED";
        assert_eq!(reached, !cancel_at_end, "cancel_at_end {cancel_at_end}");
    }
}

#[test]
fn a_motion_of_another_client_survives_the_connection_that_moved_before_it() {
    let (home, _run) = up("");
    let (mut gateway, mut other) = (home.client(), home.client());
    gateway.call(OnBehalfOf { client: "alice".into(), cancel_at_end: true }).unwrap();
    let first = gateway.call(Move::new("arm", vec![0.1, 0.0, 0.0, 0.0, 0.0, 0.0], 1.0)).unwrap().motion;
    eventually("it has moved", || other.call(Motion { motion: first }).unwrap().done);
    gateway.call(Release::default()).unwrap();
    let second = other.call(Move::new("arm", vec![0.6, 0.0, 0.0, 0.0, 0.0, 0.0], 0.5)).unwrap().motion;
    drop(gateway);
    eventually("the second motion ends", || other.call(Motion { motion: second }).unwrap().done);
    assert_eq!(other.call(Motion { motion: second }).unwrap().state, "COMPLETED");
}

#[test]
fn a_run_has_one_gateway_until_its_connection_ends() {
    let (home, _run) = up("");
    let (mut one, mut two) = (home.client(), home.client());
    let gateway = |clients: &[&str]| RegisterGateway {
        endpoints: vec!["tls/0.0.0.0:7447".into()],
        clients: clients.iter().map(|name| (*name).to_owned()).collect(),
        ..RegisterGateway::default()
    };
    one.call(RegisterGateway { starting: true, ..gateway(&[]) }).unwrap();
    assert_eq!(two.call(Status {}).unwrap().share, None, "it does not listen yet");
    let refused = two.call(gateway(&[])).unwrap_err();
    assert!(matches!(&refused, ClientError::Refused(e) if e.code == Code::HasGateway), "{refused}");
    one.call(gateway(&[])).unwrap();
    one.call(gateway(&["alice"])).unwrap();
    let refused = two.call(gateway(&[])).unwrap_err();
    assert!(matches!(&refused, ClientError::Refused(e) if e.code == Code::HasGateway), "{refused}");
    let status = two.call(Status {}).unwrap();
    assert_eq!(status.share.unwrap().clients, ["alice"]);
    home.dimos("status").with(0).shows(&["shared at tls/0.0.0.0:7447: alice"]);
    drop(one);
    eventually("the run is not shared", || two.call(Status {}).unwrap().share.is_none());
    two.call(gateway(&[])).unwrap();
}
