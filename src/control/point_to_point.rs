//! point_to_point
