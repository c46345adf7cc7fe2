//! Curves: smooth paths in joint space, and the quickest motion along them.
//!
//! A straight line of a tool, a circle, a recorded path, or several of them with blends between are each one
//! [`JointCurve`] through configurations, and are timed as such ([`clock`]): not as the polyline of these
//! configurations, whose corners would have to be blended one by one.

pub mod clock;
pub mod fit;
pub mod join;
pub mod joint_curve;
pub mod motion;
pub mod settings;
pub mod tool_path;
