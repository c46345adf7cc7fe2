//! Conditions that end a motion of a step before its goal.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::{EndedBy, GoStep};
use dimos_core::arm::channel;
use dimos_core::trajectory::MAX_DURATION;
use dimos_core::until::Condition;

/// What ends the motion of a step before its goal: whichever is met first, judged in each tick. The arm then
/// decelerates along its path. The next step begins only if one of these has ended it: force, torque or input, or, if
/// none of them is given, distance or time.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Until {
    /// Index of the step, from 0.
    #[serde(default, skip_serializing_if = "is_first")]
    pub step: usize,
    /// The arm whose sensor and inputs count; default: the only one that moves.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
    /// Magnitude of the force that its controller reports, less what was tared [N].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force: Option<f64>,
    /// Magnitude of the torque [Nm].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub torque: Option<f64>,
    /// A digital input that becomes high: `di0`; `di0:low` for one that becomes low.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub input: Option<String>,
    /// Way that the tool centre point has covered [m]: of a planned motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
    /// Time since the motion began [s].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time: Option<f64>,
    /// Stiffness of what is touched and of what touches it, together [N/mm]: the report of the step then has the `peak`
    /// of the force that is to be expected. Of a planned motion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stiffness: Option<f64>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde asks")]
fn is_first(step: &usize) -> bool {
    *step == 0
}

impl Until {
    /// Reads conditions from `KEY=VALUE`, each key once: `force=5`, `input=di0:low`.
    pub fn parse(texts: &[String]) -> Result<Self, String> {
        let mut until = Self::default();
        for text in texts {
            let (key, value) = text.split_once('=').ok_or_else(|| format!("{text:?} is not KEY=VALUE"))?;
            let number = match key {
                "force" => &mut until.force,
                "torque" => &mut until.torque,
                "distance" => &mut until.distance,
                "stiffness" => &mut until.stiffness,
                "time" => &mut until.time,
                "input" if until.input.is_none() => {
                    until.input = Some(value.to_owned());
                    continue;
                }
                "input" => return Err("input is given twice".to_owned()),
                _ => return Err(format!("unknown condition {key:?}: force, torque, input, distance or time")),
            };
            let parsed: f64 = value.parse().map_err(|_| format!("{key}: {value:?} is not a number"))?;
            if number.replace(parsed).is_some() {
                return Err(format!("{key} is given twice"));
            }
        }
        until.valid()?;
        Ok(until)
    }

    /// Returns the number of the awaited input, and its level (`true`: high).
    pub fn level(&self) -> Option<(u8, bool)> {
        let text = self.input.as_deref()?;
        let (name, level) = text.split_once(':').unwrap_or((text, "high"));
        let high = match level {
            "high" => true,
            "low" => false,
            _ => return None,
        };
        Some((channel(name, "di")?, high))
    }

    /// Returns whether this is how the motion was to end.
    pub fn is_awaited(&self, ended_by: EndedBy) -> bool {
        let touches = self.force.is_some() || self.torque.is_some() || self.input.is_some();
        match ended_by {
            EndedBy::Force | EndedBy::Torque | EndedBy::Input => true,
            EndedBy::Distance | EndedBy::Time => !touches,
            _ => false,
        }
    }

    /// Checks the values alone.
    pub fn valid(&self) -> Result<(), String> {
        let numbers = [("force", self.force, "N"), ("torque", self.torque, "Nm"), ("distance", self.distance, "m")];
        let more = [("time", self.time, "s"), ("stiffness", self.stiffness, "N/mm")];
        for (key, value, unit) in numbers.into_iter().chain(more) {
            if let Some(value) = value.filter(|value| !(*value > 0.0 && value.is_finite())) {
                return Err(format!("{key} is {value}, must be above 0 {unit}"));
            }
        }
        if let Some(time) = self.time.filter(|time| *time > MAX_DURATION) {
            return Err(format!("time is {time} s, may be {MAX_DURATION} s"));
        }
        if self.stiffness.is_some() && self.force.is_none() {
            return Err("stiffness is about a force: add `force`".to_owned());
        }
        if let (Some(text), None) = (&self.input, self.level()) {
            return Err(format!("input is {text:?}, must be a digital input such as di0 or di0:low"));
        }
        match (self.force, self.torque, self.distance, self.time, &self.input) {
            (None, None, None, None, None) => Err("needs one of force, torque, input, distance, time".to_owned()),
            _ => Ok(()),
        }
    }
}

impl From<Condition> for EndedBy {
    fn from(condition: Condition) -> Self {
        match condition {
            Condition::Force => Self::Force,
            Condition::Torque => Self::Torque,
            Condition::Input => Self::Input,
            Condition::Distance => Self::Distance,
            Condition::Time => Self::Time,
        }
    }
}

/// Checks conditions against the steps of their request.
pub(crate) fn valid(until: &[Until], steps: &[GoStep], replan: bool) -> Result<(), String> {
    if replan && !until.is_empty() {
        return Err("conditions belong to one motion: leave out `replan` or `until`".into());
    }
    until.iter().enumerate().try_for_each(|(index, one)| {
        let wrong = |what: String| Err(format!("until[{index}]: {what}"));
        if until.iter().take(index).any(|before| before.step == one.step) {
            return wrong(format!("step {} has conditions already: put them together", one.step));
        }
        match steps.get(one.step) {
            None | Some(GoStep::Gripper(_)) => return wrong("its step is no motion".to_owned()),
            Some(GoStep::Move(_) | GoStep::Execute(_)) if one.distance.is_some() || one.stiffness.is_some() => {
                return wrong("distance and stiffness are for planned motions: use time".to_owned());
            }
            Some(_) => {}
        }
        one.valid().or_else(wrong)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(texts: &[&str]) -> Result<Until, String> {
        Until::parse(&texts.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn conditions_are_read_and_mistakes_are_named() {
        let until = parse(&["force=5", "input=di3:low", "time=2.5"]).unwrap();
        assert_eq!((until.force, until.level(), until.time), (Some(5.0), Some((3, false)), Some(2.5)));
        assert_eq!(parse(&["input=di0"]).unwrap().level(), Some((0, true)));
        for (texts, what) in [
            (&["force"][..], "not KEY=VALUE"),
            (&["force=five"], "not a number"),
            (&["force=-1"], "must be above 0 N"),
            (&["force=nan"], "must be above 0 N"),
            (&["force=1", "force=2"], "given twice"),
            (&["weight=1"], "unknown condition"),
            (&["input=do0"], "must be a digital input"),
            (&["input=di0:up"], "must be a digital input"),
            (&["time=1e9"], "may be"),
            (&[], "needs one of"),
        ] {
            let error = parse(texts).unwrap_err();
            assert!(error.contains(what), "{texts:?}: {error}");
        }
    }

    #[test]
    fn a_time_is_awaited_only_if_nothing_is_to_be_touched() {
        let touch = parse(&["force=5", "time=2"]).unwrap();
        assert!(touch.is_awaited(EndedBy::Force) && !touch.is_awaited(EndedBy::Time));
        assert!(!touch.is_awaited(EndedBy::Goal) && parse(&["time=2"]).unwrap().is_awaited(EndedBy::Time));
    }
}
