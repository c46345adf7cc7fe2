//! The robot's own description: what the adapter takes from the URDF that an FR3 sends.

use super::model::{JointRange, Model};
use super::protocol::DOF;

/// Returns the name of the robot in a URDF.
pub fn name(urdf: &str) -> Option<&str> {
    attribute(element(urdf, "<robot", |_| true)?.0, "name")
}

/// Returns the ranges of the joints; `None` unless all of them are there. Accelerations are the model's: a URDF has
/// none.
pub fn ranges(urdf: &str, model: Model) -> Option<[JointRange; DOF]> {
    let mut ranges = model.ranges();
    for (i, range) in ranges.iter_mut().enumerate() {
        let suffix = format!("joint{}", i + 1);
        let (_, rest) =
            element(urdf, "<joint", |tag| attribute(tag, "name").is_some_and(|name| name.ends_with(&suffix)))?;
        let joint = rest.split("</joint>").next()?;
        let (limit, _) = element(joint, "<limit", |_| true)?;
        (range.lower, range.upper) = (number(limit, "lower")?, number(limit, "upper")?);
        range.velocity = number(limit, "velocity").filter(|velocity| *velocity > 0.0)?;
        if let Some((near, _)) = element(joint, "<position_based_velocity_limits", |_| true) {
            range.braking = Some((number(near, "velocity_offset")?, number(near, "deceleration_limit")?));
        }
        if range.lower >= range.upper {
            return None;
        }
    }
    Some(ranges)
}

/// Returns the first tag of a kind that `wanted` accepts, and the text after it.
fn element<'a>(text: &'a str, kind: &str, wanted: impl Fn(&str) -> bool) -> Option<(&'a str, &'a str)> {
    let mut rest = text;
    loop {
        let at = rest.find(kind)? + kind.len();
        let (tag, after) = rest.get(at..)?.split_once('>')?;
        if tag.starts_with(|c: char| c.is_whitespace()) && wanted(tag) {
            return Some((tag, after));
        }
        rest = after;
    }
}

/// Returns an attribute of a tag.
fn attribute<'a>(tag: &'a str, name: &str) -> Option<&'a str> {
    let mut words = tag.match_indices(name).filter_map(|(at, _)| {
        let before = tag.get(..at)?;
        before.ends_with(|c: char| c.is_whitespace()).then(|| tag.get(at + name.len()..))?
    });
    words.find_map(|rest| {
        let value = rest.trim_start().strip_prefix('=')?.trim_start();
        let quote = value.chars().next().filter(|c| matches!(c, '"' | '\''))?;
        value.get(1..)?.split(quote).next()
    })
}

fn number(tag: &str, name: &str) -> Option<f64> {
    attribute(tag, name)?.trim().parse().ok().filter(|value: &f64| value.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    const JOINTS: &str = r#"<robot name="fr3"><link name="base"/>"#;

    fn urdf(of: impl Fn(usize) -> String) -> String {
        (1..=7).fold(JOINTS.to_owned(), |text, joint| text + &of(joint)) + "</robot>"
    }

    #[test]
    fn ranges_are_those_of_the_description() {
        let text = urdf(|joint| {
            format!(
                "<joint name=\"fr3_joint{joint}\" type='revolute'>\n <limit effort=\"87\" lower = '-{joint}.5' \
                 upper=\"2.5\" velocity=\"1.5\"/>\n <position_based_velocity_limits velocity_offset=\"0.3\" \
                 deceleration_limit=\"6\"/></joint>"
            )
        });
        assert_eq!(name(&text), Some("fr3"));
        let ranges = ranges(&text, Model::Fr3).unwrap();
        assert_eq!((ranges[2].lower, ranges[2].upper, ranges[2].velocity), (-3.5, 2.5, 1.5));
        assert_eq!((ranges[0].braking, ranges[0].acceleration), (Some((0.3, 6.0)), 10.0));
    }

    #[test]
    fn a_description_without_a_joint_or_a_limit_is_none() {
        let limit = r#"<limit lower="-1" upper="1" velocity="1"/>"#;
        let whole = urdf(|joint| format!("<joint name=\"joint{joint}\">{limit}</joint>"));
        assert!(ranges(&whole, Model::Fr3).is_some());
        assert_eq!(ranges(&whole, Model::Fr3).unwrap()[0].braking, Model::Fr3.ranges()[0].braking);
        for (from, to) in
            [("joint7\"", "joint8\""), ("lower=\"-1\"", ""), ("upper=\"1\"", "upper=\"-2\""), ("\"1\"", "\"x\"")]
        {
            assert_eq!(ranges(&whole.replace(from, to), Model::Fr3), None, "{from}");
        }
        assert_eq!(ranges("", Model::Fr3), None);
        assert_eq!(name("<robot>"), None);
    }
}
