//! The terminal of jog: raw, on its alternate screen, restored however jog ends.

use std::io::{self, IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

use crossterm::cursor::{Hide, MoveTo, Show};
use crossterm::event::{
    DisableFocusChange, EnableFocusChange, Event, KeyboardEnhancementFlags, PopKeyboardEnhancementFlags,
    PushKeyboardEnhancementFlags, read,
};
use crossterm::style::{Attribute, Color, Print, ResetColor, SetAttribute, SetForegroundColor};
use crossterm::terminal::{
    Clear, ClearType, EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode, size,
};
use crossterm::{execute, queue};

use crate::cli::escapes::is_hidden;
use crate::cli::output;

/// Whether it must be restored.
static TAKEN: AtomicBool = AtomicBool::new(false);

/// Capacity of the key queue.
const KEY_CAPACITY: usize = 256;

/// Style of a piece of text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Look {
    /// As it comes.
    #[default]
    Plain,
    /// Emphasized.
    Bold,
    /// Dimmed.
    Dim,
    /// Good.
    Good,
    /// Warning.
    Warning,
    /// Error.
    Bad,
}

/// A line of the screen: pieces of text.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Line(pub Vec<(String, Look)>);

impl Line {
    /// Adds a piece.
    pub fn with(mut self, text: impl Into<String>, look: Look) -> Self {
        self.0.push((text.into(), look));
        self
    }

    /// Adds a plain piece.
    pub fn and(self, text: impl Into<String>) -> Self {
        self.with(text, Look::Plain)
    }

    /// Returns its text.
    pub fn text(&self) -> String {
        self.0.iter().map(|(text, _)| text.as_str()).collect()
    }
}

/// The terminal. Restored when dropped.
pub struct Terminal {
    drawn: Vec<Line>,
    size: (usize, usize),
    colour: bool,
    events: Receiver<io::Result<(Event, Instant)>>,
}

impl Terminal {
    /// Takes the terminal.
    pub fn open() -> io::Result<Self> {
        let (columns, rows) = size()?;
        restore_on_panic();
        enable_raw_mode()?;
        TAKEN.store(true, Ordering::SeqCst);
        let size = (columns.into(), rows.into());
        let terminal =
            Self { drawn: Vec::new(), size, colour: output::colour(&io::stdout()), events: listen("jog-keys")? };
        // A terminal without the kitty keyboard protocol ignores this sequence; one with it will report key-ups. The
        // first key-up shows which it is.
        let flags = KeyboardEnhancementFlags::DISAMBIGUATE_ESCAPE_CODES | KeyboardEnhancementFlags::REPORT_EVENT_TYPES;
        let keyboard = PushKeyboardEnhancementFlags(flags);
        execute!(io::stdout(), EnterAlternateScreen, keyboard, EnableFocusChange, Hide, Clear(ClearType::All))?;
        Ok(terminal)
    }

    /// Returns columns and rows; queried each time, because not every change is reported.
    pub fn size(&mut self) -> io::Result<(usize, usize)> {
        let (columns, rows) = size()?;
        let now = (usize::from(columns), usize::from(rows));
        if now != self.size {
            self.size = now;
            self.drawn.clear();
            execute!(io::stdout(), Clear(ClearType::All))?;
        }
        Ok(now)
    }

    /// Returns the next key and its time, waiting up to `timeout`. Fails when no more keys can come.
    pub fn event(&mut self, timeout: Duration) -> io::Result<Option<(Event, Instant)>> {
        let (event, at) = match self.events.recv_timeout(timeout) {
            Ok(event) => event?,
            Err(RecvTimeoutError::Timeout) => return Ok(None),
            Err(RecvTimeoutError::Disconnected) => return Err(io::ErrorKind::UnexpectedEof.into()),
        };
        Ok(Some((event, at)))
    }

    /// Returns whether it still exists: a closed terminal gives no keys, and must not be waited for.
    pub fn is_there(&self) -> bool {
        rustix::termios::tcgetattr(io::stdin()).is_ok() && io::stdin().is_terminal()
    }

    /// Draws these lines from the top; cuts off what does not fit.
    pub fn draw(&mut self, lines: Vec<Line>) -> io::Result<()> {
        let (columns, rows) = self.size;
        let mut out = io::stdout().lock();
        for row in 0..rows {
            let (new, old) = (lines.get(row), self.drawn.get(row));
            if new == old {
                continue;
            }
            queue!(out, MoveTo(0, row as u16))?;
            let mut room = columns;
            for (text, look) in new.map_or(&[][..], |line| &line.0) {
                let text: String = text.chars().filter(|c| !is_hidden(*c)).take(room).collect();
                room -= text.chars().count();
                self.look(&mut out, *look)?;
                queue!(out, Print(text), SetAttribute(Attribute::Reset), ResetColor)?;
            }
            if room > 0 {
                queue!(out, Clear(ClearType::UntilNewLine))?;
            }
        }
        self.drawn = lines;
        out.flush()
    }

    fn look(&self, out: &mut impl Write, look: Look) -> io::Result<()> {
        let colour = match look {
            Look::Plain => return Ok(()),
            Look::Bold => return queue!(out, SetAttribute(Attribute::Bold)),
            Look::Dim => return queue!(out, SetAttribute(Attribute::Dim)),
            Look::Good => Color::Green,
            Look::Warning => Color::Yellow,
            Look::Bad => Color::Red,
        };
        match self.colour {
            true => queue!(out, SetForegroundColor(colour), SetAttribute(Attribute::Bold)),
            false => queue!(out, SetAttribute(Attribute::Bold)),
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        restore();
    }
}

/// Reads keys on a separate thread: the library's read never returns from a closed terminal. Keys are time-stamped when
/// typed.
pub fn listen(thread: &str) -> io::Result<Receiver<io::Result<(Event, Instant)>>> {
    let (to, events) = sync_channel(KEY_CAPACITY);
    let listening = move || {
        loop {
            let event = read().map(|event| (event, Instant::now()));
            let over = event.is_err();
            if to.send(event).is_err() || over {
                return;
            }
        }
    };
    std::thread::Builder::new().name(thread.into()).spawn(listening)?;
    Ok(events)
}

/// Restores the terminal. Ignores that it is closed.
fn restore() {
    if TAKEN.swap(false, Ordering::SeqCst) {
        let mut out = io::stdout();
        let _ = execute!(out, DisableFocusChange, PopKeyboardEnhancementFlags, Show, LeaveAlternateScreen);
        let _ = disable_raw_mode();
    }
}

/// Restores the terminal on a panic, so that its message is visible.
fn restore_on_panic() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        restore();
        before(panic);
    }));
}
