//! Straight lines of the end effector.
