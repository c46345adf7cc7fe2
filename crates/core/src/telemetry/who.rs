//! Who made a request.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Who made a request.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Who {
    /// The program: `dimos stop`, `python3 policy.py`, `a page of the live view`; over the network the client's
    /// identity and address: `alice on 10.0.0.5`.
    pub program: String,
    /// Its process on the run's computer, over the network that of the gateway; absent if the system does not report
    /// it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pid: Option<i32>,
    /// The user whose process it is; absent if the system does not report it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
}

impl fmt::Display for Who {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.program)?;
        match (self.pid, &self.user) {
            (Some(pid), Some(user)) => write!(f, " (pid {pid}, user {user})"),
            (Some(pid), None) => write!(f, " (pid {pid})"),
            (None, Some(user)) => write!(f, " (user {user})"),
            (None, None) => Ok(()),
        }
    }
}
