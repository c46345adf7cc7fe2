//! Messages that 3D viewers and panels show without settings: transforms, markers, trajectories, diagnostics.

use super::messages::{Header, Point, Pose, Quaternion, Vector3};
use super::wire::{message, sequences};

message! {
    /// A span of time.
    "builtin_interfaces/msg/Duration" "builtin_interfaces/Duration" Duration {
        /// Whole seconds [s].
        sec: i32,
        /// Nanoseconds within the second [ns].
        nanosec: u32,
    }
}

impl Duration {
    /// Converts from seconds.
    pub fn of(seconds: f64) -> Self {
        let ns = (seconds.max(0.0) * 1e9).round() as u64;
        let sec = i32::try_from(ns / 1_000_000_000).unwrap_or(i32::MAX);
        Self { sec, nanosec: (ns % 1_000_000_000) as u32 }
    }
}

message! {
    /// Pose of a frame in another one.
    "geometry_msgs/msg/Transform" "geometry_msgs/Transform" Transform {
        /// Position [m].
        translation: Vector3,
        /// Orientation.
        rotation: Quaternion,
    }
}

message! {
    /// Pose of a frame at a time.
    "geometry_msgs/msg/TransformStamped" "geometry_msgs/TransformStamped" TransformStamped {
        /// Time, and the frame in which the pose is given.
        header: Header,
        /// Name of the frame.
        child_frame_id: String,
        /// Its pose.
        transform: Transform,
    }
}

message! {
    /// Poses of frames: links of robots, tool centre points.
    "tf2_msgs/msg/TFMessage" "tf2_msgs/TFMessage" TFMessage {
        /// The poses.
        transforms: Vec<TransformStamped>,
    }
}

message! {
    /// A colour; each value is 0–1.
    "std_msgs/msg/ColorRGBA" "std_msgs/ColorRGBA" ColorRGBA {
        /// Red.
        r: f32,
        /// Green.
        g: f32,
        /// Blue.
        b: f32,
        /// Opacity.
        a: f32,
    }
}

message! {
    /// An image. Not used.
    "sensor_msgs/msg/CompressedImage" "sensor_msgs/CompressedImage" CompressedImage {
        /// Time.
        header: Header,
        /// Format.
        format: String,
        /// Contents.
        data: Vec<u8>,
    }
}

message! {
    /// A point of a texture. Not used.
    "visualization_msgs/msg/UVCoordinate" "visualization_msgs/UVCoordinate" UVCoordinate {
        /// Across.
        u: f32,
        /// Down.
        v: f32,
    }
}

message! {
    /// A mesh file. Not used.
    "visualization_msgs/msg/MeshFile" "visualization_msgs/MeshFile" MeshFile {
        /// File name.
        filename: String,
        /// Contents.
        data: Vec<u8>,
    }
}

message! {
    /// A shape to show.
    "visualization_msgs/msg/Marker" "visualization_msgs/Marker" Marker {
        /// Time, and the frame of the pose.
        header: Header,
        /// `world/<object>` or `plan/<task>`.
        ns: String,
        /// Number within the namespace.
        id: i32,
        /// 1 box, 2 sphere, 3 cylinder, 4 line strip, 9 text, 10 mesh.
        r#type: i32,
        /// 0 add or change, 2 delete.
        action: i32,
        /// Pose.
        pose: Pose,
        /// Size along x, y, z [m]; the line's width is x.
        scale: Vector3,
        /// Colour.
        color: ColorRGBA,
        /// How long it is shown; 0 for ever.
        lifetime: Duration,
        /// Whether it moves with its frame.
        frame_locked: bool,
        /// Points of a line.
        points: Vec<Point>,
        /// Colours of the points. Not used.
        colors: Vec<ColorRGBA>,
        /// Not used.
        texture_resource: String,
        /// Not used.
        texture: CompressedImage,
        /// Not used.
        uv_coordinates: Vec<UVCoordinate>,
        /// Text.
        text: String,
        /// URL of the mesh.
        mesh_resource: String,
        /// Not used.
        mesh_file: MeshFile,
        /// Not used.
        mesh_use_embedded_materials: bool,
    }
}

message! {
    /// Shapes to show.
    "visualization_msgs/msg/MarkerArray" "visualization_msgs/MarkerArray" MarkerArray {
        /// The shapes that were added, changed or removed.
        markers: Vec<Marker>,
    }
}

message! {
    /// A point of a trajectory.
    "trajectory_msgs/msg/JointTrajectoryPoint" "trajectory_msgs/JointTrajectoryPoint" JointTrajectoryPoint {
        /// [rad].
        positions: Vec<f64>,
        /// [rad/s]; empty if not given.
        velocities: Vec<f64>,
        /// [rad/s²]; empty if not given.
        accelerations: Vec<f64>,
        /// Not used.
        effort: Vec<f64>,
        /// Time since the start of the motion.
        time_from_start: Duration,
    }
}

message! {
    /// An accepted motion.
    "trajectory_msgs/msg/JointTrajectory" "trajectory_msgs/JointTrajectory" JointTrajectory {
        /// Time of the tick that accepted it.
        header: Header,
        /// Its joints.
        joint_names: Vec<String>,
        /// Its points.
        points: Vec<JointTrajectoryPoint>,
    }
}

message! {
    /// A named value.
    "diagnostic_msgs/msg/KeyValue" "diagnostic_msgs/KeyValue" KeyValue {
        /// Name, with the unit.
        key: String,
        /// Value.
        value: String,
    }
}

message! {
    /// Condition of an arm, or of the tick.
    "diagnostic_msgs/msg/DiagnosticStatus" "diagnostic_msgs/DiagnosticStatus" DiagnosticStatus {
        /// 0 good, 1 warning, 2 error, 3 no state.
        level: u8,
        /// The arm, or `tick`.
        name: String,
        /// Phase and cause.
        message: String,
        /// The arm, or empty.
        hardware_id: String,
        /// Values.
        values: Vec<KeyValue>,
    }
}

message! {
    /// Condition of the run. Once a second, and when the phase of an arm changes.
    "diagnostic_msgs/msg/DiagnosticArray" "diagnostic_msgs/DiagnosticArray" DiagnosticArray {
        /// Time.
        header: Header,
        /// One for each arm, and one for the tick.
        status: Vec<DiagnosticStatus>,
    }
}

sequences! {
    TransformStamped => "geometry_msgs/TransformStamped[]";
    Point => "geometry_msgs/Point[]";
    ColorRGBA => "std_msgs/ColorRGBA[]";
    UVCoordinate => "visualization_msgs/UVCoordinate[]";
    Marker => "visualization_msgs/Marker[]";
    JointTrajectoryPoint => "trajectory_msgs/JointTrajectoryPoint[]";
    KeyValue => "diagnostic_msgs/KeyValue[]";
    DiagnosticStatus => "diagnostic_msgs/DiagnosticStatus[]";
}
