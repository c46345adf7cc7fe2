//! Moves of the tool by a distance, for an xArm of a run: straight lines through joint positions, from the vendor's
//! kinematics.

use super::run_link::View;
use dimos_arms::xarm::emulator::{Frame, Line, Links, MoveRequest, Target};
use dimos_hardware::sim::reach::Chain;

/// Longest distance of a tool's centre point from the flange [m].
const LONGEST_TOOL: f64 = 0.6;

/// Returns the line that a request asks for, from joints [rad] on. The tool's centre point is where the device has it,
/// as for the program. `None` for a pose in the base or tool frame, an arm whose pose is unknown, and where the arm
/// cannot follow.
pub fn of(links: Links, view: &View, from: &[f64; 7], request: &MoveRequest) -> Option<Line> {
    let Target::Pose(values, frame @ Frame::Start, orientation) = request.target else { return None };
    let tool = links.forward(view.position.first_chunk::<7>()?).inverse() * view.pose?;
    if tool.translation.vector.norm() > LONGEST_TOOL {
        return None; // the box has another base frame
    }
    let goal = frame.goal(&(links.forward(from) * tool), values, orientation)?;
    Line::new(links, &tool, from, &goal)
}
