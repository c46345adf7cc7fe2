//! An action client of hiroz: sends trajectories to `traj_arm` of a run that is a node of ROS 2, and prints what came
//! back as JSON. `judge-hiroz PORT ARM`: port of the router, joints ARM_joint1 to 6.

use std::time::Duration;

use hiroz::Builder;
use hiroz::action::ZAction;
use hiroz::context::ZContextBuilder;
use hiroz::entity::{TypeHash, TypeInfo};
use hiroz::msg::{SerdeCdrSerdes, ZMessage, ZService};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// Declares messages that hiroz encodes.
macro_rules! messages {
    ($($name:ident { $($field:ident: $type:ty,)* })*) => {$(
        #[derive(Debug, Clone, Default, Serialize, Deserialize)]
        struct $name { $($field: $type,)* }
        impl ZMessage for $name {
            type Serdes = SerdeCdrSerdes<$name>;
        }
    )*};
}

messages! {
    Time { sec: i32, nanosec: u32, }
    Header { stamp: Time, frame_id: String, }
    Point { positions: Vec<f64>, velocities: Vec<f64>, accelerations: Vec<f64>, effort: Vec<f64>, time_from_start: Time, }
    Trajectory { header: Header, joint_names: Vec<String>, points: Vec<Point>, }
    Vector { x: f64, y: f64, z: f64, }
    Quaternion { x: f64, y: f64, z: f64, w: f64, }
    Transform { translation: Vector, rotation: Quaternion, }
    Twist { linear: Vector, angular: Vector, }
    MultiPoint { transforms: Vec<Transform>, velocities: Vec<Twist>, accelerations: Vec<Twist>, time_from_start: Time, }
    MultiTrajectory { header: Header, joint_names: Vec<String>, points: Vec<MultiPoint>, }
    Tolerance { name: String, position: f64, velocity: f64, acceleration: f64, }
    ComponentTolerance { joint_name: String, component: u16, position: f64, velocity: f64, acceleration: f64, }
    Goal {
        trajectory: Trajectory,
        multi_dof_trajectory: MultiTrajectory,
        path_tolerance: Vec<Tolerance>,
        component_path_tolerance: Vec<ComponentTolerance>,
        goal_tolerance: Vec<Tolerance>,
        component_goal_tolerance: Vec<ComponentTolerance>,
        goal_time_tolerance: Time,
    }
    Outcome { error_code: i32, error_string: String, }
    Feedback {
        header: Header,
        joint_names: Vec<String>,
        desired: Point,
        actual: Point,
        error: Point,
        multi_dof_joint_names: Vec<String>,
        multi_dof_desired: MultiPoint,
        multi_dof_actual: MultiPoint,
        multi_dof_error: MultiPoint,
    }
    Empty { structure_needs_at_least_one_member: u8, }
    Triggered { success: bool, message: String, }
}

fn type_info(name: &str, hash: &str) -> TypeInfo {
    let (package, name) = name.rsplit_once('/').expect("a name of ROS");
    let hash = TypeHash::from_rihs_string(&format!("RIHS01_{hash}")).expect("a hash of ROS");
    TypeInfo::new(&format!("{}::dds_::{name}_", package.replace('/', "::")), hash)
}

/// `control_msgs/action/FollowJointTrajectory` of Jazzy. The hashes are those of `tests/python/ros_types.py`.
struct FollowJointTrajectory;

impl ZAction for FollowJointTrajectory {
    type Goal = Goal;
    type Result = Outcome;
    type Feedback = Feedback;

    fn name() -> &'static str {
        "control_msgs/action/FollowJointTrajectory"
    }

    fn send_goal_type_info() -> TypeInfo {
        let hash = "b13789dddc325a7a962825c45e28c77d37237ec129dd0c34dc5994562938c57f";
        type_info("control_msgs/action/FollowJointTrajectory_SendGoal", hash)
    }

    fn get_result_type_info() -> TypeInfo {
        let hash = "e3ceb38e3e1867c8dc0f46014df26e90eb93422f27e9e97f936e07f94be4bc8b";
        type_info("control_msgs/action/FollowJointTrajectory_GetResult", hash)
    }

    fn cancel_goal_type_info() -> TypeInfo {
        type_info("action_msgs/srv/CancelGoal", "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a")
    }

    fn feedback_type_info() -> TypeInfo {
        let hash = "80398fcb9674a79081a9906e2ccf0c804dd7cb15e22e362e606ee87186beab71";
        type_info("control_msgs/action/FollowJointTrajectory_FeedbackMessage", hash)
    }

    fn status_type_info() -> TypeInfo {
        let hash = "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e";
        type_info("action_msgs/msg/GoalStatusArray", hash)
    }
}

/// `std_srvs/srv/Trigger`.
struct Trigger;

impl hiroz::ServiceTypeInfo for Trigger {
    fn service_type_info() -> TypeInfo {
        type_info("std_srvs/srv/Trigger", "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f")
    }
}

impl ZService for Trigger {
    type Request = Empty;
    type Response = Triggered;
}

fn goal(arm: &str, from: f64, to: f64, seconds: i32) -> Goal {
    let point = |first: f64, sec: i32| Point {
        positions: vec![first, 0.0, 0.0, 0.0, 0.0, 0.0],
        velocities: vec![0.0; 6],
        time_from_start: Time { sec, nanosec: 0 },
        ..Point::default()
    };
    let joint_names = (1..=6).map(|joint| format!("{arm}_joint{joint}")).collect();
    let points = vec![point(from, 0), point(to, seconds)];
    Goal { trajectory: Trajectory { joint_names, points, ..Trajectory::default() }, ..Goal::default() }
}

#[tokio::main]
async fn main() -> hiroz::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let port = arguments.next().expect("a port");
    let arm = arguments.next().expect("an arm");
    let context = ZContextBuilder::default().with_router_endpoint(format!("tcp/127.0.0.1:{port}"))?.build()?;
    let node = context.create_node("judge").build()?;
    let client = node.create_action_client::<FollowJointTrajectory>("traj_arm/follow_joint_trajectory").build()?;
    let mut seen = json!({"server": client.wait_for_server(Duration::from_secs(10)).await});

    let mut handle = client.send_goal(goal(&arm, 0.0, 0.4, 2)).await?;
    let mut feedback = handle.feedback().expect("the feedback of a new goal");
    let result = handle.result_with_timeout(Duration::from_secs(20)).await?;
    seen["result"] = json!([result.error_code, result.error_string]);
    let mut rows: Vec<Value> = Vec::new();
    while let Ok(message) = feedback.try_recv() {
        rows.push(json!([message.joint_names.len(), message.desired.positions[0], message.actual.positions[0]]));
    }
    seen["feedback"] = json!([rows.len(), rows.get(rows.len() / 2)]);

    let handle = client.send_goal(goal(&arm, 0.4, 1.4, 8)).await?;
    tokio::time::sleep(Duration::from_secs(1)).await;
    let cancelled = handle.cancel().await?;
    seen["cancel"] = json!([cancelled.return_code, cancelled.goals_canceling.len()]);
    let result = handle.result_with_timeout(Duration::from_secs(20)).await?;
    seen["cancelled"] = json!([result.error_code, result.error_string]);

    let stop = node.create_client::<Trigger>("dimos/stop").build()?;
    let stopped = stop.call_with_timeout(&Empty::default(), Duration::from_secs(5)).await?;
    seen["stop"] = json!([stopped.success, stopped.message]);
    println!("{seen}");
    Ok(())
}
