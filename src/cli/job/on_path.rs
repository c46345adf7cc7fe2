//! Acts at places of a motion's path, as a job has them.

use super::file::{Reader, times};
use super::keys;
use super::step::{Act, Motion};
use crate::cli::arguments::{finite, speed};
use crate::cli::grip::opening;
use dimos_rpc::api::{ArmIoSet, GoGripper, OnPath};
use dimos_yaml::NodeId;

impl Reader {
    /// Reads the acts at places of a motion's path.
    pub(super) fn acts(&mut self, motion: NodeId, of: &Motion) -> Option<Vec<OnPath>> {
        let Some((key, list)) = self.tree.entry(motion, "on_path") else { return Some(Vec::new()) };
        if of.direct || of.replan {
            return self.wrong(key, "acts on a path belong to one planned path", Some("leave out `direct`, `replan`"));
        }
        let items = self.tree.items(list).to_vec();
        if items.is_empty() {
            return self.wrong(list, "expected a list of acts", Some("[{distance: 0.1, gripper: open}]"));
        }
        items.into_iter().map(|item| self.act_on_path(item)).collect()
    }

    fn act_on_path(&mut self, node: NodeId) -> Option<OnPath> {
        self.group(node, &keys::ON_PATH)?;
        let count = |keys: &[&str]| keys.iter().filter(|key| self.tree.get(node, key).is_some()).count();
        if count(&["distance", "waypoint"]) != 1 || count(&["gripper", "output", "speed"]) != 1 {
            let hint =
                "{distance: 0.1, gripper: open}, {waypoint: 2, output: {do0: high}}, {distance: 0.2, speed: 50%}";
            return self.wrong(node, "needs a place (distance [m] or waypoint) and an act", Some(hint));
        }
        let mut act = OnPath {
            distance: self.at(node, "distance", finite),
            waypoint: self.at(node, "waypoint", times).map(|number| number as usize),
            speed: self.at(node, "speed", speed),
            ..OnPath::default()
        };
        if let Some(gripper) = self.tree.get(node, "gripper") {
            let (mut arm, mut force, mut to) = (String::new(), None, Some(gripper));
            if self.tree.text(gripper).is_none() {
                self.group(gripper, &keys::FINGERS)?;
                self.arm(gripper, &mut arm);
                (force, to) = (self.at(gripper, "force", finite), self.tree.get(gripper, "to"));
            }
            let Some(to) = to else {
                return self.wrong(gripper, "the key `to` is missing", Some("to: open, close, or m or rad"));
            };
            let to = self.parsed(to, opening)?.into();
            act.gripper = Some(GoGripper { arm, to, force, speed: None, timeout: None, objects: None });
        }
        if let Some(output) = self.tree.get(node, "output") {
            let mut arm = String::new();
            let Act::Output(outputs) = self.output(output, &mut arm)? else { return None };
            act.output = Some(ArmIoSet { arm, outputs });
        }
        Some(act)
    }
}
