//! `dimos adapter emulate NAME`: an arm's emulator in its own process, so that any client of the arm can be tried
//! against it.

use std::io::{self, IsTerminal};
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};

use super::super::arguments::duration;
use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output::{self, Table};
use super::choice::{Choice, not_started};
use super::peripheral;
use crate::blueprint;
use dimos_core::bounded;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::registry::{AdapterSpec, Emulator, EmulatorAddress, Registry};
use dimos_hardware::sim::events::{self, SimEvent};
use dimos_hardware::sim::faults::{Fault, FaultKind};

/// How often the joints are shown.
pub(super) const LOOK: Duration = Duration::from_millis(100);

/// The option of a gripper, and its value for an arm without one.
const GRIPPER: &str = "gripper";
const NONE: &str = "none";

/// Arguments of `adapter emulate`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
A fault script: at=2,kind=stall,duration=0.5 (repeatable), or a YAML or JSON file with a list of such.
`at` counts seconds from the first client's connection. `--fault list` shows the kinds that this arm's emulator can play.
Clients that connect and leave, and faults that begin, are logged on stderr, in seconds since the start.")]
pub struct Args {
    /// The adapter and its options.
    #[command(flatten)]
    pub choice: Choice,
    /// Listen on this loopback address, at the arm's own ports [default for arms on TCP: 127.0.0.1]
    #[arg(long, value_name = "ADDRESS", group = "place")]
    pub bind: Option<IpAddr>,
    /// Stand on this CAN interface: vcan0
    #[arg(long, value_name = "INTERFACE", group = "place")]
    pub can: Option<String>,
    /// Stand on a new pseudo-terminal [default for arms on a serial line]
    #[arg(long, group = "place")]
    pub pty: bool,
    /// Also make the pseudo-terminal reachable under this path, a symbolic link, which stays the same between starts
    #[arg(long, value_name = "PATH", conflicts_with_all = ["bind", "can"])]
    pub link: Option<PathBuf>,
    /// What goes wrong, and when (repeatable); `list` shows what can
    #[arg(long, value_name = "SCRIPT")]
    pub fault: Vec<String>,
    /// End after this time: 10s, 500ms
    #[arg(long, value_parser = duration)]
    pub duration: Option<Duration>,
    /// Print the address as a line of JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    if let Some(peripheral) = registry.peripheral(&args.choice.name) {
        return peripheral::run(args, peripheral);
    }
    let row = args.choice.row(registry)?;
    if args.fault.iter().any(|text| text == "list") {
        return list_faults(args, &row);
    }
    let faults = args.fault.iter().map(|text| script(text)).collect::<Result<Vec<_>>>()?.concat();
    let place = args.place(&row)?;
    events::open();
    let (emulator, dof) = start(args, &row, &place)?;
    for fault in &faults {
        emulator.inject(*fault).map_err(Failure::usage)?;
    }
    let signals = Signals::watch_with_hangup();
    let link = args.link.as_deref().map(|path| Link::to(&emulator.address(), path)).transpose()?;
    let address = link.as_ref().map_or_else(|| emulator.address(), |link| link.address.clone());
    announce(args, &row, dof, &address, registry);
    let bar = if args.json || !io::stderr().is_terminal() { ProgressBar::hidden() } else { ProgressBar::new_spinner() };
    if let Ok(style) = ProgressStyle::with_template("SIMULATED {wide_msg}") {
        bar.set_style(style);
    }
    let (began, zero) = (Instant::now(), MonotonicClock.now());
    let ended = loop {
        tell(&bar, zero);
        if let Some(signal) = signals.last() {
            break Exit::by_signal(signal);
        }
        let left = args.duration.map(|duration| duration.saturating_sub(began.elapsed()));
        if left.is_some_and(|left| left.is_zero()) {
            break Exit::Ok;
        }
        if let Some(joints) = emulator.true_positions() {
            let degrees = joints.iter().take(dof).map(|v| format!("{:8}°", output::fixed(v.to_degrees(), 2)));
            bar.set_message(degrees.collect::<String>());
        }
        std::thread::sleep(left.unwrap_or(LOOK).min(LOOK));
    };
    tell(&bar, zero);
    bar.finish_and_clear();
    Ok(ended)
}

/// A symbolic link to a pseudo-terminal; removed when it is dropped, unless another one has replaced it.
pub(super) struct Link {
    path: PathBuf,
    device: String,
    /// The address by way of the link.
    pub(super) address: String,
}

impl Link {
    /// Makes the link. One that is there already is replaced, any other file is not.
    pub(super) fn to(address: &str, path: &Path) -> Result<Self> {
        let failed = |what: String| Failure::usage(format!("--link {}: {what}", path.display()));
        let (scheme, device) = match address.find("/dev/") {
            Some(at) => address.split_at(at),
            None => return Err(failed(format!("the emulator is at {address}, which is no pseudo-terminal"))),
        };
        let path = std::path::absolute(path).map_err(|e| failed(e.to_string()))?;
        match std::fs::symlink_metadata(&path) {
            Ok(there) if !there.is_symlink() => return Err(failed("there is a file already".to_owned())),
            Ok(_) => std::fs::remove_file(&path).map_err(|e| failed(e.to_string()))?,
            Err(_) => {}
        }
        std::os::unix::fs::symlink(device, &path).map_err(|e| failed(e.to_string()))?;
        let address = format!("{scheme}{}", path.display());
        Ok(Self { path, device: device.to_owned(), address })
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        if std::fs::read_link(&self.path).is_ok_and(|device| device == Path::new(&self.device)) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Prints the events of the emulator since the last call: no thread that serves a client waits for a terminal.
fn tell(bar: &ProgressBar, zero: Mono) {
    while let Some((at, what)) = events::take() {
        let what = match what {
            SimEvent::Connected => "a client connected".to_owned(),
            SimEvent::Disconnected => "the client is gone".to_owned(),
            SimEvent::Rejected => "another client was rejected".to_owned(),
            SimEvent::Foreign => "a client of another user was disconnected".to_owned(),
            SimEvent::Fault(kind) => format!("the fault {} begins", kind.name()),
        };
        bar.suspend(|| output::note(format_args!("{:8.3} s  {what}", at.seconds_since(zero))));
    }
}

/// The kinds of faults that this arm's emulator can play, each with what it means.
fn list_faults(args: &Args, row: &AdapterSpec) -> Result {
    // At an address that disturbs no other program; for a bus, one with the faults that it can play on any.
    let place = if row.transport == "can" { EmulatorAddress::Pty } else { EmulatorAddress::InProcess };
    let (emulator, _) = start(args, row, &place)?;
    let mut table = Table::new(&["KIND", "~WHAT GOES WRONG"]);
    for (kind, about) in FaultKind::all() {
        // One in the far future only asks whether it can be played.
        if emulator.inject(Fault::new(kind).at(1e6)).is_ok() {
            table.row([kind.name(), about]);
        }
    }
    table.print();
    Ok(Exit::Ok)
}

impl Args {
    /// Where the emulator listens; by default where a client of the arm looks for it.
    fn place(&self, row: &AdapterSpec) -> Result<EmulatorAddress> {
        Ok(match (self.bind, &self.can, self.pty) {
            (Some(address), ..) => EmulatorAddress::Bind(address),
            (_, Some(interface), _) => EmulatorAddress::Can(interface.clone()),
            (_, _, true) => EmulatorAddress::Pty,
            _ if row.transport == "can" => {
                let failure = Failure::usage(format!("where is the CAN bus for {}?", row.name));
                return Err(failure.hint("--can vcan0, an interface of this computer, or --pty for a serial adapter"));
            }
            _ if row.transport == "serial" => EmulatorAddress::Pty,
            _ => EmulatorAddress::Bind(IpAddr::from([127, 0, 0, 1])),
        })
    }
}

fn start(args: &Args, row: &AdapterSpec, place: &EmulatorAddress) -> Result<(Box<dyn Emulator>, usize)> {
    let Some(emulate) = row.emulate else {
        let failure = Failure::usage(format!("{} has no emulator", row.name));
        return Err(failure.hint(if row.address.required {
            "test against a real arm: `dimos adapter test` with its --address"
        } else {
            "it needs none: it is an arm in memory"
        }));
    };
    let config = args.choice.config(row, "")?;
    match emulate(&config, place) {
        Ok(emulator) => Ok((emulator, config.dof)),
        Err(error) => Err(not_started(error)),
    }
}

/// A fault script: one fault as `key=value,…`, or a file with a list.
pub(super) fn script(text: &str) -> Result<Vec<Fault>> {
    let wrong = |what: String| Failure::usage(format!("--fault {text}: {what}"));
    if !text.contains('=') || Path::new(text).is_file() {
        let hint = "one fault, like at=2,kind=stall,duration=0.5, or a YAML or JSON file with a list of such";
        let content = bounded::read_text(Path::new(text), bounded::SMALL)
            .map_err(|e| wrong(format!("no file: {e}")).hint(hint))?;
        return serde_yaml::from_str(&content).map_err(|e| wrong(e.to_string()));
    }
    let mut fault = serde_json::Map::new();
    for part in text.split(',') {
        let (key, value) = part.split_once('=').ok_or_else(|| wrong(format!("{part:?} is not KEY=VALUE")))?;
        let value: Value = serde_yaml::from_str(value).map_err(|e| wrong(e.to_string()))?;
        if fault.insert(key.trim().to_owned(), value).is_some() {
            return Err(wrong(format!("{key} is given twice")));
        }
    }
    serde_json::from_value(Value::Object(fault)).map(|fault| vec![fault]).map_err(|e| wrong(e.to_string()))
}

/// Says where it is and how it is reached.
fn announce(args: &Args, row: &AdapterSpec, dof: usize, address: &str, registry: &Registry) {
    // The arm's own port need not be said.
    let given = match args.bind.or((row.transport == "tcp").then_some(IpAddr::from([127, 0, 0, 1]))) {
        Some(bind) if (row.address.check)(&bind.to_string()).is_ok_and(|full| full == address) => bind.to_string(),
        _ => address.to_owned(),
    };
    let program = program();
    let command = runnable(args, row, dof, &given, registry)
        .map(|(name, set)| format!("{program} run {name} --address arm={given}{set}"));
    if args.json {
        output::json(&json!({
            "event": "started",
            "adapter": row.name,
            "simulated": true,
            "dof": dof,
            "address": address,
            "run": command,
        }));
        return;
    }
    output::line(format_args!("{} SIMULATED at {address}", row.name));
    output::line(format_args!("  joints     {dof}"));
    if let Some(command) = command {
        output::line(format_args!("  reach it   {command}"));
    }
    let joints = if row.dof.0 == row.dof.1 { String::new() } else { format!(" --dof {dof}") };
    let flag: String = client_options(args)
        .map(
            |(key, value)| {
                if key == "model" { format!(" --model {value}") } else { format!(" --option {key}={value}") }
            },
        )
        .collect();
    let options: Vec<String> = client_options(args).map(|(key, value)| format!("{key}: {value}")).collect();
    let option = if options.is_empty() { String::new() } else { format!(", options: {{{}}}", options.join(", ")) };
    output::line(format_args!("  check it   {program} adapter test {} --address {given}{joints}{flag}", row.name));
    output::line(format_args!("  blueprint  adapter_type: {}, address: \"{given}\"{option}", row.name));
    output::note("Ctrl-C ends it");
}

/// What this program is called: a crate of its own has its arm in no other.
fn program() -> String {
    let path = std::env::args_os().next().unwrap_or_default();
    Path::new(&path).file_name().and_then(|name| name.to_str()).unwrap_or("dimos").to_owned()
}

/// The options that a client needs as well: its model and what is at the arm, not how the emulator behaves.
fn client_options(args: &Args) -> impl Iterator<Item = (&str, &str)> {
    let model = args.choice.model.iter().map(|model| ("model", model.as_str()));
    let others = args.choice.options.iter().map(|(key, value)| (key.as_str(), value.as_str()));
    model.chain(others.filter(|(key, _)| !key.contains('.')))
}

/// A blueprint by a likely name that runs this arm and no other, and the arguments that it needs for this emulator.
fn runnable(
    args: &Args,
    row: &AdapterSpec,
    dof: usize,
    address: &str,
    registry: &Registry,
) -> Option<(String, String)> {
    let (name, model) = (row.name, args.choice.model.as_deref().unwrap_or(row.name));
    let kebab = format!("coordinator-{}", name.replace('_', "-"));
    let names =
        [format!("coordinator-{model}"), format!("coordinator-{name}{dof}"), format!("coordinator-{name}"), kebab];
    names.into_iter().find_map(|name| {
        let found = blueprint::find(&name).ok()?;
        let set = vec![format!("hardware.arm.address={address}")];
        let loaded = blueprint::load(&found, &blueprint::Overrides { set, ..Default::default() }, registry).blueprint?;
        let [arm] = &loaded.arms[..] else { return None };
        let option = |key: &str| arm.options.get(key).and_then(Value::as_str).map(str::to_owned);
        let fits = arm.adapter_type == row.name
            && arm.joints.len() == dof
            && args.choice.model.as_ref().is_none_or(|wanted| {
                option("model").map_or(name == format!("coordinator-{wanted}"), |model| model == *wanted)
            });
        // What the emulator has otherwise than the blueprint; the gripper is the one part that blueprints add.
        let mut different: Vec<(String, String)> = client_options(args)
            .filter(|(key, value)| *key != "model" && option(key).as_deref() != Some(value))
            .map(|(key, value)| (key.to_owned(), value.to_owned()))
            .collect();
        if option(GRIPPER).is_some_and(|gripper| gripper != NONE)
            && !client_options(args).any(|(key, _)| key == GRIPPER)
        {
            different.push((GRIPPER.to_owned(), NONE.to_owned()));
        }
        let set = different.iter().map(|(key, value)| format!(" --set hardware.arm.options.{key}={value}"));
        fits.then(|| (name, set.collect()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_hardware::sim::faults::FaultKind;

    #[test]
    fn fault_scripts_are_read() {
        let one = script("at=2,kind=stall, duration=0.5").unwrap();
        assert_eq!(one, [Fault::new(FaultKind::Stall).at(2.0).lasting(0.5)]);
        for wrong in ["at=2", "at=2,kind=explode", "kind=stall,kind=nan", "kind=stall,5", "at=-1,kind=stall", "no/file"]
        {
            assert_eq!(script(wrong).unwrap_err().exit, Exit::Usage, "{wrong}");
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("faults.yaml");
        std::fs::write(&path, "- {at: 1, kind: estop, duration: 2}\n- {at: 5, kind: disconnect}\n").unwrap();
        let two = script(path.to_str().unwrap()).unwrap();
        assert_eq!((two.len(), two[1].kind), (2, FaultKind::Disconnect));
    }
}
