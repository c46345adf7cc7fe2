//! The text log of a run, on stderr: written by a thread of its own, so that a terminal that stands still holds up
//! nobody. Lines that find the queue full are dropped and counted.

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};

use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt;

/// Lines on their way to the terminal.
const QUEUE: usize = 1024;

#[derive(Clone)]
struct Queue {
    lines: SyncSender<Vec<u8>>,
    dropped: Arc<AtomicU64>,
}

/// Starts the text log. `DIMOS_LOG` sets its level: error, warn (without it), info, debug.
pub fn start() -> io::Result<()> {
    let level = std::env::var("DIMOS_LOG").ok().and_then(|l| l.parse::<LevelFilter>().ok());
    let (lines, received) = sync_channel::<Vec<u8>>(QUEUE);
    let dropped = Arc::new(AtomicU64::new(0));
    let lost = dropped.clone();
    std::thread::Builder::new().name("text-log".into()).spawn(move || {
        for line in received {
            let mut stderr = io::stderr().lock();
            let _ = stderr.write_all(&line);
            let missing = lost.swap(0, Ordering::Relaxed);
            if missing > 0 {
                let _ = writeln!(stderr, "({missing} lines were dropped: the terminal was too slow)");
            }
        }
    })?;
    let writer = Queue { lines, dropped };
    let layer = tracing_subscriber::fmt::layer()
        .with_ansi(super::output::colour(&io::stderr()))
        .with_target(false)
        .with_writer(writer);
    let subscriber = tracing_subscriber::registry().with(level.unwrap_or(LevelFilter::WARN)).with(layer);
    // A program that embeds this one may have a log of its own; then that one is used.
    let _ = tracing::subscriber::set_global_default(subscriber);
    Ok(())
}

impl<'a> MakeWriter<'a> for Queue {
    type Writer = Queue;

    fn make_writer(&'a self) -> Queue {
        self.clone()
    }
}

impl Write for Queue {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        if self.lines.try_send(line.to_vec()).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
