//! Keys while a log plays, as of `ros2 bag play`.

use std::io;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use crossterm::event::{Event, KeyCode, KeyEventKind, KeyModifiers};
use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};

use super::player::{Key, Waiting};
use crate::cli::jog::terminal::listen;
use dimos_core::clock::{Clock, Mono, MonotonicClock};

/// Real time, and the keys of a terminal, which it gives back as it was.
pub struct Keys {
    before: Termios,
    events: Receiver<io::Result<(Event, Instant)>>,
}

impl Keys {
    /// Takes the keyboard: keys come at once and are not shown.
    pub fn open() -> io::Result<Self> {
        let before = tcgetattr(io::stdin())?;
        let mut raw = before.clone();
        raw.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO | LocalModes::ISIG);
        tcsetattr(io::stdin(), OptionalActions::Now, &raw)?;
        Ok(Self { before, events: listen("replay-keys")? })
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        let _ = tcsetattr(io::stdin(), OptionalActions::Now, &self.before);
    }
}

impl Waiting for Keys {
    fn time(&self) -> Mono {
        MonotonicClock.now()
    }

    fn wait(&mut self, until: Option<Mono>) -> Option<Key> {
        loop {
            let left = until.map_or(Duration::from_secs(3600), |until| until.since(self.time()));
            match self.events.recv_timeout(left) {
                Ok(Ok((event, _))) => {
                    if let Some(key) = meaning(&event) {
                        return Some(key);
                    }
                }
                Err(RecvTimeoutError::Timeout) if until.is_none() => {}
                Err(RecvTimeoutError::Timeout) => return None,
                // The terminal is gone.
                Ok(Err(_)) | Err(RecvTimeoutError::Disconnected) => return Some(Key::End { interrupted: true }),
            }
        }
    }
}

/// Returns what a key asks for.
fn meaning(event: &Event) -> Option<Key> {
    let key = event.as_key_event().filter(|key| key.kind != KeyEventKind::Release)?;
    match key.code {
        KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => Some(Key::End { interrupted: true }),
        KeyCode::Char('q') => Some(Key::End { interrupted: false }),
        KeyCode::Char(' ') => Some(Key::Pause),
        KeyCode::Right => Some(Key::Next),
        KeyCode::Up => Some(Key::Faster(true)),
        KeyCode::Down => Some(Key::Faster(false)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crossterm::event::KeyEvent;

    #[test]
    fn keys_are_those_of_ros2_bag_play() {
        let of = |code, modifiers| meaning(&Event::Key(KeyEvent::new(code, modifiers)));
        let plain = |code| of(code, KeyModifiers::NONE);
        assert_eq!(plain(KeyCode::Char(' ')), Some(Key::Pause));
        assert_eq!(plain(KeyCode::Right), Some(Key::Next));
        assert_eq!((plain(KeyCode::Up), plain(KeyCode::Down)), (Some(Key::Faster(true)), Some(Key::Faster(false))));
        assert_eq!(of(KeyCode::Char('c'), KeyModifiers::CONTROL), Some(Key::End { interrupted: true }));
        assert_eq!((plain(KeyCode::Char('c')), plain(KeyCode::Left)), (None, None));
    }
}
