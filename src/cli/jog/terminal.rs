//! The terminal while jog has it: raw, on its alternate screen, and given back however jog ends.

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

use crate::cli::output;

/// Whether there is something to give back.
static TAKEN: AtomicBool = AtomicBool::new(false);

/// Keys that wait to be taken up.
const KEYS: usize = 256;

/// How a piece of text looks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Look {
    /// As it comes.
    #[default]
    Plain,
    /// It matters.
    Bold,
    /// It is there for those who look for it.
    Dim,
    /// As it should be.
    Good,
    /// Worth a look.
    Warning,
    /// Wrong.
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

    /// Its text alone.
    #[cfg(test)]
    pub fn text(&self) -> String {
        self.0.iter().map(|(text, _)| text.as_str()).collect()
    }
}

/// The terminal. Dropping it gives it back.
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
        give_back_on_panic();
        enable_raw_mode()?;
        TAKEN.store(true, Ordering::SeqCst);
        let size = (columns.into(), rows.into());
        let terminal = Self { drawn: Vec::new(), size, colour: output::colour(&io::stdout()), events: listen()? };
        // A terminal that does not know the kitty keyboard protocol passes over its sequence; one that does will tell
        // when keys go up. Whether it does is known by the first key-up.
        let flags = KeyboardEnhancementFlags::DISAMBIGUATE_ESCAPE_CODES | KeyboardEnhancementFlags::REPORT_EVENT_TYPES;
        let keyboard = PushKeyboardEnhancementFlags(flags);
        execute!(io::stdout(), EnterAlternateScreen, keyboard, EnableFocusChange, Hide, Clear(ClearType::All))?;
        Ok(terminal)
    }

    /// Columns and rows, as they are now: not every change of them is told.
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

    /// The next key, and when it came, waiting up to `patience`. Fails when there will be
    /// no more.
    pub fn event(&mut self, patience: Duration) -> io::Result<Option<(Event, Instant)>> {
        let (event, at) = match self.events.recv_timeout(patience) {
            Ok(event) => event?,
            Err(RecvTimeoutError::Timeout) => return Ok(None),
            Err(RecvTimeoutError::Disconnected) => return Err(io::ErrorKind::UnexpectedEof.into()),
        };
        Ok(Some((event, at)))
    }

    /// Whether it is still there: one that was closed gives no keys, and must not be waited for.
    pub fn is_there(&self) -> bool {
        rustix::termios::tcgetattr(io::stdin()).is_ok() && io::stdin().is_terminal()
    }

    /// Shows these lines, from the top; what does not fit is cut off.
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
                let text: String = text.chars().filter(|c| !c.is_control()).take(room).collect();
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
        give_back();
    }
}

/// Reads keys on a thread of its own: on a terminal that is gone the library never comes back from its reading. And
/// keys keep the time when they were typed, however late they are taken up.
fn listen() -> io::Result<Receiver<io::Result<(Event, Instant)>>> {
    let (to, events) = sync_channel(KEYS);
    let listening = move || {
        loop {
            let event = read().map(|event| (event, Instant::now()));
            let over = event.is_err();
            if to.send(event).is_err() || over {
                return;
            }
        }
    };
    std::thread::Builder::new().name("jog-keys".into()).spawn(listening)?;
    Ok(events)
}

/// Makes the terminal what it was. That it is gone is no error here.
fn give_back() {
    if TAKEN.swap(false, Ordering::SeqCst) {
        let mut out = io::stdout();
        let _ = execute!(out, DisableFocusChange, PopKeyboardEnhancementFlags, Show, LeaveAlternateScreen);
        let _ = disable_raw_mode();
    }
}

/// A panic's message must reach a terminal that shows it.
fn give_back_on_panic() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        give_back();
        before(panic);
    }));
}
