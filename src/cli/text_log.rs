//! Output of a run on its terminal: messages and text log, written by a separate thread, so that a blocked terminal
//! (Ctrl-S, a full pipe) delays nothing, least of all a stop. Lines that do not fit in the queue are dropped and
//! counted.

use std::fmt::Display;
use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use serde::Serialize;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::{Layer, Registry};

use super::escapes::safe;
use super::output;
use dimos_rpc::api::TextLines;

/// Capacity of the queue [lines].
const QUEUE: usize = 1024;
/// Maximum wait for the last lines.
const FLUSH_TIMEOUT: Duration = Duration::from_millis(500);

enum Item {
    Note(Vec<u8>),
    /// Shown here, and kept for no client.
    Private(Vec<u8>),
    Data(Vec<u8>),
    /// Answered when everything before it is written.
    Flush(SyncSender<()>),
}

/// Reads the log beside the terminal.
pub type Reader = Box<dyn Layer<Registry> + Send + Sync>;

/// Sender of lines to the terminal. Never blocks.
#[derive(Clone)]
pub struct Terminal {
    items: SyncSender<Item>,
    dropped: Arc<AtomicU64>,
    kept: TextLines,
}

impl Terminal {
    /// Starts the thread and the text log. `DIMOS_LOG` sets its level: error, warn (default), info, debug.
    pub fn start() -> io::Result<Self> {
        Self::start_with(|_| None)
    }

    /// As [`start`](Self::start), with a further reader of the log, made for this terminal.
    pub fn start_with(reader: impl FnOnce(&Self) -> Option<Reader>) -> io::Result<Self> {
        let asked = std::env::var("DIMOS_LOG").ok().filter(|level| !level.is_empty());
        let level = asked.as_ref().and_then(|level| level.parse::<LevelFilter>().ok());
        if let (Some(asked), None) = (&asked, level) {
            let levels = "error, warn, info or debug";
            output::note(format_args!("warning: DIMOS_LOG={asked} is no level\nhint: {levels}; warn is used now"));
        }
        let (items, received) = sync_channel(QUEUE);
        let dropped = Arc::new(AtomicU64::new(0));
        let (lost, kept) = (dropped.clone(), TextLines::default());
        let keep = kept.clone();
        std::thread::Builder::new().name("terminal".into()).spawn(move || write(&received, &lost, &keep))?;
        let terminal = Self { items, dropped, kept };
        let layer = tracing_subscriber::fmt::layer()
            .with_ansi(output::colour(&io::stderr()))
            .with_target(false)
            .with_writer(terminal.clone());
        let level = level.unwrap_or(LevelFilter::WARN);
        // What the network library says is for its developers; what matters of it is said in our words.
        let network = if level >= LevelFilter::DEBUG { level } else { LevelFilter::OFF };
        let levels = Targets::new().with_default(level).with_target("zenoh", network);
        let subscriber = tracing_subscriber::registry().with(reader(&terminal)).with(layer.with_filter(levels));
        // A program that embeds this one may have its own log; then that one is used.
        let _ = tracing::subscriber::set_global_default(subscriber);
        Ok(terminal)
    }

    /// Prints a line for people, to stderr.
    pub fn note(&self, text: impl Display) {
        self.send(Item::Note(format!("{text}\n").into_bytes()));
    }

    /// Prints a line for the person at this terminal only, to stderr: clients that ask for the text log do not get it.
    pub fn private(&self, text: impl Display) {
        self.send(Item::Private(format!("{text}\n").into_bytes()));
    }

    /// Returns what it prints for people, for clients. A terminal that is paused (Ctrl-S) pauses that too.
    pub fn kept(&self) -> TextLines {
        self.kept.clone()
    }

    /// Prints a line of JSON, to stdout.
    pub fn json(&self, value: &impl Serialize) {
        self.send(Item::Data((output::encoded(value) + "\n").into_bytes()));
    }

    /// Waits until all lines are written, at most [`FLUSH_TIMEOUT`].
    pub fn flush(&self) {
        let (done, written) = sync_channel(1);
        if self.items.try_send(Item::Flush(done)).is_ok() {
            // A reader that is slower than that is not reading.
            let _ = written.recv_timeout(FLUSH_TIMEOUT);
        }
    }

    fn send(&self, item: Item) {
        if self.items.try_send(item).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

fn write(items: &Receiver<Item>, lost: &AtomicU64, kept: &TextLines) {
    let colour = output::colour(&io::stderr());
    for item in items {
        match item {
            // A closed pipe is not an error.
            Item::Note(line) => {
                let line = String::from_utf8_lossy(&line);
                let line = safe(&line, colour);
                kept.push(&line);
                let columns = output::columns(io::stderr());
                let rows = line.lines().flat_map(|line| output::folded(line, columns));
                let text: String = rows.map(|row| row + "\n").collect();
                let _ = io::stderr().write_all(text.as_bytes());
            }
            Item::Private(line) => {
                let line = String::from_utf8_lossy(&line);
                let _ = io::stderr().write_all(safe(&line, colour).as_bytes());
            }
            Item::Data(line) => drop(output::data(&line)),
            Item::Flush(done) => drop(done.send(())),
        }
        let missing = lost.swap(0, Ordering::Relaxed);
        if missing > 0 {
            let _ = writeln!(io::stderr(), "({missing} lines were dropped: the terminal was too slow)");
        }
    }
}

impl<'a> MakeWriter<'a> for Terminal {
    type Writer = Terminal;

    fn make_writer(&'a self) -> Terminal {
        self.clone()
    }
}

impl Write for Terminal {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.send(Item::Note(line.to_vec()));
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
