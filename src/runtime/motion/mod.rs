//! Motions, streams and chunks: checked, passed to the tick, planned again when blocked.

pub(in crate::runtime) mod chunk_requests;
pub(in crate::runtime) mod go_steps;
pub(in crate::runtime) mod going;
pub(in crate::runtime) mod motion_requests;
pub(in crate::runtime) mod motions;
pub(in crate::runtime) mod on_path;
pub(in crate::runtime) mod replan;
pub(in crate::runtime) mod stream_requests;
pub(in crate::runtime) mod streams;
pub(in crate::runtime) mod until;
