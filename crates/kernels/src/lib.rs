//! Computation in lanes: sixteen configurations of an arm at a time, in single precision, on the widest vectors that
//! the processor has. A package of its own, because cargo optimizes whole packages: this one is compiled for speed in
//! every profile, tests included.
//!
//! The states of motions alone are in double precision, eight joints at a time ([`states`]).
//!
//! Every kernel is written once, over [`block::Block`], and compiled for each width. The result does not depend on the
//! width, bit for bit: a block always has sixteen lanes, and every width computes the same operations in the same
//! order. Nor does it depend on the C library: its sines are replaced here ([`c_math`]).

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable))]

pub mod apart;
pub mod block;
pub mod bodies;
mod c_math;
pub mod chain;
pub mod cover;
pub mod discrete;
pub mod halton;
pub mod ik;
pub mod nearest;
pub mod obstacle;
pub mod path_clock;
pub mod states;
pub mod support;
pub mod trig;
mod width;

pub use width::Width;
