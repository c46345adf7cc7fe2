//! PyPI's franka-sim (Apache-2.0), a controller that others wrote, judges the adapter's commands: limits of velocity by
//! position, of acceleration and of jerk, in double precision, lost commands at constant acceleration.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};

use crate::support::network::free_port;
use crate::support::program::{Home, Started};
use crate::support::python::python_with;

/// Motions at each speed; `DIMOS_FRANKA_SIM=50` is the full number (`make judge-franka`).
const MOTIONS: usize = 6;
/// For each motion, this many may be repeated because the host stalled the judge or the run.
const STALLS: usize = 2;

/// The controller in its own process, and what it says.
struct Judge {
    child: Child,
    port: u16,
    said: Arc<Mutex<String>>,
}

impl Judge {
    fn start(python: &Path) -> Self {
        let (port, script) =
            (free_port(), Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/franka_sim_server.py"));
        let mut command = Command::new(python);
        command.arg(script).arg(port.to_string()).env("PYTHONDONTWRITEBYTECODE", "1");
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::inherit()).spawn().unwrap();
        let (said, mut lines) = (Arc::new(Mutex::new(String::new())), BufReader::new(child.stdout.take().unwrap()));
        let log = said.clone();
        std::thread::spawn(move || {
            let mut line = String::new();
            while lines.read_line(&mut line).is_ok_and(|length| length > 0) {
                log.lock().unwrap().push_str(&std::mem::take(&mut line));
            }
        });
        let judge = Self { child, port, said };
        for _ in 0..300 {
            if judge.said.lock().unwrap().contains("Server running") {
                return judge;
            }
            std::thread::sleep(std::time::Duration::from_millis(100));
        }
        panic!("franka-sim does not start: {}", judge.said.lock().unwrap());
    }

    /// The limits that were broken.
    fn violations(&self) -> Vec<String> {
        // Errors of the motion generator are about commands. Others are about the joints, which follow badly while the
        // computer stalls the judge.
        let broken = |line: &&str| line.contains("joint_motion_generator");
        self.said.lock().unwrap().lines().filter(broken).map(str::to_owned).collect()
    }
}

impl Drop for Judge {
    fn drop(&mut self) {
        // Its standard input ends.
        drop(self.child.stdin.take());
        let _ = self.child.wait();
    }
}

/// Its joints follow 0.1 s late, and its clock is slow on a busy computer: the run is not to mind that.
fn run(home: &Home, judge: &Judge) -> Started {
    home.run(&format!(
        "coordinator-fr3 --no-record --address arm=127.0.0.1:{} --set hardware.arm.lag=0.5 --set hardware.arm.stale_after=0.3 \
         --set hardware.arm.tracking_tolerance=0.5 --set tasks.traj_arm.params.path_tolerance=0",
        judge.port
    ))
}

#[test]
fn franka_sim_takes_every_command_of_fast_motions() {
    let Some(python) = python_with(&["franka_sim", "mujoco"]) else { return };
    let motions = std::env::var("DIMOS_FRANKA_SIM").map_or(MOTIONS, |count| count.parse().unwrap());
    for speed in ["0.5", "1"] {
        let (home, judge) = (Home::new(), Judge::start(&python));
        let run = run(&home, &judge);
        let (mut done, mut stalled) = (0, 0);
        while done < motions {
            // 1.2 rad on joints 1, 3, 4, 5, 6 and 7.
            let goal = if done % 2 == 0 { "-0.6 -0.2 -0.6 -1.0 -0.6 1.1 0" } else { "0.6 -0.2 0.6 -2.2 0.6 2.3 1.2" };
            let moved = home.dimos(&format!("move arm {goal} --speed {speed}"));
            let broken = judge.violations();
            assert!(broken.is_empty(), "speed {speed}, motion {}: {broken:#?}\n{}", done + 1, moved.out);
            if moved.out.contains("COMPLETED") {
                done += 1;
                continue;
            }
            // The judge broke nothing off: the computer was too busy for one of the two, and the run says so. A judge
            // that falls behind the clock lets the setpoints run ahead of it.
            let all = format!("{}{}", moved.out, moved.err);
            let stall =
                ["no state for", "tracking error", "after a gap", "between two ticks", "jumped", "communication"];
            let ahead = all.contains("a setpoint was refused") && run.err().contains("rad is farther than");
            let because = ahead || stall.iter().any(|words| all.contains(words));
            assert!(because, "speed {speed}, motion {}: {all}{}", done + 1, run.err());
            stalled += 1;
            println!("repeated: {}{}", moved.out, moved.err);
            assert!(stalled <= 2 + motions * STALLS, "the computer is too busy: {stalled} motions were stalled");
            std::thread::sleep(std::time::Duration::from_millis(1500));
            for command in ["arm reset arm", "arm enable arm", "move arm 0 -0.2 0 -1.6 0 1.7 0.6 --speed 0.3"] {
                home.dimos(command);
            }
        }
        println!("speed {speed}: {done} of {motions} motions, {stalled} repeated after a stall of the host");
        drop(run);
    }
}
