//! Checks `hardware`: names, joints, adapters, addresses, options, limits.

use std::time::Duration;

use crate::blueprint::resolve::{Arm, Checker};
use crate::blueprint::schema::{HardwareEntry, Joints, OnExit};
use crate::blueprint::{limits, park, parts, peripherals};
use dimos_core::arm::{Supervision, Topology};
use dimos_core::joint::{MAX_DOF, make_joints};
use dimos_hardware::check::{Checked, LineShare};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, SIM};
use dimos_yaml::{Diag, Located, NodeId, Tree, did_you_mean, quote};

/// The arms, and the names that tasks may refer to.
pub(super) struct Hardware {
    /// The arms with a known adapter.
    pub(super) arms: Vec<Arm>,
    /// Every entry of `hardware`.
    pub(super) entries: Vec<Entry>,
    /// Whether all ids could be read.
    pub(super) ids_known: bool,
    /// Whether all joint names could be read.
    pub(super) joints_known: bool,
}

/// The readable part of an entry of `hardware`.
pub(super) struct Entry {
    /// Its id; empty if it could not be read.
    pub(super) id: String,
    /// Position of the id.
    pub(super) at: NodeId,
    /// Names of its joints.
    pub(super) joints: Vec<String>,
    /// The row of its adapter; `None` if the adapter is unknown.
    pub(super) adapter: Option<AdapterSpec>,
    /// Its complete address and the position of that; `None` if it has none, or is simulated.
    place: Option<(String, NodeId)>,
    /// What it takes of its line, if other arms may be on it.
    line: Option<LineShare>,
}

pub(super) fn resolve(checker: &mut Checker<'_>, hardware: &[Located<HardwareEntry>]) -> Hardware {
    let whole = !checker.list_lost("hardware");
    if hardware.is_empty() && whole {
        let root = checker.root;
        let at = checker.tree.entry(root, "hardware").map_or(root, |(key, _)| key);
        let diag = Diag::error("the blueprint has no arm: `hardware` is empty");
        let hint = "add one: hardware: [{hardware_id: arm, adapter_type: mock, joints: {prefix: arm, count: 6}}]";
        checker.error(at, diag.hint(hint));
    }
    let known = whole && !hardware.is_empty();
    let mut found = Hardware { arms: Vec::new(), entries: Vec::new(), ids_known: known, joints_known: known };
    let mut named_at: Vec<(String, NodeId)> = Vec::new();
    let mut places = peripherals::Places::new();
    for entry in hardware {
        let (id, duplicate) = id(checker, entry, &found.entries);
        let (joints, joints_known) = joints(checker, entry, duplicate, &mut named_at);
        let adapter = adapter(checker, entry);
        found.ids_known &= !id.is_empty();
        found.joints_known &= joints_known;
        let (mut line, own) = (None, peripherals::resolve(checker, entry, &mut places));
        match adapter {
            Some(row) => {
                let arm = Arm { peripherals: own, ..arm(checker, entry, row, &id, &joints, joints_known) };
                peripherals::warn_of_emulators(checker, entry, &arm);
                line = arm.line;
                found.arms.push(arm);
            }
            None if joints_known => drop(limits::resolve(checker, &entry.limits, &joints, None)),
            None => {}
        }
        let place = adapter.as_ref().and_then(|row| place(checker, entry, (row, line), &found.entries));
        found.entries.push(Entry { id, at: entry.hardware_id.at, joints, adapter, place, line });
    }
    found
}

/// Returns the id (empty if it could not be read), and whether an earlier arm has the same one.
fn id(checker: &mut Checker<'_>, entry: &Located<HardwareEntry>, others: &[Entry]) -> (String, bool) {
    if !checker.has(entry.at, "hardware_id") {
        return (String::new(), false);
    }
    let id = &entry.hardware_id;
    checker.check_name(id, "hardware_id");
    let duplicate = others.iter().find(|other| other.id == id.value && !id.is_empty());
    if let Some(first) = duplicate {
        let also = checker.tree.label(first.at).with_text("first used here");
        let diag = Diag::error(format!("two arms have the hardware_id {}", quote(id)));
        checker.error(id.at, diag.also(also).hint("give each arm its own name"));
    }
    (id.value.clone(), duplicate.is_some())
}

/// Returns an arm's complete address; reports one that an earlier arm has, unless both can be on one line.
fn place(
    checker: &mut Checker<'_>,
    entry: &Located<HardwareEntry>,
    (row, line): (&AdapterSpec, Option<LineShare>),
    others: &[Entry],
) -> Option<(String, NodeId)> {
    let given = entry.address.as_ref().filter(|given| given.value != SIM && row.transport != "memory")?;
    let full = (row.address.check)(given).ok().filter(|full| !full.is_empty())?;
    // Names of hosts and interfaces in any case; files by what their links lead to.
    let full = if full.contains('/') { linked(&full) } else { full.to_ascii_lowercase() };
    let device = |place: &str| place.rsplit_once('@').filter(|_| place.contains('/')).map(|(file, _)| file.to_owned());
    let on_device = |other: &&Entry| {
        let place = other.place.as_ref().map(|(place, _)| place);
        place.is_some_and(|place| *place != full && device(place).is_some() && device(place) == device(&full))
    };
    if let Some((_, first)) = others.iter().find(on_device).and_then(|other| other.place.as_ref()) {
        let diag = Diag::error(format!("the arms on the line {} have two rates", quote(given)));
        let first = checker.tree.label(*first).with_text("first used here");
        checker.error(given.at, diag.hint("a line has one rate: give all its arms that").also(first));
    }
    let same = others.iter().filter(|other| other.place.as_ref().is_some_and(|(place, _)| *place == full));
    let is_beside = |other: &Entry| line.zip(other.line).is_some_and(|(own, line)| own.is_beside(&line));
    match { same.clone() }.find(|other| !is_beside(other)) {
        Some(other) => same_place(checker, entry, given, line.filter(|_| other.line.is_some()), other),
        None => {
            let load = same.filter_map(|other| other.line).chain(line).map(|line| line.load).sum::<f64>();
            if load > LineShare::MAX_LOAD {
                let (percent, most) = (load * 100.0, LineShare::MAX_LOAD * 100.0);
                let what =
                    format!("the arms at {} need {percent:.0} % of the line's time (limit {most:.0} %)", quote(given));
                checker.error(given.at, Diag::error(what).hint("give them a higher rate, or a line each"));
            }
        }
    }
    Some((full, given.at))
}

/// Reports an arm at the address of `other`. `line`: both could be on one line, with other numbers.
/// Returns the address of a line, PATH@RATE, with the file that links lead to.
fn linked(full: &str) -> String {
    let (file, rate) = full.rsplit_once('@').map_or((full, String::new()), |(file, rate)| (file, format!("@{rate}")));
    std::fs::canonicalize(file).map_or_else(|_| full.to_owned(), |file| format!("{}{rate}", file.display()))
}

fn same_place(
    checker: &mut Checker<'_>,
    entry: &HardwareEntry,
    given: &Located<String>,
    line: Option<LineShare>,
    other: &Entry,
) {
    let also = other.place.as_ref().map(|(_, first)| checker.tree.label(*first).with_text("first used here"));
    let also = also.into_iter();
    let option = line.zip(entry.options.as_ref()).and_then(|(line, options)| {
        let at = checker.tree.nearest(options.at, line.option);
        (at != options.at).then_some((line.numbers, at))
    });
    let diag = match option {
        Some(((from, to), _)) => {
            let what = format!("some of the numbers {from} to {to} are those of {}, on the same line", other.id);
            Diag::error(what).hint("give the devices of each arm their own numbers")
        }
        None => {
            let own_numbers = line.map_or(String::new(), |line| format!(", or its own `options.{}`", line.option));
            let hint = format!("give each arm the address of its own controller{own_numbers}");
            Diag::error(format!("two arms have the address {}", quote(given))).hint(hint)
        }
    };
    checker.error(option.map_or(given.at, |(_, at)| at), also.fold(diag, Diag::also));
}

/// Checks the settings that depend on the adapter, and builds the arm.
fn arm(
    checker: &mut Checker<'_>,
    entry: &Located<HardwareEntry>,
    row: AdapterSpec,
    id: &str,
    joints: &[String],
    joints_known: bool,
) -> Arm {
    let counted = joints_known && dof(checker, entry, &row, joints.len());
    let options = match entry.options.as_ref().map(|o| o.value.clone()) {
        None | Some(serde_json::Value::Null) => serde_json::json!({}),
        Some(options) => options,
    };
    let read = check_options(checker, entry, &row);
    let address = address(checker, entry, &row);
    let config = AdapterConfig {
        hardware_id: id.to_owned(),
        address: address.clone(),
        dof: joints.len(),
        options: options.clone(),
    };
    let checked = if counted && read { own_check(checker, entry, &row, &config) } else { None };
    let own = checked.as_ref().map(|checked| checked.limits.clone());
    let limits = match joints_known {
        true => limits::resolve(checker, &entry.limits, joints, own.as_ref()),
        false => Vec::new(),
    };
    let park_pose = park::resolve(checker, entry, joints, joints_known, own.as_ref(), &limits);
    let simulated = address == SIM && row.emulate.is_some();
    let checked = checked.unwrap_or_default();
    let setup = parts::resolve(checker, entry, &checked);
    let mut topology = [row.topology; MAX_DOF];
    topology.iter_mut().zip(&checked.topology).for_each(|(joint, own)| *joint = *own);
    let default_on_exit = if row.holds_when_disabled { OnExit::Disable } else { OnExit::Hold };
    Arm {
        hardware_id: id.to_owned(),
        hardware_type: entry.hardware_type,
        joints: joints.to_vec(),
        adapter: row,
        adapter_type: row.name.to_owned(),
        simulated,
        address,
        auto_enable: entry.auto_enable,
        on_exit: entry.on_exit.unwrap_or(default_on_exit),
        on_exit_given: entry.on_exit.is_some(),
        park_pose,
        supervision: supervision(entry, &row, simulated, topology),
        setup,
        peripherals: Vec::new(),
        options,
        own_limits: own.unwrap_or_default(),
        limits,
        tool: checked.tool,
        line: checked.line,
        tcp_velocity: None,
        tool_robot: None,
        setpoint: checked.setpoint,
        effort: None,
        body: None,
    }
}

/// Shortest default of `stale_after` for a simulated arm: its emulator is a thread and waits for a processor like any
/// other; the electronics of an arm do not.
const SIMULATED_STALE_AFTER: Duration = Duration::from_millis(250);

/// Returns the adapter's supervision figures, overridden by those of the blueprint.
fn supervision(
    entry: &HardwareEntry,
    row: &AdapterSpec,
    simulated: bool,
    topology: [Topology; MAX_DOF],
) -> Supervision {
    let stale_after = if simulated { row.stale_after.max(SIMULATED_STALE_AFTER) } else { row.stale_after };
    Supervision {
        accuracy: entry.accuracy.unwrap_or(row.accuracy),
        lag: entry.lag.unwrap_or(row.lag),
        stale_after: entry.stale_after.map_or(stale_after, Duration::from_secs_f64),
        tracking_tolerance: entry.tracking_tolerance.unwrap_or(Supervision::TRACKING_TOLERANCE),
        accept_zero_pose: entry.accept_zero_pose,
        droop: row.droop,
        relief: row.relief,
        outside: row.outside,
        gap_tolerance: row.gap_tolerance,
        after_gap: row.after_gap,
        topology,
    }
}

/// Reads the options as the adapter's type and reports every mistake; returns whether there is none.
fn check_options(checker: &mut Checker<'_>, entry: &Located<HardwareEntry>, row: &AdapterSpec) -> bool {
    if !checker.has(entry.at, "options") {
        return false;
    }
    let node = entry.options.as_ref().map(|o| o.at);
    let node = node.unwrap_or_else(|| checker.tree.add_empty_map(entry.adapter_type.at));
    let mistakes = |tree: &Tree| tree.diags().len() + tree.unlisted();
    let before = mistakes(checker.tree);
    (row.options.check)(checker.tree, node);
    mistakes(checker.tree) == before
}

/// Runs the adapter's check of joints and options, and reports a mistake at its option. Returns what is known of the
/// arm.
fn own_check(
    checker: &mut Checker<'_>,
    entry: &Located<HardwareEntry>,
    row: &AdapterSpec,
    config: &AdapterConfig,
) -> Option<Checked> {
    match (row.check)(config) {
        Ok(checked) => Some(checked),
        Err(refused) => {
            let at = match &entry.options {
                Some(options) if !refused.option.is_empty() => checker.tree.nearest(options.at, &refused.option),
                _ => counted_at(entry),
            };
            checker.error(at, Diag::error(refused.what).maybe_hint(refused.hint));
            None
        }
    }
}

/// Returns the names of the joints, and whether all could be read.
fn joints(
    checker: &mut Checker<'_>,
    entry: &Located<HardwareEntry>,
    duplicate: bool,
    named_at: &mut Vec<(String, NodeId)>,
) -> (Vec<String>, bool) {
    if !checker.has(entry.at, "joints") || checker.lost.contains(entry.joints.at) {
        return (Vec::new(), false);
    }
    let mut known = true;
    let names: Vec<Located<String>> = match &entry.joints.value {
        Joints::Names(names) => {
            for name in names {
                known &= checker.check_name(name, "joint name");
            }
            names.clone()
        }
        Joints::Counted(counted) => {
            known &= checker.check_name(&counted.prefix, "joint prefix");
            let count = counted.count.value;
            if count == 0 || count > MAX_DOF as u64 {
                let diag = Diag::error(format!("an arm has 1 to {MAX_DOF} joints, not {count}"));
                checker
                    .error(counted.count.at, diag.hint(format!("`count` is the number of joints, at most {MAX_DOF}")));
                return (Vec::new(), false);
            }
            let name = |value| Located { at: entry.joints.at, value };
            make_joints(&counted.prefix, count as usize).into_iter().map(name).collect()
        }
    };
    if names.is_empty() || names.len() > MAX_DOF {
        let diag = match names.is_empty() {
            true => Diag::error("the arm has no joints"),
            false => Diag::error(format!("an arm has at most {MAX_DOF} joints, not {}", names.len())),
        };
        checker.error(entry.joints.at, diag.hint("for example `joints: {prefix: arm, count: 6}`"));
        known = false;
    }
    // All joints of a duplicate arm are duplicates: reporting the arm is enough.
    if !duplicate {
        let mut collisions = Vec::new();
        for name in &names {
            match named_at.iter().find(|(other, _)| *other == name.value) {
                Some((_, first)) => collisions.push((name.clone(), *first)),
                None => named_at.push((name.value.clone(), name.at)),
            }
        }
        report_collisions(checker, &collisions);
    }
    (names.into_iter().map(|name| name.value).collect(), known)
}

/// Reports duplicate joint names, with one report per pattern.
fn report_collisions(checker: &mut Checker<'_>, collisions: &[(Located<String>, NodeId)]) {
    let mut reported: Vec<NodeId> = Vec::new();
    for (name, first) in collisions {
        if reported.contains(&name.at) {
            continue;
        }
        reported.push(name.at);
        let more = collisions.iter().filter(|(other, _)| other.at == name.at).count() - 1;
        let message = match more {
            0 => format!("the joint {} is named twice", quote(name)),
            more => format!("the joints {} and {more} more are named twice", quote(name)),
        };
        let also = checker.tree.label(*first).with_text("first named here");
        let diag = Diag::error(message);
        checker.error(name.at, diag.also(also).hint("a joint belongs to one arm, and its name is unique in the run"));
    }
}

fn adapter(checker: &mut Checker<'_>, entry: &Located<HardwareEntry>) -> Option<AdapterSpec> {
    if !checker.has(entry.at, "adapter_type") {
        return None;
    }
    let row = checker.catalog.adapters.get(&entry.adapter_type).copied();
    if row.is_none() {
        let name = quote(&entry.adapter_type);
        let diag = match checker.catalog.adapters.absent().find(|absent| absent.name == entry.adapter_type.value) {
            Some(absent) => Diag::error(format!("adapter {name} is not in this build")).hint(absent.remedy),
            None => {
                let hint = did_you_mean(&entry.adapter_type, checker.catalog.adapters.names(), "there are");
                Diag::error(format!("there is no adapter {name}")).maybe_hint(hint)
            }
        };
        checker.error(entry.adapter_type.at, diag);
    }
    row
}

/// Returns the node with the number of joints.
fn counted_at(entry: &HardwareEntry) -> NodeId {
    match &entry.joints.value {
        Joints::Counted(counted) => counted.count.at,
        Joints::Names(_) => entry.joints.at,
    }
}

/// Returns whether the adapter supports this number of joints; reports it if not.
fn dof(checker: &mut Checker<'_>, entry: &HardwareEntry, row: &AdapterSpec, count: usize) -> bool {
    let (fewest, most) = row.dof;
    if (fewest..=most).contains(&count) {
        return true;
    }
    let takes = if fewest == most { format!("{fewest}") } else { format!("{fewest} to {most}") };
    let also = checker.tree.label(entry.adapter_type.at).with_text(format!("takes {takes} joints"));
    let diag = Diag::error(format!("{} cannot have {count} joints", quote(row.name))).also(also);
    checker.error(counted_at(entry), diag.hint(format!("name {takes} joints, or choose another adapter")));
    false
}

/// Checks and returns the address; empty if there is none.
fn address(checker: &mut Checker<'_>, entry: &Located<HardwareEntry>, row: &AdapterSpec) -> String {
    let given = entry.address.as_ref();
    if !checker.has(entry.at, "address") {
        return String::new();
    }
    let form = row.address.form;
    let or_sim = if row.emulate.is_some() { ", or `sim` for the emulator" } else { "" };
    match given {
        None if row.address.required && !checker.incomplete => {
            let diag = Diag::error(format!("{} needs an address", quote(row.name)));
            checker.error(entry.adapter_type.at, diag.hint(format!("add `address: {form}`{or_sim}")));
        }
        None => {}
        Some(address) if address.value == SIM && row.emulate.is_some() => {}
        Some(address) if address.value == SIM && row.address.required => {
            let diag = Diag::error(format!("{} has no emulator", quote(row.name)));
            checker.error(address.at, diag.hint(format!("give the arm's address: {form}")));
        }
        Some(address) => {
            let needless = !row.address.required && matches!(form, "" | "-" | "none");
            if needless {
                let diag = Diag::warning(format!("{} needs no address; this one is ignored", quote(row.name)));
                checker.error(address.at, diag.hint("remove it"));
            } else if let Err(reason) = (row.address.check)(address) {
                let what = format!("{} is not an address of {}: {reason}", quote(address), quote(row.name));
                checker.error(address.at, Diag::error(what).hint(format!("write it as {form}{or_sim}")));
            }
        }
    }
    given.map(|a| a.value.clone()).unwrap_or_default()
}
