//! Conditions that end a motion before its goal, as a job has them.

use super::file::{Reader, level};
use super::keys;
use super::step::Motion;
use crate::cli::arguments::{duration, finite};
use dimos_rpc::api::Until;
use dimos_yaml::NodeId;

impl Reader {
    /// Reads the obstacles that a motion may touch.
    pub(super) fn touch(&mut self, motion: NodeId) -> Option<Vec<String>> {
        let Some(list) = self.tree.get(motion, "touch") else { return Some(Vec::new()) };
        self.tree.items(list).to_vec().into_iter().map(|item| self.parsed(item, super::file::word)).collect()
    }

    /// Reads the conditions of a motion; the outer `None`: they are wrong.
    #[expect(clippy::option_option, reason = "wrong, or not given")]
    pub(super) fn until(&mut self, motion: NodeId, of: &Motion) -> Option<Option<Until>> {
        let Some((key, node)) = self.tree.entry(motion, "until") else { return Some(None) };
        if of.replan {
            return self.wrong(key, "conditions belong to one motion", Some("leave out `replan`"));
        }
        self.group(node, &keys::UNTIL)?;
        let high = self.at(node, "is", level).unwrap_or(true);
        let input = match self.tree.get(node, "input") {
            Some(input) => Some(self.parsed(input, super::file::digital_input)?),
            None if self.tree.get(node, "is").is_some() => {
                return self.wrong(node, "`is` is the level of an `input`", Some("{input: di0, is: low}"));
            }
            None => None,
        };
        let until = Until {
            force: self.at(node, "force", finite),
            torque: self.at(node, "torque", finite),
            input: input.map(|input| if high { input } else { format!("{input}:low") }),
            distance: self.at(node, "distance", finite),
            time: self.at(node, "time", duration).map(|time| time.as_secs_f64()),
            ..Until::default()
        };
        if of.direct && until.distance.is_some() {
            return self.wrong(node, "`distance` is known of a planned motion only", Some("use `time`"));
        }
        match until.valid() {
            Ok(()) => Some(Some(until)),
            Err(what) => self.wrong(node, what, Some("until: {force: 5}, {input: di0}, {time: 2s}")),
        }
    }
}
