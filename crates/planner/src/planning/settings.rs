//! All settings of the planner. Each folder has those of its concern; a scene holds them, and passes them down.

use super::curve::settings::CurveSettings;
use super::ik::settings::{DragSettings, IkSettings, LineSettings};
use super::request::settings::{BlendSettings, GoalSettings, LookAheadSettings};
use super::scene::settings::PaddingSettings;
use super::search::settings::PlanSettings;
use super::timing::settings::{TimingSettings, ToolTimingSettings};
use crate::collision::CheckSettings;

/// Settings of the planner. Those of a request (seed, level, rounds of refinement) replace the ones here.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PlannerSettings {
    /// Collision checks.
    pub check: CheckSettings,
    /// Padding and its exceptions.
    pub padding: PaddingSettings,
    /// Goals.
    pub goals: GoalSettings,
    /// Inverse kinematics.
    pub ik: IkSettings,
    /// Straight lines of an end effector.
    pub line: LineSettings,
    /// Poses that a person drags.
    pub drag: DragSettings,
    /// Path search.
    pub plan: PlanSettings,
    /// Deviation at corners.
    pub blend: BlendSettings,
    /// Curves and their clock.
    pub curve: CurveSettings,
    /// Time parameterization.
    pub timing: TimingSettings,
    /// Speed limits of tools.
    pub tool: ToolTimingSettings,
    /// Checks of earlier motions.
    pub look_ahead: LookAheadSettings,
}
