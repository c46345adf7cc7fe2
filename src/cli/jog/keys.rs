//! Key bindings.

use crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

/// A motion of a held key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Motion {
    /// The end effector along or about an axis: 0–2 along x, y, z, 3–5 about x, y, z.
    Axis {
        /// The axis.
        axis: usize,
        /// Positive direction or not.
        up: bool,
    },
    /// The selected joint.
    Joint {
        /// Positive direction or not.
        up: bool,
    },
}

impl Motion {
    /// Returns the motion in the opposite direction.
    pub fn opposite(self) -> Self {
        match self {
            Self::Axis { axis, up } => Self::Axis { axis, up: !up },
            Self::Joint { up } => Self::Joint { up: !up },
        }
    }
}

/// Meaning of a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeyAction {
    /// Move while it is held.
    Move(Motion),
    /// Select the joint with this index.
    Joint(usize),
    /// Select the next joint or, with `false`, the previous one.
    Step(bool),
    /// Switch between end effector and single joints.
    Mode,
    /// Switch between the axes of the base and those of the tool.
    Frame,
    /// Go faster or, with `false`, slower.
    Speed(bool),
    /// Decelerate to rest now.
    Rest,
    /// Latched operational stop.
    Stop,
    /// Open the gripper a step or, with `false`, close it.
    Gripper(bool),
    /// Leave jog.
    Leave {
        /// Whether by Ctrl-C.
        interrupted: bool,
    },
}

/// The pairs of keys that move the end effector: up and down, axis by axis.
pub const AXES: [(char, char, &str); 6] =
    [('w', 's', "x"), ('a', 'd', "y"), ('q', 'e', "z"), ('r', 'f', "roll"), ('t', 'g', "pitch"), ('y', 'h', "yaw")];

/// Returns the meaning of a key; `None` if it has none. Capitals mean the same as small letters, for Caps Lock.
pub fn meaning(key: &KeyEvent, joint_mode: bool) -> Option<KeyAction> {
    let control = key.modifiers.contains(KeyModifiers::CONTROL);
    match key.code {
        KeyCode::Char('c' | 'C') if control => Some(KeyAction::Leave { interrupted: true }),
        _ if key.modifiers.intersects(KeyModifiers::CONTROL | KeyModifiers::ALT | KeyModifiers::SUPER) => None,
        KeyCode::Esc => Some(KeyAction::Leave { interrupted: false }),
        KeyCode::Tab => Some(KeyAction::Mode),
        KeyCode::Char(c) => letter(c.to_ascii_lowercase(), joint_mode),
        KeyCode::Up | KeyCode::Right if joint_mode => Some(KeyAction::Move(Motion::Joint { up: true })),
        KeyCode::Down | KeyCode::Left if joint_mode => Some(KeyAction::Move(Motion::Joint { up: false })),
        KeyCode::PageUp if joint_mode => Some(KeyAction::Step(false)),
        KeyCode::PageDown if joint_mode => Some(KeyAction::Step(true)),
        _ => None,
    }
}

fn letter(c: char, joint_mode: bool) -> Option<KeyAction> {
    match c {
        ' ' => Some(KeyAction::Rest),
        'x' => Some(KeyAction::Stop),
        'o' => Some(KeyAction::Gripper(true)),
        'c' => Some(KeyAction::Gripper(false)),
        ']' => Some(KeyAction::Speed(true)),
        '[' => Some(KeyAction::Speed(false)),
        '+' | '=' if joint_mode => Some(KeyAction::Move(Motion::Joint { up: true })),
        '-' | '_' if joint_mode => Some(KeyAction::Move(Motion::Joint { up: false })),
        '+' | '=' => Some(KeyAction::Speed(true)),
        '-' | '_' => Some(KeyAction::Speed(false)),
        '0' if joint_mode => Some(KeyAction::Joint(9)),
        '1'..='9' if joint_mode => Some(KeyAction::Joint(c as usize - '1' as usize)),
        'b' if !joint_mode => Some(KeyAction::Frame),
        _ if joint_mode => None,
        _ => {
            let axis = AXES.iter().position(|(up, down, _)| c == *up || c == *down)?;
            let up = AXES.get(axis).is_some_and(|(up, ..)| c == *up);
            Some(KeyAction::Move(Motion::Axis { axis, up }))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(code: KeyCode, joint_mode: bool) -> Option<KeyAction> {
        meaning(&KeyEvent::new(code, KeyModifiers::NONE), joint_mode)
    }

    #[test]
    fn letters_move_the_end_effector_and_only_it() {
        for (at, (up, down, _)) in AXES.into_iter().enumerate() {
            for (key, direction) in [(up, true), (down, false), (up.to_ascii_uppercase(), true)] {
                let expected = KeyAction::Move(Motion::Axis { axis: at, up: direction });
                assert_eq!(of(KeyCode::Char(key), false), Some(expected), "{key}");
                assert_eq!(of(KeyCode::Char(key), true), None, "{key} in joint mode");
            }
        }
        let control = KeyEvent::new(KeyCode::Char('w'), KeyModifiers::CONTROL);
        assert_eq!(meaning(&control, false), None, "Ctrl-W is no W");
    }

    #[test]
    fn joints_are_chosen_and_moved() {
        assert_eq!(of(KeyCode::Char('3'), true), Some(KeyAction::Joint(2)));
        assert_eq!(of(KeyCode::Char('0'), true), Some(KeyAction::Joint(9)));
        assert_eq!(of(KeyCode::Char('3'), false), None);
        for (key, up) in [(KeyCode::Up, true), (KeyCode::Left, false), (KeyCode::Char('+'), true)] {
            assert_eq!(of(key, true), Some(KeyAction::Move(Motion::Joint { up })));
        }
        assert_eq!(of(KeyCode::Up, false), None);
        assert_eq!(of(KeyCode::Char('-'), false), Some(KeyAction::Speed(false)));
    }

    #[test]
    fn some_keys_mean_the_same_everywhere() {
        for joint_mode in [false, true] {
            assert_eq!(of(KeyCode::Char(' '), joint_mode), Some(KeyAction::Rest));
            assert_eq!(of(KeyCode::Char('X'), joint_mode), Some(KeyAction::Stop));
            assert_eq!(of(KeyCode::Char('o'), joint_mode), Some(KeyAction::Gripper(true)));
            assert_eq!(of(KeyCode::Char('C'), joint_mode), Some(KeyAction::Gripper(false)));
            assert_eq!(of(KeyCode::Char(']'), joint_mode), Some(KeyAction::Speed(true)));
            assert_eq!(of(KeyCode::Tab, joint_mode), Some(KeyAction::Mode));
            assert_eq!(of(KeyCode::Esc, joint_mode), Some(KeyAction::Leave { interrupted: false }));
            let interrupt = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
            assert_eq!(meaning(&interrupt, joint_mode), Some(KeyAction::Leave { interrupted: true }));
        }
    }
}
