//! The vendor's own client moves the arm of a run through `dimos proxy xarm`: what it may, what it is refused, in its
//! own codes, and what remains when one of the three is gone.

use std::io::Write;
use std::net::TcpListener;
use std::path::Path;
use std::process::{ChildStdin, Command, Stdio};
use std::time::Duration;

use dimos::rpc::api::{Lease, Release};
use rustix::process::Signal;

use crate::support::loopback::own_address;
use crate::support::program::{Ended, Home, Started, eventually};
use crate::support::python::python_with;
use crate::support::skip::skip_port_502;

const STREAMS: &str = "
tasks:
  - {name: servo_arm, type: servo, joint_names: {hardware: arm}, priority: 12}
  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 14}
";

const PLAIN: &str = "
hardware:
  - {hardware_id: arm, adapter_type: mock, joints: {prefix: arm, count: 5}}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
";

/// A run of an arm on its emulator, the proxy, and the vendor's client.
pub struct Cell {
    pub home: Home,
    run: Started,
    pub proxy: Started,
    pub host: String,
    pub python: std::path::PathBuf,
}

impl Cell {
    /// Starts a run of `included` with stream tasks, and the proxy; `None` where the client or port 502 is missing.
    pub fn start(included: &str, more: &str) -> Option<Self> {
        Self::of(&format!("include: [{included}]{STREAMS}"), more)
    }

    /// Starts a run of a blueprint, and the proxy.
    fn of(blueprint: &str, more: &str) -> Option<Self> {
        let python = python_with(&["xarm"])?;
        let host = own_address().to_string();
        if TcpListener::bind((host.as_str(), 502)).is_err() {
            skip_port_502();
            return None;
        }
        let home = Home::new();
        home.write("cell.yaml", blueprint);
        let run = home.run(&format!("cell.yaml --sim {more}"));
        eventually("ready", || home.status()["arms"][0]["phase"] == "ready");
        let proxy = home.start(&format!("proxy xarm arm --listen {host}"));
        proxy.until("Ctrl-C ends it");
        Some(Self { home, run, proxy, host, python })
    }

    /// Starts a scenario of `tests/python/xarm_proxy.py`.
    fn client(&self, scenario: &str) -> (Started, ChildStdin) {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/xarm_proxy.py");
        let mut command = Command::new(&self.python);
        command.arg(script).args([scenario, &self.host]).env("HOME", self.home.path()).stdin(Stdio::piped());
        let mut client = Started::of(command.env("PYTHONDONTWRITEBYTECODE", "1").env("PYTHONUNBUFFERED", "1"));
        let stdin = client.stdin();
        (client, stdin)
    }

    /// Ends the run, and checks that replaying its log gives every command again, bit for bit. Returns the number of
    /// requests in the log.
    fn ends_reproducibly(self) -> usize {
        drop(self.proxy);
        self.run.end(Signal::INT);
        let log = self.home.logs().pop().unwrap();
        let verified = self.home.dimos(&format!("replay {} --verify", log.display())).with(0).shows(&["bit for bit"]);
        let before = verified.out.split(" requests").next().unwrap();
        before.rsplit(' ').next().unwrap().parse().unwrap_or_else(|e| panic!("{e}: {}", verified.out))
    }

    fn velocity(&self) -> f64 {
        let state = self.home.dimos("state --json").with(0).json();
        state["arms"][0]["joints"][5]["velocity"].as_f64().unwrap()
    }
}

#[track_caller]
fn ends_well(client: Started) -> Ended {
    client.wait().with(0).shows(&["all is as it should be"])
}

fn proceed(to: &mut ChildStdin) {
    writeln!(to).unwrap();
}

#[test]
fn a_program_of_the_vendors_sdk_moves_streams_grips_and_stops_the_arm_of_a_run() {
    let Some(cell) = Cell::start("coordinator-xarm6", "") else { return };
    let (client, mut answer) = cell.client("session");
    client.until("stopped");
    // The next tick holds it.
    eventually("the hold", || cell.home.status()["arms"][0]["cause"]["name"] == "operator_stop");
    eventually("a person may reset it", || cell.home.status()["arms"][0]["commander"].is_null());
    proceed(&mut answer);
    ends_well(client);
    eventually("the lease is free", || cell.home.status()["arms"][0]["commander"].is_null());
    let requests = cell.ends_reproducibly();
    assert!(requests > 220, "the log has {requests} requests: 201 setpoints, velocities, moves, stops");
}

#[test]
fn what_passes_a_limit_of_the_run_is_refused_in_the_clients_own_codes() {
    let narrow = "--set hardware.arm.limits.position.arm_joint1=[-1,1]";
    let Some(cell) = Cell::start("coordinator-xarm6", narrow) else { return };
    ends_well(cell.client("limits").0);
    cell.ends_reproducibly();
}

#[test]
fn a_client_without_the_lease_sees_an_error_and_takes_it_once_it_is_free() {
    let Some(cell) = Cell::start("coordinator-xarm6", "") else { return };
    let mut other = cell.home.client();
    other.call(Lease { arm: None }).unwrap();
    let (client, mut answer) = cell.client("leased");
    client.until("refused");
    cell.proxy.until("lease refused: arm is commanded by peers");
    other.call(Release { arm: None }).unwrap();
    proceed(&mut answer);
    client.until("taken");
    let holder = cell.home.status()["arms"][0]["commander"].take();
    assert_eq!(holder["program"], "dimos proxy", "{holder}");
    cell.home.dimos("move arm 0 0 0 0 0 0").with(1).says(&["[LEASE_HELD]"]);
    proceed(&mut answer);
    ends_well(client);
}

#[test]
fn an_arm_whose_proxy_dies_during_a_stream_comes_to_rest_and_is_held() {
    let Some(cell) = Cell::start("coordinator-xarm6", "") else { return };
    let (client, _answer) = cell.client("stream");
    client.until("moving");
    cell.proxy.signal(Signal::KILL);
    eventually("rest", || cell.velocity().abs() < 1e-3);
    ends_well(client);
    let status = cell.home.status();
    assert_eq!((&status["arms"][0]["phase"], &status["arms"][0]["commander"]), (&"ready".into(), &().into()));
    cell.ends_reproducibly();
}

#[test]
fn a_client_that_dies_leaves_no_velocity_behind() {
    let Some(cell) = Cell::start("coordinator-xarm6", "") else { return };
    let (client, _answer) = cell.client("stream");
    client.until("moving");
    client.signal(Signal::KILL);
    eventually("rest", || cell.velocity().abs() < 1e-3);
    eventually("the lease is free", || cell.home.status()["arms"][0]["commander"].is_null());
}

#[test]
fn the_end_of_the_run_closes_the_clients_connection() {
    let Some(cell) = Cell::start("coordinator-xarm6", "") else { return };
    let (client, _answer) = cell.client("stream");
    client.until("moving");
    cell.run.end(Signal::INT);
    let ended = cell.proxy.wait();
    assert!(ended.code == Some(1) && ended.err.contains("closed the connection"), "{}", ended.err);
    ends_well(client);
}

#[test]
fn a_run_that_hangs_is_an_arm_that_is_not_ready() {
    let Some(cell) = Cell::start("coordinator-xarm6", "--no-record") else { return };
    let (client, mut answer) = cell.client("hung");
    client.until("ready\n");
    cell.run.signal(Signal::STOP);
    proceed(&mut answer);
    ends_well(client);
    cell.run.signal(Signal::CONT);
}

#[test]
fn a_stop_by_another_program_ends_the_wait_of_the_client() {
    let Some(cell) = Cell::start("coordinator-xarm6", "") else { return };
    let (client, _answer) = cell.client("other_stop");
    client.until("moving");
    std::thread::sleep(Duration::from_millis(300));
    cell.home.dimos("stop").with(0);
    ends_well(client);
    cell.home.dimos("arm reset arm").with(0);
}

#[test]
fn arms_with_other_joints_and_of_other_makes_are_served_too() {
    for (blueprint, scenario) in [("coordinator-xarm7", "seven"), ("coordinator-ur5e", "other_make")] {
        let enabled = "--no-record --set hardware.arm.auto_enable=true";
        let Some(cell) = Cell::start(blueprint, enabled) else { return };
        ends_well(cell.client(scenario).0);
    }
}

#[test]
fn what_a_run_does_not_have_is_refused_without_an_error() {
    let Some(cell) = Cell::of(PLAIN, "--no-record") else { return };
    cell.proxy.until("mode 1  none; add to the blueprint's `tasks`: {name: servo_arm, type: servo");
    ends_well(cell.client("no_kinematics").0);
}
