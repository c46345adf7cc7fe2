//! A log in the live view: robots and arms of its run, and windows of its messages.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use serde_json::{Map, Value, json};

use crate::cli::exit::{Exit, Failure, Result};
use crate::replay::recorded::Recorded;
use crate::view::{MeshFile, Scene, Subject, value};
use dimos_core::sync::lock;
use dimos_log::replay::{LogReader, attachment};
use dimos_log::window::LogWindows;
use dimos_rpc::api::WorldObject;

/// Maximum length of a reply [bytes]: a window with more messages ends early.
const MAX_REPLY: usize = 32 << 20;

/// A log.
pub struct Log {
    path: PathBuf,
    windows: Mutex<LogWindows>,
    /// Unix time of its first message [ns].
    start: u64,
}

/// What a log says of its run.
#[derive(Default)]
struct Known {
    run: String,
    arms: Vec<Value>,
    /// Limits of the arms' joints.
    limits: Map<String, Value>,
}

impl Log {
    /// Opens a log.
    pub fn open(path: &Path) -> Result<Self> {
        let windows = LogWindows::open(path).map_err(|e| Failure::of(Exit::Usage, e))?;
        let empty = || Failure::usage(format!("the log {} has no messages", path.display()));
        let (start, _) = windows.span().ok_or_else(empty)?;
        Ok(Self { path: path.to_owned(), windows: Mutex::new(windows), start })
    }

    /// Returns what it lacks; `None` if it is whole or live.
    pub fn loss(&self) -> Option<String> {
        lock(&self.windows).loss()
    }

    /// Returns the arms with their joints and limits, as far as the log has them.
    fn known(&self) -> Option<Known> {
        let info = LogReader::open_for(&self.path, &["/joint_states"]).ok()?.info().clone();
        let run = info.metadata.get("run").cloned().unwrap_or_default();
        let (mut arms, mut limits) = (Vec::new(), Map::new());
        let mut arm = |name: &str, joints: &Value| {
            let dof = joints.as_array().map_or(0, Vec::len);
            arms.push(json!({"name": name, "type": "", "dof": dof, "joints": joints, "gripper": null}));
        };
        // Logs of other versions have names at least.
        let Ok(recorded) = Recorded::of(&self.path, info.clone()) else {
            let known =
                info.metadata.get("arms").and_then(|arms| serde_json::from_str::<Map<String, Value>>(arms).ok());
            known.iter().flatten().for_each(|(name, joints)| arm(name, joints));
            return Some(Known { run, arms, limits });
        };
        for (names, config) in recorded.names.arms.iter().zip(&recorded.config.arms) {
            arm(&names.hardware_id, &json!(names.joints));
            for (i, joint) in names.joints.iter().enumerate() {
                let of = |list: &[f64]| list.get(i).copied().filter(|limit| limit.is_finite());
                let own = &config.limits;
                let (lower, upper) = (of(&own.position_lower), of(&own.position_upper));
                let velocity = of(&own.velocity_max);
                limits.insert(joint.clone(), json!({"lower": lower, "upper": upper, "velocity": velocity}));
            }
        }
        Some(Known { run, arms, limits })
    }

    /// Returns the messages of a window as JSON.
    fn messages(&self, query: &str) -> std::result::Result<String, String> {
        let number = |key: &str| value(query, key).and_then(|text| text.parse::<f64>().ok()).filter(|v| v.is_finite());
        let at = |key: &str, or: u64| number(key).map_or(or, |t| self.start.saturating_add((t.max(0.0) * 1e9) as u64));
        let window = (at("from", self.start), at("to", u64::MAX - 1));
        let points = number("points").unwrap_or(0.0).max(0.0) as u64;
        let topics: Vec<&str> = value(query, "topics").unwrap_or_default().split(',').collect();
        // The times alone, or all but messages with this text: plans are long, and few are shown.
        let (bare, without) = (value(query, "bare").is_some(), value(query, "without").unwrap_or("\0"));
        let mut log = lock(&self.windows);
        log.refresh().map_err(|e| e.to_string())?;
        let (mut out, mut full, mut text) = (String::new(), false, String::new());
        let read = log.read(&topics, window, points, |message, channel, bytes| {
            text.clear();
            if !bare && (channel.json(bytes, &mut text).is_err() || text.contains(without)) {
                return true;
            }
            let (comma, time) = (if out.is_empty() { "" } else { "," }, seconds(message.time, self.start));
            let (topic, data) = (&channel.topic, if bare { "null" } else { &text });
            let _ = write!(out, "{comma}{{\"topic\":\"{topic}\",\"t\":{time:.6},\"data\":{data}}}");
            full = out.len() > MAX_REPLY;
            !full
        });
        read.map_err(|e| e.to_string())?;
        let (length, live) = (seconds(log.span().map_or(0, |(_, end)| end), self.start), log.is_live());
        let loss = json!(log.loss());
        Ok(format!("{{\"length\":{length:.6},\"live\":{live},\"loss\":{loss},\"full\":{full},\"messages\":[{out}]}}"))
    }
}

fn seconds(time: u64, start: u64) -> f64 {
    time.saturating_sub(start) as f64 * 1e-9
}

impl Subject for Log {
    fn scene(&self) -> Scene {
        let Known { run: name, arms, limits } = self.known().unwrap_or_default();
        let (mut meshes, mut robots) = (Vec::new(), Vec::new());
        if let Ok(Some(urdf)) = attachment(&self.path, "robot_description.urdf") {
            let mut urdf = String::from_utf8_lossy(&urdf).into_owned();
            for uri in mesh_names(&urdf) {
                let file = match attachment(&self.path, &uri) {
                    Ok(Some(bytes)) => MeshFile::Inside(uri.clone(), bytes),
                    _ => MeshFile::Missing(format!("{uri}: it is not in the log")),
                };
                urdf = urdf
                    .replace(&format!("filename=\"{uri}\""), &format!("filename=\"{}\"", file.address(meshes.len())));
                meshes.push(file);
            }
            let base = json!({"xyz": [0.0, 0.0, 0.0], "quat": [0.0, 0.0, 0.0, 1.0]});
            // The page drives all joints of the description: their names are those of `/joint_states`.
            robots.push(json!({
                "name": name, "base": base, "urdf": urdf, "tip": "", "root": "map", "joints": {}, "limits": limits,
            }));
        }
        let log = lock(&self.windows);
        let length = seconds(log.span().map_or(0, |(_, end)| end), self.start);
        let file = self.path.file_name().unwrap_or_default().to_string_lossy();
        let json = json!({
            "version": 1, "kind": "log", "name": name, "simulated": false, "planner": false,
            "robots": robots, "arms": arms,
            "log": {
                "file": file, "start": self.start as f64 * 1e-9, "length": length, "live": log.is_live(),
                "loss": log.loss(), "topics": log.topics().collect::<Vec<_>>(),
            },
        });
        Scene { json: json.to_string(), meshes }
    }

    fn object(&self, _: &str) -> Option<WorldObject> {
        None
    }

    fn answer(&self, path: &str, query: &str) -> Option<std::result::Result<String, String>> {
        (path == "messages").then(|| self.messages(query))
    }
}

/// Returns the names of the mesh files in a description.
fn mesh_names(urdf: &str) -> Vec<String> {
    let mut names: Vec<String> = urdf
        .split("<mesh ")
        .skip(1)
        .filter_map(|rest| rest.split("filename=\"").nth(1)?.split('"').next())
        .map(str::to_owned)
        .collect();
    names.sort();
    names.dedup();
    names
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs::File;

    use super::*;
    use dimos_log::log_writer::{LogAttachment, LogWriter};
    use dimos_log::messages::JointState;

    const URDF: &str = r#"<robot name="r"><link name="map"><visual><geometry><mesh filename="package://a/b.stl"/>
        </geometry></visual></link><link name="l"><visual><geometry><mesh filename="gone.stl" scale="1 1 1"/></geometry>
        </visual></link><joint name="j" type="fixed"><parent link="map"/><child link="l"/></joint></robot>"#;

    /// A log of ten seconds with a state every 10 ms, whose run had one mesh.
    fn log(folder: &tempfile::TempDir) -> Log {
        let path = folder.path().join("a.mcap");
        let attach = |name: &str, data: &[u8]| LogAttachment {
            name: name.to_owned(),
            media_type: String::new(),
            data: data.to_vec(),
        };
        let attachments = [attach("robot_description.urdf", URDF.as_bytes()), attach("package://a/b.stl", b"solid")];
        let metadata = BTreeMap::from([
            ("run".to_owned(), "cell".to_owned()),
            ("arms".to_owned(), r#"{"arm":["arm_joint1"]}"#.to_owned()),
        ]);
        let mut log = LogWriter::create(File::create(&path).unwrap(), 0, &attachments, metadata).unwrap();
        for i in 0..1000 {
            let state = JointState {
                name: vec!["arm_joint1".into()],
                position: vec![f64::from(i) / 100.0],
                velocity: vec![f64::NAN],
                ..JointState::default()
            };
            log.publish("/joint_states", 5_000_000_000 + u64::try_from(i).unwrap() * 10_000_000, &state).unwrap();
            log.flush_if_due(dimos_core::clock::Mono(u64::try_from(i).unwrap() * 10_000_000)).unwrap();
        }
        log.finish().unwrap();
        Log::open(&path).unwrap()
    }

    #[test]
    fn a_window_has_few_messages_with_their_times() {
        let folder = tempfile::tempdir().unwrap();
        let log = log(&folder);
        let read = |query: &str| -> Value { serde_json::from_str(&log.messages(query).unwrap()).unwrap() };
        let window = read("topics=/joint_states,/tf&from=2&to=4&points=4");
        let at: Vec<_> = window["messages"].as_array().unwrap().iter().map(|m| m["t"].as_f64().unwrap()).collect();
        assert_eq!(at, [2.0, 2.5, 3.0, 3.5, 4.0]);
        let first = &window["messages"][0];
        assert_eq!((&first["data"]["position"][0], &first["data"]["velocity"][0]), (&json!(2.0), &Value::Null));
        assert_eq!((window["length"].as_f64(), &window["live"]), (Some(9.99), &json!(false)));
        assert_eq!(read("topics=/joint_states&bare=1")["messages"].as_array().unwrap().len(), 1000);
        assert_eq!(
            read("topics=/joint_states&bare=1&points=0")["messages"][3],
            json!({"topic": "/joint_states", "t": 0.03, "data": null})
        );
        assert_eq!(read("topics=/joint_states&without=arm_joint1")["messages"], json!([]));
        assert_eq!(read("")["messages"], json!([]));
        assert!(log.answer("pose", "").is_none() && log.answer("messages", "from=x").is_some());
    }

    #[test]
    fn the_scene_has_the_arms_and_the_attached_meshes() {
        let folder = tempfile::tempdir().unwrap();
        let scene = log(&folder).scene();
        let json: Value = serde_json::from_str(&scene.json).unwrap();
        assert_eq!((&json["kind"], &json["name"], &json["arms"][0]["dof"]), (&json!("log"), &json!("cell"), &json!(1)));
        assert_eq!(json["log"]["start"], 5.0);
        let urdf = json["robots"][0]["urdf"].as_str().unwrap();
        assert!(urdf.contains("filename=\"/mesh/0\" scale") && urdf.contains("filename=\"/mesh/1-"), "{urdf}");
        assert!(
            matches!(&scene.meshes[1], MeshFile::Inside(name, bytes) if name == "package://a/b.stl" && bytes == b"solid")
        );
    }
}
