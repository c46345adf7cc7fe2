//! `dimos top`: the live runs on one screen, until q or Ctrl-C.

mod board;
mod frame;

use std::io::{self, IsTerminal};
use std::time::{Duration, Instant};

use anyhow::Context;
use crossterm::event::{Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use super::arguments::{Target, hertz};
use super::exit::{Exit, Result};
use super::follow::Signals;
use super::jog::terminal::Terminal;
use super::output;
use board::Board;

/// Maximum wait for the first report of every run.
const FIRST_TIMEOUT: Duration = Duration::from_secs(2);
/// Width of a frame that no terminal shows [columns].
const COLUMNS: usize = 80;

/// Arguments of `top`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Shows the arms of all live runs with phase, rate and lease holder, what holds them and why, motions, speed, timing and \
log, and how old that is. A run that ends remains on the screen with its end. What does not fit is left out: joint \
positions first.

Elsewhere than on a terminal it prints one frame. --json prints an object per period, and the first of --once only.")]
pub struct Args {
    /// Print one frame
    #[arg(long)]
    pub once: bool,
    /// Rate of frames [Hz]
    #[arg(long, value_name = "HZ", default_value_t = 2.0, value_parser = hertz)]
    pub hz: f64,
    /// Which run; default: all
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let period = Duration::from_secs_f64(1.0 / args.hz);
    let signals = Signals::watch_with_hangup();
    let json = args.target_run.json;
    let board = Board::watch(&args.target_run, period)?;
    if !json && !args.once && io::stdin().is_terminal() && io::stdout().is_terminal() {
        return live(&board, period, &signals);
    }
    let began = Instant::now();
    while !board.is_complete() && began.elapsed() < FIRST_TIMEOUT && signals.last().is_none() {
        std::thread::sleep(Duration::from_millis(10));
    }
    if !json {
        frame::lines(&board.runs(), COLUMNS, usize::MAX).iter().for_each(|line| output::line(line.text()));
        return Ok(Exit::Ok);
    }
    let mut next = Instant::now();
    loop {
        let object = output::encoded(&frame::to_json(&board.runs())) + "\n";
        if !output::data(object.as_bytes()) || args.once {
            return Ok(Exit::Ok);
        }
        next = (next + period).max(Instant::now());
        while Instant::now() < next {
            if let Some(signal) = signals.last() {
                return Ok(Exit::by_signal(signal));
            }
            std::thread::sleep(next.saturating_duration_since(Instant::now()).min(Duration::from_millis(50)));
        }
    }
}

/// Redraws the terminal until q or Ctrl-C.
fn live(board: &Board, period: Duration, signals: &Signals) -> Result {
    let mut terminal = Terminal::open().context("cannot use the terminal")?;
    loop {
        let (columns, rows) = terminal.size().context("cannot use the terminal")?;
        let drawn = terminal.draw(frame::lines(&board.runs(), columns, rows));
        if drawn.is_err() || !terminal.is_there() {
            return Ok(Exit::by_signal(libc::SIGHUP));
        }
        if let Some(signal) = signals.last() {
            return Ok(Exit::by_signal(signal));
        }
        // Without events the terminal is closed.
        match terminal.event(period.min(Duration::from_millis(200))) {
            Ok(Some((Event::Key(key), _))) => {
                if let Some(exit) = ends(key) {
                    return Ok(exit);
                }
            }
            Ok(_) => {}
            Err(_) => return Ok(Exit::by_signal(libc::SIGHUP)),
        }
    }
}

/// Returns the exit code if a key ends the screen.
fn ends(key: KeyEvent) -> Option<Exit> {
    let pressed = key.kind != KeyEventKind::Release;
    match key.code {
        KeyCode::Char('c') if pressed && key.modifiers.contains(KeyModifiers::CONTROL) => Some(Exit::Interrupted),
        KeyCode::Char('q') | KeyCode::Esc if pressed => Some(Exit::Ok),
        _ => None,
    }
}
