//! The position of a task and of its parameters in a blueprint.

use crate::blueprint::resolve::Checker;
use crate::blueprint::schema::TaskEntry;
use dimos_yaml::{Located, NodeId};

/// Position of a task in its file.
pub(super) struct TaskPos<'e> {
    pub(super) entry: &'e Located<TaskEntry>,
    pub(super) params: Option<NodeId>,
}

impl TaskPos<'_> {
    /// Returns the node of a parameter, or of the task's type if the parameter is not written.
    pub(super) fn of(&self, checker: &Checker<'_>, key: &str) -> NodeId {
        self.params.and_then(|params| checker.tree.get(params, key)).unwrap_or(self.entry.kind.at)
    }

    /// Returns the nodes of a key in a parameter that is a group.
    pub(super) fn inner(&self, checker: &Checker<'_>, param: &str, key: &str) -> (NodeId, NodeId) {
        let at = self.of(checker, param);
        checker.tree.entry(at, key).unwrap_or((at, at))
    }
}
