//! `dimos log export --lerobot`: a data set of LeRobot, version 3.0, with one episode and without video.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::json;

use super::export::each;
use super::python_writer::PythonWriter;
use super::{Part, ended, progress, unreadable};
use crate::cli::exit::{Failure, Result};
use crate::cli::output;
use dimos_log::joints::Places;
use dimos_log::replay::{LogReader, Payload, Selection};

/// A tick this much of a frame after its time still counts for it.
const LATE: f64 = 0.125;

/// Writes the data set. Frames are the state at their time, and the command of the same tick.
pub fn run(path: &Path, part: &Part, folder: &Path, fps: Option<u32>, task: Option<&str>, json: bool) -> Result {
    let (from, to) = part.of(path)?;
    let mut log = LogReader::open(path).map_err(unreadable)?;
    let text = |key: &str| log.info().metadata.get(key).cloned().unwrap_or_default();
    let arms: BTreeMap<String, Vec<String>> = serde_json::from_str(&text("arms")).unwrap_or_default();
    let not_of_run = || Failure::usage(format!("{} is not the log of a run: its arms are unknown", path.display()));
    let fps = fps.map(f64::from).or_else(|| text("tick_rate").parse().ok()).ok_or_else(not_of_run)?;
    let (run, rate) = (text("run"), fps.round().max(1.0));
    let task = task.unwrap_or(&run);
    let mut frames = Frames::new(&mut log, (from, to), rate)?;
    if frames.names.is_empty() {
        return Err(not_of_run());
    }
    let robot = arms.keys().cloned().collect::<Vec<_>>().join("+");
    let header = json!({"names": frames.names, "fps": rate as u64, "robot_type": robot, "task": task});
    let mut set = PythonWriter::start("lerobot", "lerobot", folder, &header)?;
    let loss = frames.read(&mut log, (from, to), &arms, &mut set)?;
    let rows = frames.count;
    if rows == 0 {
        return Err(Failure::usage("there is no time at which all joints are known in this part of the log"));
    }
    set.finish()?;
    let seconds = rows as f64 / rate;
    let data = json!({"folder": folder, "frames": rows, "fps": rate, "length": seconds, "loss": loss});
    output::done(
        format_args!("1 episode, {rows} frames ({seconds:.3} s at {rate} Hz): {}", folder.display()),
        data,
        json,
    );
    Ok(ended(loss.as_deref()))
}

/// The frames: what is known at the current tick, and when the next frame is.
struct Frames {
    /// Joints of all arms, then grippers.
    names: Vec<String>,
    joints: usize,
    state: Vec<f64>,
    action: Vec<f64>,
    rate: f64,
    /// Time of the first frame [ns]: the first tick with all values known.
    start: Option<u64>,
    /// Time of the latest messages [ns].
    at: u64,
    count: usize,
}

impl Frames {
    fn new(log: &mut LogReader, (from, to): (u64, u64), rate: f64) -> Result<Self> {
        let (mut names, mut joints) = (Vec::new(), 0);
        let topics: Vec<String> = log.info().topics.keys().cloned().collect();
        let grippers = topics.iter().filter_map(|topic| topic.strip_prefix("/gripper/"));
        let grippers: Vec<String> = grippers.map(|arm| format!("{arm}_gripper")).collect();
        let arms: BTreeMap<String, Vec<String>> =
            log.info().metadata.get("arms").and_then(|text| serde_json::from_str(text).ok()).unwrap_or_default();
        each(
            log,
            Selection { topics: vec!["/joint_states".to_owned()], from, to },
            |_, _| (),
            |entry| {
                let Payload::JointState(state) = entry.data else { return Ok(true) };
                // Grippers are among them as joints of a model.
                let of_arms = |name: &String| arms.values().flatten().any(|joint| joint == name);
                names = state.name.into_iter().filter(of_arms).collect();
                joints = names.len();
                Ok(false)
            },
        )?;
        names.extend(grippers);
        let unknown = vec![f64::NAN; names.len()];
        let (state, action) = (unknown.clone(), unknown);
        Ok(Self { names, joints, state, action, rate, start: None, at: 0, count: 0 })
    }

    fn read(
        &mut self,
        log: &mut LogReader,
        (from, to): (u64, u64),
        arms: &BTreeMap<String, Vec<String>>,
        set: &mut PythonWriter,
    ) -> Result<Option<String>> {
        let mut topics = vec!["/joint_states".to_owned(), "/joint_commands".to_owned()];
        topics.extend(arms.keys().flat_map(|arm| [format!("/gripper/{arm}"), format!("/dimos/outputs/{arm}")]));
        let mut places = Places::new(&self.names[..self.joints]);
        let loss = each(log, Selection { topics, from, to }, progress::bar(false), |entry| {
            if entry.log_time != self.at {
                self.frames_before(entry.log_time, set)?;
                self.at = entry.log_time;
            }
            let index =
                |arm: &str| self.names.iter().skip(self.joints).position(|name| *name == format!("{arm}_gripper"));
            match entry.data {
                Payload::JointState(values) if entry.topic == "/joint_states" => {
                    let known = places.pick(&values.name, &values.position);
                    for ((state, action), now) in self.state.iter_mut().zip(&mut self.action).zip(known) {
                        // Without a command of a position an arm is to stay where it is.
                        if now.is_finite() {
                            (*state, *action) = (now, now);
                        }
                    }
                }
                Payload::JointState(values) if entry.topic == "/joint_commands" => {
                    let known = self.action.iter_mut().zip(places.pick(&values.name, &values.position));
                    known.filter(|(_, now)| now.is_finite()).for_each(|(own, now)| *own = now);
                }
                Payload::JointState(values) => {
                    let at = entry.topic.strip_prefix("/gripper/").and_then(index).map(|at| at + self.joints);
                    if let (Some(at), Some(position)) = (at, values.position.first()) {
                        self.state[at] = *position;
                        if self.action[at].is_nan() {
                            self.action[at] = *position;
                        }
                    }
                }
                Payload::ArmOutput(output) if output.gripper_seq > 0 => {
                    if let Some(at) = entry.topic.strip_prefix("/dimos/outputs/").and_then(index) {
                        self.action[at + self.joints] = output.gripper;
                    }
                }
                _ => {}
            }
            Ok(true)
        })?;
        self.frames_before(self.at.saturating_add((0.25e9 / self.rate) as u64), set)?;
        Ok(loss)
    }

    /// Adds the frames before a time [ns].
    fn frames_before(&mut self, time: u64, set: &mut PythonWriter) -> Result<()> {
        if self.state.iter().any(|value| !value.is_finite()) {
            return Ok(());
        }
        let start = *self.start.get_or_insert(self.at);
        while (self.count as f64 + LATE) / self.rate < time.saturating_sub(start) as f64 * 1e-9 {
            set.row(self.state.iter().chain(&self.action).map(|value| value.to_le_bytes()))?;
            self.count += 1;
        }
        Ok(())
    }
}
