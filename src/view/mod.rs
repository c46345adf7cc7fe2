//! The live view: a page in the browser that shows the arms of a run and commands them. It is one more client of the
//! run's socket, with the leases, limits and refusals of every client. The same page shows what is not live: a log, a
//! robot model ([`Subject`]).
//!
//! ```text
//!  browser ── GET / ─────────▶ the page, compressed in the program
//!          ── GET /scene.json, /mesh/N ─▶ robot descriptions, read when they are asked for
//!          ◀─ WebSocket /rpc ─▶ bridge ◀── one connection per page ──▶ the run's socket
//! Foxglove ◀─ WebSocket /foxglove ─▶ foxglove ◀── the same, to read only ──▶
//! ```
//!
//! One thread of ordinary priority serves all pages. The run does not wait for it, and continues without it.

#[cfg(feature = "view")]
mod access;
#[cfg(feature = "view")]
mod bridge;
#[cfg(feature = "view")]
mod foxglove;
#[cfg(feature = "view")]
mod page_urdf;
#[cfg(feature = "view")]
mod scene;
#[cfg(feature = "view")]
mod server;
mod shown;
#[cfg(feature = "view")]
mod socket;
#[cfg(feature = "view")]
mod stl;
#[cfg(feature = "view")]
mod subject;
#[cfg(not(feature = "view"))]
mod without_view;

#[cfg(feature = "view")]
pub use foxglove::foxglove_url;
#[cfg(feature = "view")]
pub use scene::{MeshFile, Scene};
#[cfg(feature = "view")]
pub use server::View;
#[cfg(feature = "view")]
pub(crate) use shown::robots;
pub use shown::{Shown, ShownArm, ShownGripper, ShownRobot};
#[cfg(feature = "view")]
pub use subject::{Subject, value};
#[cfg(not(feature = "view"))]
pub use without_view::{View, foxglove_url};

use crate::blueprint::Blueprint;
use crate::blueprint::planner::{ViewBackend, ViewConfig};

/// Returns how the view of a run is served: as the blueprint says, else by default if it has a robot model. `None`:
/// not at all.
pub fn config_of(blueprint: &Blueprint) -> Option<ViewConfig> {
    let has_model = blueprint.planner.as_ref().is_some_and(|planner| !planner.robots.is_empty())
        || blueprint.tasks.iter().any(|task| task.robot.is_some());
    let config = blueprint.view.clone().or_else(|| has_model.then(ViewConfig::default));
    config.filter(|config| config.backend != ViewBackend::None)
}
