//! A terminal of ours: a program runs in it as in a user's, keys are typed, and what it shows is read.

use std::io::Write;
use std::num::NonZero;
use std::os::fd::{AsFd, OwnedFd};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::pty::{OpenptFlags, grantpt, ioctl_tiocgptpeer, openpt, unlockpt};
use rustix::termios::{LocalModes, Winsize, tcgetattr, tcsetwinsize};

use super::program::{Home, Started, TIMEOUT};

/// A pseudo-terminal, and the screen that it would show.
pub struct Terminal {
    near: Option<OwnedFd>,
    far: OwnedFd,
    screen: Arc<Mutex<vt100::Parser>>,
    closing: Arc<AtomicBool>,
    reader: Option<JoinHandle<()>>,
}

impl Terminal {
    pub fn new(columns: u16, rows: u16) -> Self {
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let near = openpt(flags).unwrap();
        grantpt(&near).unwrap();
        unlockpt(&near).unwrap();
        let far = ioctl_tiocgptpeer(&near, flags).unwrap();
        let screen = Arc::new(Mutex::new(vt100::Parser::new(cells(rows), cells(columns), 0)));
        let closing = Arc::new(AtomicBool::new(false));
        let (from, to, end) = (near.try_clone().unwrap(), screen.clone(), closing.clone());
        let reader = std::thread::spawn(move || {
            let mut room = [0; 4096];
            let look = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };
            while !end.load(Ordering::Relaxed) {
                let mut ready = [PollFd::new(&from, PollFlags::IN)];
                if poll(&mut ready, Some(&look)).is_ok_and(|n| n > 0) {
                    let n = rustix::io::read(&from, &mut room).unwrap_or(0);
                    lock(&to).process(&room[..n]);
                }
            }
        });
        let terminal = Self { near: Some(near), far, screen, closing, reader: Some(reader) };
        terminal.resize(columns, rows);
        terminal
    }

    pub fn resize(&self, columns: u16, rows: u16) {
        lock(&self.screen).screen_mut().set_size(cells(rows), cells(columns));
        let size = Winsize { ws_row: rows, ws_col: columns, ws_xpixel: 0, ws_ypixel: 0 };
        tcsetwinsize(self.near.as_ref().unwrap(), size).unwrap();
    }

    /// Starts a verb in it, as its foreground program.
    pub fn start(&self, home: &Home, arguments: &str) -> Started {
        self.start_with(home, arguments, &[])
    }

    /// The same, with more in its environment.
    pub fn start_with(&self, home: &Home, arguments: &str, environment: &[(&str, &str)]) -> Started {
        let end = || Stdio::from(self.far.try_clone().unwrap());
        let mut command = Command::new("setsid");
        command.arg("--ctty").arg(env!("CARGO_BIN_EXE_dimos")).args(arguments.split_whitespace());
        home.settle(command.env_remove("NO_COLOR")).envs(environment.iter().copied());
        Started::unheard(command.stdin(end()).stdout(end()).stderr(end()))
    }

    /// Types.
    pub fn keys(&self, keys: &str) {
        let mut near = std::fs::File::from(self.near.as_ref().unwrap().try_clone().unwrap());
        near.write_all(keys.as_bytes()).unwrap();
    }

    /// What is on the screen.
    pub fn text(&self) -> String {
        lock(&self.screen).screen().contents()
    }

    /// The lines that are longer than the terminal is wide.
    pub fn wrapped(&self) -> Vec<String> {
        let screen = lock(&self.screen);
        let screen = screen.screen();
        let (rows, columns) = screen.size();
        let (mut lines, mut line) = (Vec::new(), String::new());
        for (row, text) in (0..rows.get()).zip(screen.rows(0, columns.get())) {
            line.push_str(&text);
            if screen.row_wrapped(row) {
                continue;
            }
            if line.chars().count() > columns.get().into() {
                lines.push(line.clone());
            }
            line.clear();
        }
        lines
    }

    #[track_caller]
    pub fn until(&self, text: &str) {
        self.until_with(text, || {});
    }

    /// Waits until a text is on the screen, and does something meanwhile.
    #[track_caller]
    pub fn until_with(&self, text: &str, mut meanwhile: impl FnMut()) {
        let began = std::time::Instant::now();
        while !self.text().contains(text) {
            assert!(began.elapsed() < TIMEOUT, "no {text:?} on the screen:\n{}", self.text());
            meanwhile();
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
    }

    /// Whether any cell of the screen has a colour.
    pub fn has_colour(&self) -> bool {
        let screen = lock(&self.screen);
        let (rows, columns) = screen.screen().size();
        let cells = (0..rows.get()).flat_map(|row| (0..columns.get()).map(move |column| (row, column)));
        cells
            .filter_map(|(row, column)| screen.screen().cell(row, column))
            .any(|c| c.fgcolor() != vt100::Color::Default)
    }

    /// Whether it is as a shell wants it: lines are edited and echoed, the cursor is seen, no other screen is up.
    pub fn is_as_before(&self) -> bool {
        let modes = tcgetattr(self.far.as_fd()).unwrap().local_modes;
        let screen = lock(&self.screen);
        modes.contains(LocalModes::ICANON | LocalModes::ECHO | LocalModes::ISIG)
            && !screen.screen().alternate_screen()
            && !screen.screen().hide_cursor()
    }

    /// Closes the window.
    pub fn close(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
        if let Some(reader) = self.reader.take() {
            reader.join().unwrap();
        }
        self.near = None;
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
    }
}

fn cells(count: u16) -> NonZero<u16> {
    NonZero::new(count).unwrap()
}

fn lock(screen: &Mutex<vt100::Parser>) -> MutexGuard<'_, vt100::Parser> {
    screen.lock().unwrap_or_else(PoisonError::into_inner)
}
