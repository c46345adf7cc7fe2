//! The keys of jobs: what the reader takes, and what `assets/job.schema.json` is made of.

#![cfg_attr(not(test), allow(dead_code, reason = "only the test that makes the schema reads the values"))]

/// What may be the value of a key, or a step.
#[derive(Debug, Clone, Copy)]
pub enum Value {
    /// A name, or any other text.
    Text,
    /// `true` or `false`.
    Flag,
    /// A number in the unit that the page says.
    Number,
    /// A fraction or a percentage: `0.3`, `30%`.
    Speed,
    /// `500ms`, `1m 30s`, or a number of seconds.
    Time,
    /// This many numbers; 0: one or more.
    Numbers(usize),
    /// `open`, `close`, or a number.
    Opening,
    /// `high` or `low`, 1 or 0.
    Level,
    /// `di0`, `di1`, …
    Input,
    /// A number of repetitions.
    Times,
    /// Just this word.
    Word(&'static str),
    /// Names.
    Names,
    /// Digital and analogue outputs by name, and `arm`.
    Outputs,
    /// A list of steps.
    Steps,
    /// Two or more of these.
    Waypoints(&'static Group),
    /// One or more of these.
    Acts(&'static Group),
    /// Keys.
    Keys(&'static Group),
    /// One of these.
    Either(&'static [Value]),
}

/// Keys that belong together.
#[derive(Debug)]
pub struct Group {
    /// Their names and values.
    pub keys: &'static [(&'static str, Value)],
    /// Those that must be there.
    pub required: &'static [&'static str],
}

impl Group {
    /// Returns the names of the keys.
    pub fn names(&self) -> Vec<&'static str> {
        self.keys.iter().map(|(name, _)| *name).collect()
    }
}

use Value::*;

/// The file.
pub static JOB: Group = Group {
    keys: &[
        ("arm", Text),
        ("speed", Speed),
        ("direct", Flag),
        ("replan", Flag),
        ("repeat", Either(&[Times, Word("forever")])),
        ("on_fault", Either(&[Word("stop"), Steps])),
        ("steps", Steps),
    ],
    required: &["steps"],
};
/// A step has one of these; `reset` and `enable` may have no value.
pub static STEPS: Group = Group {
    keys: &[
        ("move", Either(&[Text, Keys(&MOTION)])),
        ("through", Either(&[Waypoints(&WAYPOINT), Keys(&THROUGH)])),
        ("gripper", Either(&[Opening, Keys(&GRIPPER)])),
        ("wait", Either(&[Time, Keys(&INPUT)])),
        ("output", Outputs),
        ("repeat", Keys(&REPEAT)),
        ("attach", Either(&[Text, Keys(&ATTACH)])),
        ("detach", Text),
        ("reset", Text),
        ("enable", Text),
    ],
    required: &[],
};
/// `move`.
pub static MOTION: Group = Group {
    keys: &[
        ("named", Text),
        ("joints", Numbers(0)),
        ("pose", Keys(&POSE)),
        ("by", Keys(&POSE)),
        ("frame", Text),
        ("linear", Flag),
        ("via", Numbers(3)),
        ("speed", Speed),
        ("tcp_speed", Number),
        ("direct", Flag),
        ("replan", Flag),
        ("on_path", Acts(&ON_PATH)),
        ("until", Keys(&UNTIL)),
        ("touch", Names),
        ("arm", Text),
    ],
    required: &[],
};
/// An act at a place of the path.
pub static ON_PATH: Group = Group {
    keys: &[
        ("distance", Number),
        ("waypoint", Times),
        ("gripper", Either(&[Opening, Keys(&FINGERS)])),
        ("output", Outputs),
        ("speed", Speed),
    ],
    required: &[],
};
/// What ends a motion before its goal.
pub static UNTIL: Group = Group {
    keys: &[
        ("force", Number),
        ("torque", Number),
        ("input", Input),
        ("is", Level),
        ("distance", Number),
        ("time", Time),
    ],
    required: &[],
};
/// `gripper` at a place of the path.
pub static FINGERS: Group = Group { keys: &[("to", Opening), ("force", Number), ("arm", Text)], required: &["to"] };
/// A waypoint that is not just a name.
pub static WAYPOINT: Group = Group {
    keys: &[
        ("named", Text),
        ("joints", Numbers(0)),
        ("pose", Keys(&POSE)),
        ("frame", Text),
        ("linear", Flag),
        ("via", Numbers(3)),
    ],
    required: &[],
};
/// `through`.
pub static THROUGH: Group = Group {
    keys: &[
        ("waypoints", Waypoints(&WAYPOINT)),
        ("blend", Number),
        ("speed", Speed),
        ("tcp_speed", Number),
        ("replan", Flag),
        ("on_path", Acts(&ON_PATH)),
        ("until", Keys(&UNTIL)),
        ("touch", Names),
        ("arm", Text),
    ],
    required: &["waypoints"],
};
/// A pose.
pub static POSE: Group =
    Group { keys: &[("xyz", Numbers(3)), ("rpy", Numbers(3)), ("quat", Numbers(4))], required: &["xyz"] };
/// `gripper`.
pub static GRIPPER: Group = Group {
    keys: &[("to", Opening), ("force", Number), ("object", Flag), ("timeout", Time), ("arm", Text)],
    required: &["to"],
};
/// `wait` for an input.
pub static INPUT: Group =
    Group { keys: &[("input", Input), ("is", Level), ("timeout", Time), ("arm", Text)], required: &["input"] };
/// `repeat` as a step.
pub static REPEAT: Group = Group { keys: &[("times", Times), ("steps", Steps)], required: &["times", "steps"] };
/// `attach`.
pub static ATTACH: Group = Group {
    keys: &[("object", Text), ("link", Text), ("touch", Names), ("mass", Number), ("arm", Text)],
    required: &["object"],
};
