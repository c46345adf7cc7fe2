//! The targets, by what they read.

mod files;
mod logs;
mod models;
mod motions;
mod pages;
mod requests;
mod runs;
mod wires;

use crate::Target;

/// All targets.
pub const TARGETS: &[Target] = &[
    files::BLUEPRINT,
    files::CALIBRATION,
    files::OPTIONS,
    files::REPORT,
    models::URDF,
    models::XACRO,
    models::SRDF,
    models::MESH,
    models::POINTS,
    logs::MCAP,
    logs::CDR,
    logs::SCHEMA,
    requests::REQUEST,
    requests::REPLY,
    wires::DECODER,
    wires::CONTROLLER,
    pages::HTTP,
    pages::FOXGLOVE,
    motions::TRAJECTORY,
    motions::TIMING,
    motions::CURVE,
    runs::REQUESTS,
    wires::FRAMES,
];

/// Returns a text from bytes, as a reader of text gets it.
fn text(data: &[u8]) -> Option<&str> {
    std::str::from_utf8(data).ok()
}
