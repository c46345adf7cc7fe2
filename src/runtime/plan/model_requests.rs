//! The robots' models for clients: their description, and where their links are.

use nalgebra::Isometry3;

use crate::runtime::Service;
use dimos_log::display_messages::TFMessage;
use dimos_log::messages::Header;
use dimos_rpc::api::{DescriptionReport, TransformReport, TransformsReport};

impl Service {
    pub(in crate::runtime) fn robot_description(&self) -> DescriptionReport {
        let described = self.described();
        DescriptionReport { urdf: described.urdf.clone(), fixed: reports(described.robots.fixed(&Header::default())) }
    }

    pub(in crate::runtime) fn transforms(&self) -> TransformsReport {
        let arms: Vec<_> = (0..self.facts.names.arms.len()).map(|arm| self.tick.arm_view(arm)).collect();
        let measured = |arm: usize| Some(&arms.get(arm)?.as_ref()?.state).filter(|state| state.seq > 0);
        let positions: Vec<f64> = (self.facts.config.arms.iter().enumerate())
            .flat_map(|(arm, config)| (0..config.dof).map(move |joint| measured(arm)?.position.get(joint).copied()))
            .map(|position| position.unwrap_or(f64::NAN))
            .collect();
        let models = self.tcp_models();
        let tool = |joint: usize| -> Isometry3<f64> {
            let name = [self.facts.names.joint(joint as u16)];
            models.iter().flatten().find(|model| model.moves(&name)).and_then(|model| model.tool).unwrap_or_default()
        };
        let moved = self.described().robots.moved(&Header::default(), &positions, measured, tool);
        TransformsReport { stamp: self.wall_seconds(), transforms: reports(moved) }
    }
}

fn reports(message: TFMessage) -> Vec<TransformReport> {
    let report = |stamped: dimos_log::display_messages::TransformStamped| {
        let (t, q) = (stamped.transform.translation, stamped.transform.rotation);
        TransformReport {
            parent: stamped.header.frame_id,
            child: stamped.child_frame_id,
            xyz: [t.x, t.y, t.z],
            quat: [q.x, q.y, q.z, q.w],
        }
    };
    message.transforms.into_iter().map(report).collect()
}
