//! What the built-in blueprints know of a model beyond its description: shapes that are fuller than the arm, a pose.

use super::choice::Robot;
use crate::blueprint::{self, Catalog, Overrides};
use crate::offline::RobotConfig;
use dimos_robot::builtin::PREFIX;

/// What is known of a model.
#[derive(Debug, Default)]
pub struct Known {
    /// Pairs of links that are not checked against each other.
    pub exclusions: Vec<[String; 2]>,
    /// The named pose `home` [rad].
    pub home: Option<Vec<f64>>,
}

impl Known {
    /// Returns what a built-in blueprint with one planning robot of this model says, with or without its gripper.
    pub fn of(robot: &Robot, catalog: Catalog<'_>) -> Self {
        let Some(stem) = stem(&robot.path) else { return Self::default() };
        let same = configs(stem, catalog).into_iter().next();
        let Some(known) = same else { return Self::default() };
        let pairs = known.exclusions.into_iter().map(|(a, b)| [a, b]);
        let exclusions = pairs.filter(|pair| pair.iter().all(|link| robot.links.contains(link))).collect();
        let home = known.named_poses.get("home").filter(|_| known.joints == robot.joints).cloned();
        Self { exclusions, home }
    }
}

/// Returns what a built-in blueprint says of this model, if it has the joint of a gripper among those of the arm.
pub fn with_gripper_joint(path: &str, catalog: Catalog<'_>) -> Option<RobotConfig> {
    let is_same = |known: &RobotConfig| known.gripper_joint.is_some() && known.model_path.to_str() == Some(path);
    configs(stem(path)?, catalog).into_iter().find(is_same)
}

/// Returns the planned robots of this model, with or without its gripper, of the built-in blueprints that plan for one.
fn configs(stem: &str, catalog: Catalog<'_>) -> Vec<RobotConfig> {
    let mention = format!("model_path: {PREFIX}{stem}");
    let texts = blueprint::names().into_iter().filter_map(|name| blueprint::find(&format!("{PREFIX}{name}")).ok());
    let near = texts.filter(|found| String::from_utf8_lossy(&found.bytes).contains(&mention));
    let planners = near.filter_map(|found| blueprint::load(&found, &Overrides::default(), catalog).blueprint?.planner);
    let single = planners.filter_map(|planner| <[RobotConfig; 1]>::try_from(planner.robots).ok());
    let is_same = |known: &RobotConfig| known.model_path.to_str().and_then(self::stem) == Some(stem);
    single.flatten().filter(is_same).collect()
}

/// Returns the name of a built-in model without its gripper.
fn stem(path: &str) -> Option<&str> {
    let name = path.strip_prefix(PREFIX)?;
    Some(name.strip_suffix("_gripper").unwrap_or(name))
}
