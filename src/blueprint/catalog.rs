//! The adapters and task types that a blueprint may use.

use dimos_control::task_spec::TaskTable;
use dimos_hardware::registry::Registry;

/// The tables that a blueprint is checked against.
#[derive(Debug, Clone, Copy)]
pub struct Catalog<'a> {
    /// Adapters.
    pub adapters: &'a Registry,
    /// Task types.
    pub tasks: &'a TaskTable,
}

static BUILT_IN: TaskTable = TaskTable::builtin();

/// These adapters and the built-in task types.
impl<'a> From<&'a Registry> for Catalog<'a> {
    fn from(adapters: &'a Registry) -> Self {
        Self { adapters, tasks: &BUILT_IN }
    }
}
