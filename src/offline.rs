//! Planning without a run: the one way of the verbs to the planner, for models, blueprints, recorded paths and logs.

use glamx::DAffine3;

use dimos_planner::collision::checker::Stop;
use dimos_planner::collision::world::World;
use dimos_planner::collision::{CheckSettings, ExactChecker};
use dimos_planner::planning::ik::Ik;
use dimos_planner::planning::scene::planning_scene::{always_touch, whole};
use dimos_robot::RobotModel;
use dimos_robot::kinematics::Kinematics;

pub use dimos_planner::collision::report::Contact;
pub use dimos_planner::planning::curve::fit::fit;
pub use dimos_planner::planning::curve::settings::FitSettings;
pub use dimos_planner::planning::ik::IkFailure;
pub use dimos_planner::planning::ik::settings::IkSettings;
pub use dimos_planner::planning::scene::config::{GripperJoint, ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
pub use dimos_planner::planning::scene::ignored_pairs::IgnoredPair;
pub use dimos_planner::planning::scene::planning_scene::{PlannedRobot, PlanningScene};
pub use dimos_planner::planning::search::path::{distance, length, unwind};
pub use dimos_planner::planning::search::thin::thin;
pub use dimos_planner::planning::timing::settings::TimingSettings;
pub use dimos_planner::planning::timing::time;

/// Pairs of links that are allowed to touch, by name.
pub type Allowed = Vec<(String, String)>;

/// Finds what touches, or is close.
pub struct Contacts(ExactChecker);

impl Contacts {
    /// Checks the robots and objects of a scene; pairs closer than `within` [m] count.
    pub fn of_scene(scene: &PlanningScene, within: f64) -> Self {
        Self(ExactChecker::new(scene.world.snapshot(), CheckSettings::default()).with_margin(within))
    }

    /// Checks a robot alone. Returns also the pairs that are not checked: they touch in every configuration. Fails if
    /// its shapes cannot be read.
    pub fn of_model(model: RobotModel, allowed: Allowed, within: f64) -> Result<(Self, Vec<[String; 2]>), String> {
        let mut body = whole(model, allowed)?;
        let unchecked = always_touch(&body);
        body.allowed.extend(unchecked.iter().cloned().map(<(String, String)>::from));
        let mut world = World::new();
        world.add_robot(body).map_err(|e| e.to_string())?;
        let checker = ExactChecker::new(world.snapshot(), CheckSettings::default()).with_margin(within);
        Ok((Self(checker), unchecked))
    }

    /// Returns the pairs that are close at joint positions, the closest first.
    pub fn at(&mut self, q: &[f64]) -> Vec<Contact> {
        let mut close: Vec<Contact> = self.0.closer_than_padding(q).into_iter().map(|(_, contact)| contact).collect();
        close.sort_by(|a, b| a.distance.total_cmp(&b.distance));
        close
    }
}

/// Returns the pairs of a robot's links that touch in every configuration. Fails if its shapes cannot be read.
pub fn always_touching(model: RobotModel, allowed: Allowed) -> Result<Vec<[String; 2]>, String> {
    Ok(always_touch(&whole(model, allowed)?))
}

/// Returns joint positions for a pose of a link, the closest to `seed` first, and the position error of that one [m].
pub fn solutions(
    kinematics: &Kinematics,
    link: usize,
    target: &DAffine3,
    seed: &[f64],
    settings: &IkSettings,
) -> Result<(Vec<Vec<f64>>, f64), IkFailure> {
    let mut ik = Ik::new(kinematics, link);
    let found = ik.closest(target, seed, settings, |_| true, &Stop::never())?;
    let error = ik.pose(found.first().map_or(&[], Vec::as_slice)).translation.distance(target.translation);
    Ok((found, error))
}
