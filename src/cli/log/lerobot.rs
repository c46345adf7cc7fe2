//! `dimos log export --lerobot`: a data set of LeRobot, version 3.0, with one episode and without video.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;

use serde_json::{Value, json};

use super::export::{cannot_write, each, new_file};
use super::{Part, ended, progress, unreadable};
use crate::cli::exit::{Failure, Result};
use crate::cli::output;
use crate::recording::joints::Places;
use crate::recording::parquet::{Column, ParquetWriter};
use crate::recording::replay::{LogReader, Payload, Selection};

/// Files of the data set: their places are fixed by the format.
const DATA: &str = "data/chunk-000/file-000.parquet";
const EPISODES: &str = "meta/episodes/chunk-000/file-000.parquet";
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
    let failed = |e| cannot_write(folder, e);
    std::fs::create_dir(folder).map_err(failed)?;
    for file in [DATA, EPISODES] {
        std::fs::create_dir_all(folder.join(file).parent().unwrap_or(folder)).map_err(failed)?;
    }
    let width = frames.names.len();
    let columns = [
        ("observation.state", Column::Lists(width, Vec::new())),
        ("action", Column::Lists(width, Vec::new())),
        ("timestamp", Column::Floats(Vec::new())),
        ("frame_index", Column::Integers(Vec::new())),
        ("episode_index", Column::Integers(Vec::new())),
        ("index", Column::Integers(Vec::new())),
        ("task_index", Column::Integers(Vec::new())),
    ];
    let columns = columns.map(|(name, column)| (name.to_owned(), column)).into();
    frames.file = Some(ParquetWriter::new(new_file(&folder.join(DATA))?, columns).map_err(failed)?);
    let loss = frames.read(&mut log, (from, to), &arms, &failed)?;
    let Frames { names, file, figures, .. } = frames;
    let rows = file.map_or(Ok(0), |file| file.finish(&[])).map_err(failed)?;
    if rows == 0 {
        return Err(Failure::usage("there is no time at which all joints are known in this part of the log"));
    }
    let named =
        |shape: usize, names: Option<Vec<String>>, dtype| json!({"dtype": dtype, "shape": [shape], "names": names});
    let positions = named(width, Some(names.iter().map(|name| format!("{name}.pos")).collect()), "float32");
    let index = || named(1, None, "int64");
    let info = json!({
        "codebase_version": "v3.0", "robot_type": arms.keys().cloned().collect::<Vec<_>>().join("+"),
        "total_episodes": 1, "total_frames": rows, "total_tasks": 1, "chunks_size": 1000,
        "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": rate as u64, "splits": {"train": "0:1"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": null,
        "features": {
            "observation.state": positions, "action": positions, "timestamp": named(1, None, "float32"),
            "frame_index": index(), "episode_index": index(), "index": index(), "task_index": index(),
        },
    });
    let stats = json!({"observation.state": figures[0].json(), "action": figures[1].json()});
    for (name, contents) in [("meta/info.json", info), ("meta/stats.json", stats)] {
        std::fs::write(folder.join(name), format!("{contents:#}\n")).map_err(failed)?;
    }
    write_tasks(folder, task, rows).map_err(failed)?;
    let seconds = rows as f64 / rate;
    let data = json!({"folder": folder, "frames": rows, "fps": rate, "length": seconds, "loss": loss});
    output::done(
        format_args!("1 episode, {rows} frames ({seconds:.3} s at {rate} Hz): {}", folder.display()),
        data,
        json,
    );
    Ok(ended(loss.as_deref()))
}

/// Writes what the episode is, and what its task is.
fn write_tasks(folder: &Path, task: &str, rows: usize) -> io::Result<()> {
    let file = |name: &str, columns: Vec<(&str, Column)>| {
        let columns = columns.into_iter().map(|(name, column)| (name.to_owned(), column)).collect();
        let out = io::BufWriter::new(std::fs::File::create_new(folder.join(name))?);
        ParquetWriter::new(out, columns)
    };
    let number = |value: usize| Column::Integers(vec![value as i64]);
    let episode = vec![
        ("episode_index", number(0)),
        ("tasks", Column::TextLists(vec![task.to_owned()])),
        ("length", number(rows)),
        ("data/chunk_index", number(0)),
        ("data/file_index", number(0)),
        ("dataset_from_index", number(0)),
        ("dataset_to_index", number(rows)),
        ("meta/episodes/chunk_index", number(0)),
        ("meta/episodes/file_index", number(0)),
    ];
    file(EPISODES, episode)?.finish(&[])?;
    let tasks = vec![("task_index", number(0)), ("task", Column::Texts(vec![task.to_owned()]))];
    // LeRobot finds tasks by the index of the pandas table.
    let column = |name: &str, pandas: &str, numpy: &str| json!({"name": name, "field_name": name, "pandas_type": pandas, "numpy_type": numpy, "metadata": null});
    let pandas = json!({
        "index_columns": ["task"], "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "creator": {"library": "dimos", "version": env!("CARGO_PKG_VERSION")}, "pandas_version": "2.0.0",
    });
    file("meta/tasks.parquet", tasks)?.finish(&[("pandas", pandas.to_string())]).map(drop)
}

/// Lowest and highest values, sums and sums of squares of a list.
#[derive(Default)]
struct Figures {
    count: u64,
    columns: Vec<[f64; 4]>,
}

impl Figures {
    fn add(&mut self, values: &[f64]) {
        self.columns.resize(values.len(), [f64::INFINITY, f64::NEG_INFINITY, 0.0, 0.0]);
        self.count += 1;
        for ([low, high, sum, squares], v) in self.columns.iter_mut().zip(values) {
            (*low, *high, *sum, *squares) = (low.min(*v), high.max(*v), *sum + v, *squares + v * v);
        }
    }

    fn json(&self) -> Value {
        let n = self.count.max(1) as f64;
        let each = |of: fn(&[f64; 4], f64) -> f64| self.columns.iter().map(|c| of(c, n)).collect::<Vec<_>>();
        json!({
            "min": each(|c, _| c[0]), "max": each(|c, _| c[1]), "mean": each(|c, n| c[2] / n),
            "std": each(|c, n| (c[3] / n - (c[2] / n).powi(2)).max(0.0).sqrt()), "count": [self.count],
        })
    }
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
    file: Option<ParquetWriter<io::BufWriter<std::fs::File>>>,
    figures: [Figures; 2],
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
        let (state, action, figures) = (unknown.clone(), unknown, Default::default());
        Ok(Self { names, joints, state, action, rate, start: None, at: 0, count: 0, file: None, figures })
    }

    fn read(
        &mut self,
        log: &mut LogReader,
        (from, to): (u64, u64),
        arms: &BTreeMap<String, Vec<String>>,
        failed: &dyn Fn(io::Error) -> Failure,
    ) -> Result<Option<String>> {
        let mut topics = vec!["/joint_states".to_owned(), "/joint_commands".to_owned()];
        topics.extend(arms.keys().flat_map(|arm| [format!("/gripper/{arm}"), format!("/dimos/outputs/{arm}")]));
        let mut places = Places::new(&self.names[..self.joints]);
        let loss = each(log, Selection { topics, from, to }, progress::bar(false), |entry| {
            if entry.log_time != self.at {
                self.frames_before(entry.log_time).map_err(failed)?;
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
        self.frames_before(self.at.saturating_add((0.25e9 / self.rate) as u64)).map_err(failed)?;
        Ok(loss)
    }

    /// Adds the frames before a time [ns].
    fn frames_before(&mut self, time: u64) -> io::Result<()> {
        if self.state.iter().any(|value| !value.is_finite()) {
            return Ok(());
        }
        let Some(file) = &mut self.file else { return Ok(()) };
        let start = *self.start.get_or_insert(self.at);
        while (self.count as f64 + LATE) / self.rate < time.saturating_sub(start) as f64 * 1e-9 {
            let frame = self.count as i64;
            if let [Column::Lists(_, states), Column::Lists(_, actions), Column::Floats(times), rest @ ..] =
                &mut file.columns[..]
            {
                states.extend(self.state.iter().map(|v| *v as f32));
                actions.extend(self.action.iter().map(|v| *v as f32));
                times.push((frame as f64 / self.rate) as f32);
                for (column, value) in rest.iter_mut().zip([frame, 0, frame, 0]) {
                    if let Column::Integers(list) = column {
                        list.push(value);
                    }
                }
            }
            self.figures[0].add(&self.state);
            self.figures[1].add(&self.action);
            self.count += 1;
            file.row_added()?;
        }
        Ok(())
    }
}
