//! Joint poses that users save under a name: a file per blueprint in the user's configuration folder. It is read with
//! each request, so that an edited file counts at once, and two runs of one blueprint share it.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::planner_port::run_blocking;
use crate::blueprint::Blueprint;
use crate::runtime::{Service, internal};
use dimos_rpc::api::{self, SavedPose};
use dimos_rpc::{Code, RpcError};

/// Maximum number of poses per blueprint.
const MOST: usize = 1000;
/// Largest file that is read [bytes].
const LARGEST: u64 = 4_000_000;
const HEAD: &str = "# Saved with `dimos pose save`: joint positions [rad] by pose, arm and joint.\n";

/// Poses by name.
type Poses = BTreeMap<String, SavedPose>;

/// Returns the folder of the user's settings: `$XDG_CONFIG_HOME/dimos`, otherwise `~/.config/dimos`.
fn folder() -> Option<PathBuf> {
    let absolute = |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let settings = absolute("XDG_CONFIG_HOME").or_else(|| Some(absolute("HOME")?.join(".config")))?;
    Some(settings.join("dimos"))
}

/// Returns a number that is another one for another path: FNV-1a in 32 bits.
fn digest(bytes: &[u8]) -> u32 {
    bytes.iter().fold(0x811c_9dc5, |sum: u32, byte| (sum ^ u32::from(*byte)).wrapping_mul(0x0100_0193))
}

/// The file of a blueprint's poses.
#[derive(Debug, Clone)]
struct PoseFile(PathBuf);

impl PoseFile {
    fn of(blueprint: &Blueprint) -> Result<Self, RpcError> {
        // A blueprint's name may have any character.
        let plain = |c: char| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '_' };
        let mut name: String = blueprint.name.chars().map(plain).collect();
        // Two cells may have a file of the same name, and other poses. A shipped blueprint is in no file.
        let file = blueprint.sources.first().and_then(|(file, _)| std::fs::canonicalize(file).ok());
        if let Some(file) = file {
            name.push_str(&format!("-{:08x}", digest(file.as_os_str().as_encoded_bytes())));
        }
        let folder = folder().ok_or_else(|| {
            RpcError::new(Code::Unsupported, "no folder for poses: neither XDG_CONFIG_HOME nor HOME is set")
                .hint("set one of them to an absolute path")
        })?;
        Ok(Self(folder.join("poses").join(format!("{name}.yaml"))))
    }

    fn error(&self, what: &str, why: &dyn std::fmt::Display) -> RpcError {
        RpcError::new(Code::Unsupported, format!("{}: {what}: {why}", self.0.display()))
            .hint("correct the file, move it away, or check its permissions")
    }

    fn read(&self) -> Result<Poses, RpcError> {
        let text = match std::fs::metadata(&self.0) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Poses::new()),
            Ok(found) if !found.is_file() || found.len() > LARGEST => {
                return Err(self.error("cannot be read", &"it is no file, or too large"));
            }
            _ => std::fs::read_to_string(&self.0).map_err(|e| self.error("cannot be read", &e))?,
        };
        let poses: Option<Poses> =
            serde_yaml::from_str(&text).map_err(|e| self.error("is not a list of saved poses", &e))?;
        let poses = poses.unwrap_or_default();
        let values = || poses.values().flat_map(BTreeMap::values).flat_map(BTreeMap::values);
        match values().all(|q| q.is_finite()) {
            true => Ok(poses),
            false => Err(self.error("is not a list of saved poses", &"a position is not finite")),
        }
    }

    fn write(&self, poses: &Poses) -> Result<(), RpcError> {
        let write = || {
            let text = serde_yaml::to_string(poses).map_err(std::io::Error::other)?;
            let folder = self.0.parent().unwrap_or(&self.0);
            std::fs::create_dir_all(folder)?;
            // Readers find the old file or the new one, never a partial one.
            let fresh = self.0.with_extension(format!("yaml.{}", std::process::id()));
            std::fs::write(&fresh, format!("{HEAD}{text}"))?;
            std::fs::rename(&fresh, &self.0)
        };
        write().map_err(|e| self.error("cannot be written", &e))
    }
}

impl Service {
    fn pose_file(&self) -> Result<PoseFile, RpcError> {
        PoseFile::of(&self.facts.blueprint)
    }

    /// Returns the saved poses.
    pub(in crate::runtime) async fn poses(&self) -> Result<api::PosesReport, RpcError> {
        let file = self.pose_file()?;
        let path = file.0.display().to_string();
        let poses = run_blocking(move || file.read()).await??;
        Ok(api::PosesReport { poses, file: path })
    }

    /// Saves the measured joint positions of arms under a name.
    pub(in crate::runtime) async fn save_pose(&self, call: api::PoseSave) -> Result<api::PoseSaved, RpcError> {
        let robots = self.facts.blueprint.planner.iter().flat_map(|planner| &planner.robots);
        if let Some(robot) = robots.into_iter().find(|robot| robot.named_poses.contains_key(&call.name)) {
            let what = format!("{} has a named pose {} in the blueprint", robot.name, call.name);
            return Err(RpcError::new(Code::InvalidParams, what).hint("choose another name"));
        }
        let names = &self.facts.names.arms;
        let wanted = match call.arms.is_empty() {
            true => (0..names.len() as u16).collect(),
            false => call.arms.iter().map(|id| self.facts.arm_index(id)).collect::<Result<Vec<u16>, _>>()?,
        };
        let mut pose = SavedPose::new();
        for arm in wanted {
            let name = names.get(arm as usize).ok_or_else(internal)?;
            let view = self.tick.arm_view(arm as usize).filter(|view| view.state.seq > 0).ok_or_else(|| {
                RpcError::new(Code::StartStateUnavailable, format!("{}: no state so far", name.hardware_id))
                    .hint("`dimos status` shows its link")
            })?;
            let joints = name.joints.iter().cloned().zip(view.state.position);
            pose.insert(name.hardware_id.clone(), joints.collect());
        }
        let file = self.pose_file()?;
        let (name, saved) = (call.name.clone(), pose.clone());
        let replaced = run_blocking(move || {
            let mut poses = file.read()?;
            if poses.len() >= MOST && !poses.contains_key(&name) {
                return Err(RpcError::new(Code::Unsupported, format!("{MOST} poses are saved, which is the most"))
                    .hint("remove some: `dimos pose remove NAME`"));
            }
            let replaced = poses.insert(name, saved).is_some();
            file.write(&poses).map(|()| replaced)
        })
        .await??;
        Ok(api::PoseSaved { name: call.name, pose, replaced })
    }

    /// Removes a saved pose.
    pub(in crate::runtime) async fn remove_pose(&self, call: api::PoseRemove) -> Result<(), RpcError> {
        let file = self.pose_file()?;
        run_blocking(move || {
            let mut poses = file.read()?;
            if poses.remove(&call.name).is_none() {
                let names: Vec<&String> = poses.keys().collect();
                return Err(RpcError::unknown(Code::InvalidParams, "saved pose", &call.name, &names));
            }
            file.write(&poses)
        })
        .await?
    }

    /// Replaces the names of saved poses in a planning request by their positions. Names that the planner knows stay.
    pub(in crate::runtime) async fn with_saved_poses(&self, mut plan: api::Plan) -> Result<api::Plan, RpcError> {
        let named = |goal: &api::PlanGoal| goal.named.is_some();
        if !plan.goals.iter().chain(&plan.through).any(named) {
            return Ok(plan);
        }
        let file = self.pose_file()?;
        let saved = run_blocking(move || file.read()).await??;
        if saved.is_empty() {
            return Ok(plan);
        }
        let robots = self.robots().await?;
        for goal in plan.goals.iter_mut().chain(&mut plan.through) {
            let Some(robot) = robots.iter().find(|robot| robot.name == goal.robot) else { continue };
            let Some(name) = goal.named.as_ref().filter(|name| !robot.named_poses.contains_key(*name)) else {
                continue;
            };
            let Some(pose) = saved.get(name) else {
                let names: Vec<&String> = robot.named_poses.keys().chain(saved.keys()).collect();
                return Err(RpcError::unknown(Code::InvalidParams, "pose", name, &names));
            };
            let position = |joint: &String| pose.values().find_map(|arm| arm.get(joint)).copied();
            let joints = robot.joints.iter().map(|joint| position(joint).ok_or(joint)).collect::<Result<Vec<_>, _>>();
            let joints = joints.map_err(|joint| {
                let name = goal.named.clone().unwrap_or_default();
                RpcError::new(Code::InvalidParams, format!("the saved pose {name} has no position of {joint}"))
                    .hint(format!("save it again: `dimos pose save {name}`"))
            })?;
            (goal.joints, goal.named) = (Some(joints), None);
        }
        Ok(plan)
    }
}
