//! Faces of the run to other systems, which the gateway serves: what becomes of them is an event of the run.

use crate::runtime::Service;
use dimos_core::telemetry::describe::{Described, Severity};
use dimos_rpc::api::FaceReport;

impl Service {
    /// Reports that a face of the gateway serves no more, or not at all.
    pub(in crate::runtime) fn report_face(&self, face: &FaceReport) {
        let reason = face.reason.as_deref().unwrap_or("no reason is known");
        let described = Described {
            kind: "share",
            severity: Severity::Error,
            status: "down",
            text: format!("{} does not serve: {reason}", face.face),
            arm: None,
            request: None,
            task: None,
            joint: None,
            values: Vec::new(),
            by: None,
        };
        self.report_now(&described, self.facts.wall);
    }
}
