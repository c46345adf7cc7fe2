//! A job as written: read from its file with every mistake at its place.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use super::keys::{self, Group};
use super::step::{Act, Job, Motion, Step};
use crate::cli::arguments::{duration, finite, speed, time};
use crate::cli::demo;
use crate::cli::exit::{Failure, Result};
use crate::cli::grip::opening;
use crate::cli::output;
use dimos_core::arm::channel;
use dimos_core::bounded;
use dimos_core::written;
use dimos_rpc::api::{Attach, DEFAULT_SPEED, MAX_TCP_SPEED, PlanGoal, PoseSpec};
use dimos_yaml as yaml;
use dimos_yaml::{Diag, Kind, Label, NodeId, Tree, did_you_mean, quote};

/// Steps that `repeat` may be nested in.
const MAX_NESTING: usize = 8;
/// Largest number of repetitions.
const MAX_TIMES: f64 = 1e9;
/// Default time for a gripper to settle.
const GRIPPER_TIME: Duration = Duration::from_secs(5);

impl Job {
    /// Reads a job. Its mistakes are in its tree: [`Job::verdict`].
    pub fn read(path: &Path) -> Result<Self> {
        let file = path.display().to_string();
        if file == demo::JOB {
            let job = Self::parse(file, demo::JOB_TEXT.as_bytes());
            return job.verdict().map(|()| job);
        }
        // Also a pipe, as of `do <(command)`.
        let bytes = std::fs::File::open(path).and_then(|opened| bounded::take(opened, bounded::SMALL));
        let bytes = bytes.map_err(|e| Failure::usage(format!("{file}: {e}")))?;
        Ok(Self::parse(file, &bytes))
    }

    /// Reads a job; its mistakes are in its tree.
    fn parse(file: String, bytes: &[u8]) -> Self {
        let mut reader = Reader { tree: Tree::new(), direct: false, replan: false, speed: DEFAULT_SPEED, count: 0 };
        let source = reader.tree.add_bytes(file.clone(), bytes);
        let root = source.and_then(|source| reader.tree.parse(source));
        if let (Some(source), None, false) = (source, root, reader.tree.has_errors()) {
            reader
                .tree
                .report(Diag::error("the file is empty").at(Label::start_of(source)).hint("steps: [{move: home}, …]"));
        }
        let read = root.and_then(|root| reader.job(root, file.clone()));
        Self { tree: reader.tree, ..read.unwrap_or_else(|| Self::empty(file)) }
    }

    fn empty(file: String) -> Self {
        let (steps, on_fault) = (Vec::new(), Vec::new());
        Self { tree: Tree::new(), file, arm: String::new(), steps, repeat: Some(1), on_fault, count: 0 }
    }

    /// Adds a mistake.
    pub fn report(&mut self, at: NodeId, what: String, hint: Option<String>) {
        let label = self.tree.label(at);
        self.tree.report(Diag::error(what).at(label).maybe_hint(hint));
    }

    /// Returns an error if there are mistakes, after printing them.
    pub fn verdict(&self) -> Result<()> {
        let mut diags = self.tree.diags().to_vec();
        if !self.tree.has_errors() {
            return Ok(());
        }
        diags.sort_by_key(|d| d.at.as_ref().map(|at| at.range.start));
        let colour = output::colour(&std::io::stderr());
        for diag in &diags {
            output::note(format_args!("{}\n", yaml::render(&self.tree, diag, colour)));
        }
        let reports: Vec<_> = diags.iter().map(|diag| diag.located(&self.tree)).collect();
        let data = serde_json::json!({"errors": reports.len(), "diagnostics": reports});
        Err(Failure::usage(format!("{}: the job has mistakes; nothing has moved", self.file)).data(data))
    }
}

/// Reads the nodes of a job.
pub(super) struct Reader {
    pub(super) tree: Tree,
    direct: bool,
    replan: bool,
    speed: f64,
    count: usize,
}

impl Reader {
    pub(super) fn wrong<T>(&mut self, at: NodeId, what: impl Into<String>, hint: Option<&str>) -> Option<T> {
        let label = self.tree.label(at);
        self.tree.report(Diag::error(what).at(label).maybe_hint(hint.map(str::to_owned)));
        None
    }

    fn text(&self, node: NodeId) -> Option<String> {
        self.tree.text(node).map(str::to_owned)
    }

    /// Reports unknown keys of a group; `None` if it is no group.
    pub(super) fn group(&mut self, node: NodeId, group: &Group) -> Option<()> {
        let known = group.names();
        if !matches!(self.tree.node(node).map(|n| &n.kind), Some(Kind::Map(_))) {
            let hint = format!("its keys: {}", known.join(", "));
            return self.wrong(node, "expected a group of keys", Some(&hint));
        }
        for (key, _) in self.tree.entries(node).to_vec() {
            let word = self.text(key).unwrap_or_default();
            if !known.contains(&word.as_str()) {
                let hint = did_you_mean(&word, known.iter().copied(), "keys here");
                self.wrong::<()>(key, format!("unknown key {}", quote(&word)), hint.as_deref());
            }
        }
        Some(())
    }

    /// Reads a scalar with a parser of the command line.
    pub(super) fn parsed<T>(&mut self, node: NodeId, parse: fn(&str) -> std::result::Result<T, String>) -> Option<T> {
        let text = self.text(node).unwrap_or_default();
        match parse(&text) {
            Ok(value) => Some(value),
            Err(what) => self.wrong(node, format!("{}: {what}", quote(&text)), None),
        }
    }

    /// The same for the value of a key, if the key is there.
    pub(super) fn at<T>(
        &mut self,
        map: NodeId,
        key: &str,
        parse: fn(&str) -> std::result::Result<T, String>,
    ) -> Option<T> {
        self.tree.get(map, key).and_then(|node| self.parsed(node, parse))
    }

    fn numbers(&mut self, node: NodeId) -> Option<Vec<f64>> {
        let items = self.tree.items(node).to_vec();
        if items.is_empty() {
            return self.wrong(node, "expected a list of numbers", Some("write [0.1, -0.2, …]"));
        }
        items.into_iter().map(|item| self.parsed(item, finite)).collect()
    }

    fn array<const N: usize>(&mut self, map: NodeId, key: &str) -> Option<[f64; N]> {
        let node = self.tree.get(map, key)?;
        let values = self.numbers(node)?;
        let count = values.len();
        let array = values.try_into().ok();
        array.or_else(|| self.wrong(node, format!("expected {N} numbers, found {count}"), None))
    }

    fn job(&mut self, root: NodeId, file: String) -> Option<Job> {
        self.group(root, &keys::JOB)?;
        let mut job = Job::empty(file);
        job.arm = self.at(root, "arm", word).unwrap_or_default();
        self.speed = self.at(root, "speed", speed).unwrap_or(self.speed);
        self.direct = self.at(root, "direct", flag).unwrap_or(false);
        self.replan = self.at(root, "replan", flag).unwrap_or(false);
        if let Some(node) = self.tree.get(root, "repeat") {
            let forever = self.tree.text(node) == Some("forever");
            job.repeat = if forever { None } else { Some(self.parsed(node, times).unwrap_or(1)) };
        }
        match self.tree.get(root, "steps") {
            Some(steps) => job.steps = self.steps(steps, 0),
            None => drop(self.wrong::<()>(root, "the key `steps` is missing", Some("steps: [{move: home}, …]"))),
        }
        if let Some(node) = self.tree.get(root, "on_fault")
            && self.tree.text(node) != Some("stop")
        {
            job.on_fault = self.steps(node, 0);
        }
        job.count = self.count;
        Some(job)
    }

    fn steps(&mut self, node: NodeId, nesting: usize) -> Vec<Step> {
        let items = self.tree.items(node).to_vec();
        if items.is_empty() {
            self.wrong::<()>(node, "expected a list of one or more steps", Some("start each step with `- `"));
        }
        if nesting > MAX_NESTING {
            self.wrong::<()>(node, format!("steps are nested deeper than {MAX_NESTING} times"), None);
            return Vec::new();
        }
        items.into_iter().filter_map(|item| self.step(item, nesting)).collect()
    }

    fn step(&mut self, at: NodeId, nesting: usize) -> Option<Step> {
        let steps = keys::STEPS.names();
        let known = did_you_mean("", steps.iter().copied(), "steps");
        let (key, value) = match (self.tree.entries(at), self.text(at)) {
            ([(key, value)], _) => (*key, Some(*value)),
            (_, Some(_)) => (at, None),
            _ => return self.wrong(at, "a step has one key, such as `- move: home`", known.as_deref()),
        };
        let name = self.text(key).unwrap_or_default();
        let label = Diag::error("").at(self.tree.label(at)).located(&self.tree);
        let id = self.count;
        self.count += 1;
        let mut arm = String::new();
        let act = match (name.as_str(), value) {
            ("reset", None) => Act::Reset,
            ("enable", None) => Act::Enable,
            ("reset" | "enable", Some(value)) => {
                arm = self.parsed(value, word)?;
                if name == "reset" { Act::Reset } else { Act::Enable }
            }
            ("move", Some(value)) => Act::Move(Box::new(self.motion(value, &mut arm)?)),
            ("through", Some(value)) => Act::Move(Box::new(self.through(value, &mut arm)?)),
            ("gripper", Some(value)) => self.gripper(value, &mut arm)?,
            ("wait", Some(value)) => self.wait(value, &mut arm)?,
            ("output", Some(value)) => self.output(value, &mut arm)?,
            ("repeat", Some(value)) => {
                self.group(value, &keys::REPEAT)?;
                match (self.tree.get(value, "times"), self.tree.get(value, "steps")) {
                    (Some(count), Some(steps)) => {
                        let times = self.parsed(count, times).unwrap_or(1);
                        Act::Repeat { times, steps: self.steps(steps, nesting + 1) }
                    }
                    _ => return self.wrong(value, "needs `times` and `steps`", None),
                }
            }
            ("attach", Some(value)) => self.attach(value, &mut arm)?,
            ("detach", Some(value)) => Act::Detach(self.parsed(value, word)?),
            (known, None) if steps.contains(&known) => {
                return self.wrong(at, format!("`{known}` needs a value"), None);
            }
            _ => {
                let hint = did_you_mean(&name, steps.iter().copied(), "steps");
                return self.wrong(key, format!("unknown step {}", quote(&name)), hint.as_deref());
            }
        };
        Some(Step { at, id, line: label.line.unwrap_or(0), text: self.beginning(at), arm, act })
    }

    /// Returns the first lines of a step as one.
    fn beginning(&self, at: NodeId) -> String {
        let Some(node) = self.tree.node(at) else { return String::new() };
        let text = self.tree.source(node.source).and_then(|source| source.text.get(node.range.clone()));
        let words: Vec<&str> = text.unwrap_or_default().split_whitespace().collect();
        let line = words.join(" ");
        let line = line.strip_prefix('{').and_then(|line| line.strip_suffix('}')).unwrap_or(&line);
        match line.char_indices().nth(40) {
            Some((end, _)) => format!("{}…", line.get(..end).unwrap_or_default()),
            None => line.to_owned(),
        }
    }

    pub(super) fn arm(&mut self, map: NodeId, arm: &mut String) {
        *arm = self.at(map, "arm", word).unwrap_or_default();
    }

    fn motion(&mut self, node: NodeId, arm: &mut String) -> Option<Motion> {
        let mut motion = Motion {
            through: Vec::new(),
            goal: PlanGoal::default(),
            blend: 0.0,
            speed: self.speed,
            tcp_speed: None,
            touch: Vec::new(),
            direct: self.direct,
            replan: self.replan,
            on_path: Vec::new(),
            until: None,
        };
        if self.tree.text(node).is_some() {
            motion.goal.named = Some(self.parsed(node, word)?);
            return Some(motion);
        }
        self.group(node, &keys::MOTION)?;
        self.arm(node, arm);
        motion.speed = self.at(node, "speed", speed).unwrap_or(motion.speed);
        motion.tcp_speed = self.tcp_speed(node)?;
        motion.direct = self.at(node, "direct", flag).unwrap_or(motion.direct);
        motion.replan = self.at(node, "replan", flag).unwrap_or(motion.replan);
        motion.goal = self.goal(node)?;
        motion.on_path = self.acts(node, &motion)?;
        motion.until = self.until(node, &motion)?;
        motion.touch = self.touch(node)?;
        if motion.direct && motion.goal.joints.is_none() && motion.goal.named.is_none() {
            return self.wrong(node, "a direct motion needs `joints` or a named pose", Some("leave out `direct`"));
        }
        Some(motion)
    }

    /// Reads a goal: the keys of a group whose other keys have been checked.
    fn goal(&mut self, node: NodeId) -> Option<PlanGoal> {
        let kinds = ["named", "joints", "pose", "by"].iter().filter(|key| self.tree.get(node, key).is_some()).count();
        if kinds != 1 {
            return self.wrong(node, "needs one of named, joints, pose, by", None);
        }
        let is_pose = self.tree.get(node, "pose").or(self.tree.get(node, "by")).is_some();
        for key in ["frame", "linear", "via"] {
            if let Some((at, _)) = self.tree.entry(node, key).filter(|_| !is_pose) {
                return self.wrong(at, format!("`{key}` needs a pose"), None);
            }
        }
        let via = match self.tree.entry(node, "via") {
            Some((at, _)) if self.at(node, "linear", flag).unwrap_or(false) => {
                return self.wrong(at, "`via` is on a circle, `linear` on a straight line", Some("leave one out"));
            }
            Some(_) => Some(self.array::<3>(node, "via")?),
            None => None,
        };
        Some(PlanGoal {
            named: self.at(node, "named", word),
            joints: self.tree.get(node, "joints").and_then(|joints| self.numbers(joints)),
            pose: self.tree.get(node, "pose").and_then(|pose| self.pose(pose)),
            by: self.tree.get(node, "by").and_then(|by| self.pose(by)),
            frame: self.at(node, "frame", word),
            linear: self.at(node, "linear", flag).unwrap_or(false),
            via,
            ..PlanGoal::default()
        })
    }

    /// Reads the speed of the tool; `None` if it is wrong.
    #[expect(clippy::option_option, reason = "wrong, or not given")]
    fn tcp_speed(&mut self, node: NodeId) -> Option<Option<f64>> {
        let speed = self.at(node, "tcp_speed", finite);
        match speed.filter(|speed| !(*speed > 0.0 && *speed <= MAX_TCP_SPEED)) {
            None => Some(speed),
            Some(_) => {
                let at = self.tree.get(node, "tcp_speed").unwrap_or(node);
                self.wrong(at, format!("must be above 0 and at most {MAX_TCP_SPEED} m/s"), None)
            }
        }
    }

    fn pose(&mut self, node: NodeId) -> Option<PoseSpec> {
        self.group(node, &keys::POSE)?;
        if self.tree.get(node, "xyz").is_none() {
            return self.wrong(node, "the key `xyz` is missing", Some("{xyz: [x, y, z], rpy: [r, p, y]}; m, rad"));
        }
        if self.tree.get(node, "rpy").is_some() && self.tree.get(node, "quat").is_some() {
            return self.wrong(node, "has both rpy and quat", None);
        }
        let (rpy, quat) = (self.array::<3>(node, "rpy"), self.array(node, "quat"));
        let xyz = self.array::<3>(node, "xyz")?;
        let angles = rpy.map_or(Ok(()), |rpy| rpy.into_iter().try_for_each(written::angle));
        if let Err(wrong) = xyz.into_iter().try_for_each(written::length).and(angles) {
            return self.wrong(node, wrong, None);
        }
        Some(PoseSpec { xyz, rpy, quat })
    }

    fn through(&mut self, node: NodeId, arm: &mut String) -> Option<Motion> {
        let mut motion = Motion {
            through: Vec::new(),
            goal: PlanGoal::default(),
            blend: 0.0,
            speed: self.speed,
            tcp_speed: None,
            touch: Vec::new(),
            direct: false,
            replan: self.replan,
            on_path: Vec::new(),
            until: None,
        };
        let mut list = node;
        if self.tree.items(node).is_empty() {
            self.group(node, &keys::THROUGH)?;
            self.arm(node, arm);
            motion.speed = self.at(node, "speed", speed).unwrap_or(motion.speed);
            motion.tcp_speed = self.tcp_speed(node)?;
            motion.replan = self.at(node, "replan", flag).unwrap_or(motion.replan);
            motion.blend = self.at(node, "blend", finite).unwrap_or(0.0);
            if !(0.0..=1.0).contains(&motion.blend) {
                let blend = self.tree.get(node, "blend").unwrap_or(node);
                return self.wrong(blend, "must be within 0–1 m", None);
            }
            list = self.tree.get(node, "waypoints").unwrap_or(node);
            motion.on_path = self.acts(node, &motion)?;
            motion.until = self.until(node, &motion)?;
            motion.touch = self.touch(node)?;
        }
        let mut goals = Vec::new();
        for item in self.tree.items(list).to_vec() {
            goals.push(if self.tree.text(item).is_some() {
                PlanGoal { named: self.parsed(item, word), ..PlanGoal::default() }
            } else {
                self.group(item, &keys::WAYPOINT)?;
                self.goal(item)?
            });
        }
        if goals.len() < 2 {
            return self.wrong(list, "needs two or more waypoints", Some("through: [above, place]"));
        }
        motion.goal = goals.pop()?;
        motion.through = goals;
        Some(motion)
    }

    fn gripper(&mut self, node: NodeId, arm: &mut String) -> Option<Act> {
        let (mut force, mut object, mut timeout, mut to) = (None, None, GRIPPER_TIME, Some(node));
        if self.tree.text(node).is_none() {
            self.group(node, &keys::GRIPPER)?;
            self.arm(node, arm);
            force = self.at(node, "force", finite);
            object = self.at(node, "object", flag);
            timeout = self.at(node, "timeout", duration).unwrap_or(timeout);
            to = self.tree.get(node, "to");
        }
        let Some(to) = to else {
            return self.wrong(node, "the key `to` is missing", Some("to: open, close, or m or rad"));
        };
        Some(Act::Gripper { to: self.parsed(to, opening)?, force, object, timeout })
    }

    fn wait(&mut self, node: NodeId, arm: &mut String) -> Option<Act> {
        if self.tree.text(node).is_some() {
            return self.parsed(node, time).map(Act::Wait);
        }
        self.group(node, &keys::INPUT)?;
        self.arm(node, arm);
        let input = self.tree.get(node, "input");
        let Some(input) = input else { return self.wrong(node, "the key `input` is missing", Some("input: di0")) };
        let (input, high) = (self.parsed(input, digital_input)?, self.at(node, "is", level).unwrap_or(true));
        Some(Act::Input { input, high, timeout: self.at(node, "timeout", duration) })
    }

    pub(super) fn output(&mut self, node: NodeId, arm: &mut String) -> Option<Act> {
        let mut outputs = BTreeMap::new();
        for (key, value) in self.tree.entries(node).to_vec() {
            let name = self.text(key).unwrap_or_default();
            match (channel(&name, "do"), channel(&name, "ao")) {
                _ if name == "arm" => self.arm(node, arm),
                (Some(_), _) => drop(outputs.insert(name, f64::from(u8::from(self.parsed(value, level)?)))),
                (_, Some(_)) => drop(outputs.insert(name, self.parsed(value, finite)?)),
                _ => {
                    return self.wrong(
                        key,
                        format!("{} is not an output", quote(&name)),
                        Some("do0, do1, … and ao0, ao1, …"),
                    );
                }
            }
        }
        if outputs.is_empty() {
            return self.wrong(node, "needs an output", Some("output: {do0: 1}"));
        }
        Some(Act::Output(outputs))
    }

    fn attach(&mut self, node: NodeId, arm: &mut String) -> Option<Act> {
        let mut attach = Attach::default();
        if self.tree.text(node).is_some() {
            attach.name = self.parsed(node, word)?;
            return Some(Act::Attach(attach));
        }
        self.group(node, &keys::ATTACH)?;
        self.arm(node, arm);
        let Some(object) = self.tree.get(node, "object") else {
            return self.wrong(node, "the key `object` is missing", Some("its name: `dimos world list`"));
        };
        attach.name = self.parsed(object, word)?;
        attach.link = self.at(node, "link", word);
        attach.mass = self.at(node, "mass", finite);
        if let Some(touch) = self.tree.get(node, "touch") {
            let links = self.tree.items(touch).to_vec();
            attach.touch_links = links.into_iter().filter_map(|link| self.parsed(link, word)).collect();
        }
        Some(Act::Attach(attach))
    }
}

pub(super) fn word(text: &str) -> std::result::Result<String, String> {
    if matches!(text, "" | "~" | "null") { Err("must be a name".into()) } else { Ok(text.to_owned()) }
}

fn flag(text: &str) -> std::result::Result<bool, String> {
    text.parse().map_err(|_| "must be true or false".into())
}

pub(super) fn level(text: &str) -> std::result::Result<bool, String> {
    match text {
        "high" | "1" | "true" => Ok(true),
        "low" | "0" | "false" => Ok(false),
        _ => Err("must be high or low, 1 or 0".into()),
    }
}

pub(super) fn times(text: &str) -> std::result::Result<u64, String> {
    match text.parse::<u64>() {
        Ok(times) if times >= 1 && times as f64 <= MAX_TIMES => Ok(times),
        _ => Err("must be a number of times, 1 or more".into()),
    }
}

pub(super) fn digital_input(text: &str) -> std::result::Result<String, String> {
    match channel(text, "di") {
        Some(_) => Ok(text.to_owned()),
        None => Err("must be a digital input: di0, di1, …".into()),
    }
}

#[cfg(test)]
#[path = "file_tests.rs"]
mod tests;
