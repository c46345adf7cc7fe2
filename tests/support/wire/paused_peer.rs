//! pylibfranka's motions on an emulated FR3, stopped as the runs of this program are.

use std::io::{BufRead, BufReader, Lines, Write};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::atomic::Ordering;
use std::time::Duration;

use dimos::hardware::registry::EmulatorAddress;
use dimos::robot::random::Random;
use rustix::process::Pid;
use serde_json::json;

use super::paused::{Case, Emulated, Track, Way, emulator, model, pause, truth};
use super::paused_run::Figures;
use crate::support::loopback::own_address;

/// pylibfranka's motions on the same emulated arm, paused in the same way.
pub struct Peer {
    case: &'static Case,
    emulator: Emulated,
    client: Child,
    lines: Lines<BufReader<ChildStdout>>,
    random: Random,
}

impl Peer {
    /// On an emulated arm of a case of the FR3.
    pub fn new(python: &Path, case: &'static Case) -> Self {
        let (row, address) = (*dimos::arms::registry().get("franka").unwrap(), own_address());
        let sim = json!({ "initial_positions": case.ends[0] });
        let emulator = emulator(&row, case, &EmulatorAddress::Bind(address.into()), sim);
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/franka_pauses.py");
        let mut command = Command::new(python);
        command.arg(script).arg(address.to_string()).env("PYTHONDONTWRITEBYTECODE", "1");
        let mut client = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(client.stdout.take().unwrap()).lines();
        Self { case, emulator, client, lines, random: Random::new(7) }
    }

    /// A motion; whether it ended as it should, and its way.
    fn go(&mut self, to: &[f64], time: Duration) -> (bool, Way) {
        let emulator = self.emulator.clone();
        let (from, track) = (truth(&emulator, 7), Track::new());
        let words: Vec<String> = to.iter().map(f64::to_string).collect();
        writeln!(self.client.stdin.as_mut().unwrap(), "{}", words.join(" ")).unwrap();
        let begun = self.lines.next().unwrap().unwrap();
        let seconds: f64 = begun.strip_prefix("begun ").unwrap().parse().unwrap();
        let at = self.random.between(0.05, 0.9) * seconds;
        let pid = Pid::from_raw(self.client.id() as i32).unwrap();
        let lines = &mut self.lines;
        let ended = std::thread::scope(|scope| {
            scope.spawn(|| track.look(|| truth(&emulator, 7)));
            std::thread::sleep(Duration::from_secs_f64(at));
            if !time.is_zero() {
                pause(pid, time);
            }
            let ended = lines.next().unwrap().unwrap();
            track.done.store(true, Ordering::Relaxed);
            ended
        });
        (ended == "done", track.way(model("franka"), &from, to))
    }

    pub fn play(&mut self, time: Duration, times: usize) -> Figures {
        let mut figures = Figures::default();
        let [a, b] = self.case.ends;
        for i in 0..times {
            let (done, way) = self.go(if i % 2 == 0 { b } else { a }, time);
            figures.all += 1;
            figures.completed += usize::from(done);
            if done {
                (figures.off, figures.back) = (figures.off.max(way.off), figures.back.max(way.back));
            } else {
                self.go(if i % 2 == 0 { b } else { a }, Duration::ZERO);
            }
        }
        figures
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        drop(self.client.stdin.take());
        let _ = self.client.wait();
    }
}
