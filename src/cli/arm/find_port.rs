//! `dimos arm find-port`: which serial port is the arm's: by its USB id, by unplugging it, or by asking each port.

use std::path::Path;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::super::ask;
use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output::{self, Table};
use super::bus;
use dimos_hardware::registry::Registry;
use dimos_hardware::transport::serial_ports::{self, SerialPort};

/// Longest wait for a cable that is plugged in again.
const PLUG_LIMIT: Duration = Duration::from_secs(60);
/// How often ports are listed meanwhile.
const PERIOD: Duration = Duration::from_millis(200);

/// Arguments of `arm find-port`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
In a terminal it asks to unplug the arm, and finds the port that disappears. Elsewhere it lists the ports.
With --ask it reads the identity of an arm at each port; other devices there get bytes that they do not know.")]
pub struct Args {
    /// The adapter: a name that `dimos list-adapters` shows
    #[arg(long, value_name = "ADAPTER")]
    ask: Option<String>,
    /// Look at this port only (repeatable)
    #[arg(long = "port", value_name = "PATH")]
    ports: Vec<String>,
    /// Only list the ports
    #[arg(long, conflicts_with = "ask")]
    list: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A port, as it is printed.
#[derive(Debug, Serialize)]
struct Row {
    port: String,
    by_id: Option<String>,
    usb: Option<String>,
    device: Option<String>,
    serial: Option<String>,
    /// What answers there.
    #[serde(skip_serializing_if = "Option::is_none")]
    answer: Option<String>,
    #[serde(skip)]
    found: bool,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    let mut rows: Vec<Row> = args.present().into_iter().map(Row::of).collect();
    let mut hints = Vec::new();
    if let Some(adapter) = &args.ask {
        for row in &mut rows {
            row.answer = Some(match identify(adapter, &row.port, registry)? {
                Ok(arm) => {
                    row.found = true;
                    arm
                }
                Err(failure) => {
                    hints.extend(failure.hint.filter(|hint| !hints.contains(hint)));
                    failure.what
                }
            });
        }
    }
    if args.json {
        output::json(&rows);
    } else {
        print(&rows, args.ask.is_some());
    }
    if rows.is_empty() {
        return Err(Failure::new(Exit::Hardware, "this computer has no serial port").hint("is the cable plugged in?"));
    }
    match &args.ask {
        Some(_) if rows.iter().any(|row| row.found) => Ok(Exit::Ok),
        Some(adapter) => {
            let hint = if hints.is_empty() { "is it powered?".to_owned() } else { hints.join("; ") };
            Err(Failure::new(Exit::Hardware, format!("no {adapter} answers")).hint(hint))
        }
        None if args.list || args.json || ask::needs_terminal("").is_err() => Ok(Exit::Ok),
        None => args.unplugged(),
    }
}

/// Asks the arm at a port which one it is. The inner error is for the table: a run may use the port, for example.
fn identify(adapter: &str, port: &str, registry: &Registry) -> Result<Result<String>> {
    let (row, open, choice) = bus::row(adapter, &[], registry)?;
    let full = match (row.address.check)(port) {
        Ok(full) => full,
        Err(why) => return Ok(Err(Failure::usage(why))),
    };
    let config = choice.config(&row, &full)?;
    let ask = || {
        let _lock = bus::lock(&row, &full)?;
        open(&config).and_then(|mut arm| arm.identify()).map_err(bus::failure)
    };
    Ok(ask())
}

impl Args {
    /// The ports that are there now.
    fn present(&self) -> Vec<SerialPort> {
        let mut ports = serial_ports::list();
        if !self.ports.is_empty() {
            let known = |path: &String| ports.iter().find(|port| port.path == *path).cloned();
            let plain = |path: &String| SerialPort { path: path.clone(), by_id: None, usb: None };
            let there = self.ports.iter().filter(|path| Path::new(path).exists());
            ports = there.map(|path| known(path).unwrap_or_else(|| plain(path))).collect();
        }
        ports
    }

    fn paths(&self) -> Vec<String> {
        self.present().into_iter().map(|port| port.path).collect()
    }

    /// Finds the port that disappears with the arm's cable, and appears with it again.
    fn unplugged(&self) -> Result {
        let signals = Signals::watch_with_hangup();
        let before = self.paths();
        ask::enter(&signals, "Unplug the arm's USB cable")?;
        let after = self.paths();
        let gone: Vec<_> = before.into_iter().filter(|path| !after.contains(path)).collect();
        let [gone] = gone.as_slice() else {
            let what = format!("{} ports disappeared, not one", gone.len());
            return Err(Failure::new(Exit::Failed, what).hint("unplug only the arm, and wait a second before Enter"));
        };
        output::note(format_args!("{gone} is gone. Plug the arm in again"));
        let began = Instant::now();
        while began.elapsed() < PLUG_LIMIT {
            if signals.last().is_some() {
                return Err(ask::interrupted(&signals));
            }
            // It may have another name now.
            if let Some(path) = self.paths().into_iter().find(|path| !after.contains(path)) {
                output::line(path);
                return Ok(Exit::Ok);
            }
            std::thread::sleep(PERIOD);
        }
        output::line(gone);
        Err(Failure::new(Exit::Failed, format!("it was at {gone}, but was not plugged in again")))
    }
}

impl Row {
    fn of(port: SerialPort) -> Self {
        let usb = port.usb.as_ref();
        Self {
            usb: usb.map(|usb| usb.id.clone()),
            device: usb.and_then(|usb| usb.product.clone()),
            serial: usb.and_then(|usb| usb.serial.clone()),
            port: port.path,
            by_id: port.by_id,
            answer: None,
            found: false,
        }
    }
}

fn print(rows: &[Row], asked: bool) {
    if rows.is_empty() {
        return;
    }
    let mut headings = vec!["PORT", "USB", "DEVICE", "SERIAL"];
    if asked {
        headings.push("ANSWER");
    }
    let mut table = Table::new(&headings);
    for row in rows {
        let text = |value: &Option<String>| value.clone().unwrap_or_else(|| "-".into());
        let mut cells = vec![row.port.clone(), text(&row.usb), text(&row.device), text(&row.serial)];
        cells.extend(row.answer.clone());
        table.row(cells);
    }
    table.print();
}
