//! What the keys mean.

use crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

/// A motion that a key keeps alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Motion {
    /// The end effector along or about an axis: 0–2 along x, y, z, 3–5 about x, y, z.
    Axis {
        /// Which.
        axis: usize,
        /// Whether in its positive direction.
        up: bool,
    },
    /// The chosen joint.
    Joint {
        /// Whether in its positive direction.
        up: bool,
    },
}

impl Motion {
    /// The motion in the opposite direction.
    pub fn opposite(self) -> Self {
        match self {
            Self::Axis { axis, up } => Self::Axis { axis, up: !up },
            Self::Joint { up } => Self::Joint { up: !up },
        }
    }
}

/// What a key asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wish {
    /// To move for as long as it is held.
    Move(Motion),
    /// To choose the joint of this index.
    Joint(usize),
    /// To choose the next joint or, with `false`, the one before.
    Step(bool),
    /// To change between the end effector and single joints.
    Mode,
    /// To change between the axes of the base and those of the tool.
    Frame,
    /// To go faster or, with `false`, slower.
    Speed(bool),
    /// To come to rest now.
    Rest,
    /// A latched operational stop.
    Stop,
    /// To leave; by Ctrl-C or not.
    Leave {
        /// Whether by Ctrl-C.
        interrupted: bool,
    },
}

/// The pairs of keys that move the end effector: up and down, axis by axis.
pub const AXES: [(char, char, &str); 6] =
    [('w', 's', "x"), ('a', 'd', "y"), ('q', 'e', "z"), ('r', 'f', "roll"), ('t', 'g', "pitch"), ('y', 'h', "yaw")];

/// What a key means; `None` where nothing. Capitals mean the same as small letters: Caps Lock is no other program.
pub fn meaning(key: &KeyEvent, joint_mode: bool) -> Option<Wish> {
    let control = key.modifiers.contains(KeyModifiers::CONTROL);
    match key.code {
        KeyCode::Char('c' | 'C') if control => Some(Wish::Leave { interrupted: true }),
        _ if key.modifiers.intersects(KeyModifiers::CONTROL | KeyModifiers::ALT | KeyModifiers::SUPER) => None,
        KeyCode::Esc => Some(Wish::Leave { interrupted: false }),
        KeyCode::Tab => Some(Wish::Mode),
        KeyCode::Char(c) => letter(c.to_ascii_lowercase(), joint_mode),
        KeyCode::Up | KeyCode::Right if joint_mode => Some(Wish::Move(Motion::Joint { up: true })),
        KeyCode::Down | KeyCode::Left if joint_mode => Some(Wish::Move(Motion::Joint { up: false })),
        KeyCode::PageUp if joint_mode => Some(Wish::Step(false)),
        KeyCode::PageDown if joint_mode => Some(Wish::Step(true)),
        _ => None,
    }
}

fn letter(c: char, joint_mode: bool) -> Option<Wish> {
    match c {
        ' ' => Some(Wish::Rest),
        'x' => Some(Wish::Stop),
        ']' => Some(Wish::Speed(true)),
        '[' => Some(Wish::Speed(false)),
        '+' | '=' if joint_mode => Some(Wish::Move(Motion::Joint { up: true })),
        '-' | '_' if joint_mode => Some(Wish::Move(Motion::Joint { up: false })),
        '+' | '=' => Some(Wish::Speed(true)),
        '-' | '_' => Some(Wish::Speed(false)),
        '0' if joint_mode => Some(Wish::Joint(9)),
        '1'..='9' if joint_mode => Some(Wish::Joint(c as usize - '1' as usize)),
        'b' if !joint_mode => Some(Wish::Frame),
        _ if joint_mode => None,
        _ => {
            let axis = AXES.iter().position(|(up, down, _)| c == *up || c == *down)?;
            let up = AXES.get(axis).is_some_and(|(up, ..)| c == *up);
            Some(Wish::Move(Motion::Axis { axis, up }))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(code: KeyCode, joint_mode: bool) -> Option<Wish> {
        meaning(&KeyEvent::new(code, KeyModifiers::NONE), joint_mode)
    }

    #[test]
    fn letters_move_the_end_effector_and_only_it() {
        for (at, (up, down, _)) in AXES.into_iter().enumerate() {
            for (key, direction) in [(up, true), (down, false), (up.to_ascii_uppercase(), true)] {
                let expected = Wish::Move(Motion::Axis { axis: at, up: direction });
                assert_eq!(of(KeyCode::Char(key), false), Some(expected), "{key}");
                assert_eq!(of(KeyCode::Char(key), true), None, "{key} in joint mode");
            }
        }
        let control = KeyEvent::new(KeyCode::Char('w'), KeyModifiers::CONTROL);
        assert_eq!(meaning(&control, false), None, "Ctrl-W is no W");
    }

    #[test]
    fn joints_are_chosen_and_moved() {
        assert_eq!(of(KeyCode::Char('3'), true), Some(Wish::Joint(2)));
        assert_eq!(of(KeyCode::Char('0'), true), Some(Wish::Joint(9)));
        assert_eq!(of(KeyCode::Char('3'), false), None);
        for (key, up) in [(KeyCode::Up, true), (KeyCode::Left, false), (KeyCode::Char('+'), true)] {
            assert_eq!(of(key, true), Some(Wish::Move(Motion::Joint { up })));
        }
        assert_eq!(of(KeyCode::Up, false), None);
        assert_eq!(of(KeyCode::Char('-'), false), Some(Wish::Speed(false)));
    }

    #[test]
    fn some_keys_mean_the_same_everywhere() {
        for joint_mode in [false, true] {
            assert_eq!(of(KeyCode::Char(' '), joint_mode), Some(Wish::Rest));
            assert_eq!(of(KeyCode::Char('X'), joint_mode), Some(Wish::Stop));
            assert_eq!(of(KeyCode::Char(']'), joint_mode), Some(Wish::Speed(true)));
            assert_eq!(of(KeyCode::Tab, joint_mode), Some(Wish::Mode));
            assert_eq!(of(KeyCode::Esc, joint_mode), Some(Wish::Leave { interrupted: false }));
            let interrupt = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
            assert_eq!(meaning(&interrupt, joint_mode), Some(Wish::Leave { interrupted: true }));
        }
    }
}
