//! Checks `hardware[].gripper` and `hardware[].force_torque`: devices at an arm with their own connections.

use schemars::JsonSchema;
use serde::Deserialize;
use serde_json::{Value, json};

use crate::blueprint::resolve::{Arm, Checker};
use crate::blueprint::schema::HardwareEntry;
use dimos_hardware::peripheral::{Part, PeripheralSpec};
use dimos_hardware::registry::{AdapterConfig, SIM};
use dimos_yaml::{Diag, Located, NodeId, Raw, did_you_mean, quote};

/// The value of an arm's own option for an arm without such a part.
const NONE: &str = "none";

/// A gripper or a sensor at the arm, with its own connection.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PeripheralEntry {
    /// Its adapter; see `dimos list-adapters`.
    pub adapter_type: Located<String>,
    /// Its address, in the form that `dimos list-adapters` shows; `sim` starts the adapter's emulator.
    #[serde(default)]
    pub address: Option<Located<String>>,
    /// The adapter's own options.
    #[serde(default)]
    #[schemars(with = "Option<serde_json::Map<String, serde_json::Value>>")]
    pub options: Option<Raw>,
}

/// A peripheral of an arm.
#[derive(Debug, Clone)]
pub struct ArmPeripheral {
    /// Its adapter's row.
    pub row: PeripheralSpec,
    /// Its address; `sim` for the emulator.
    pub address: String,
    /// Its adapter's own options: an object.
    pub options: Value,
}

impl ArmPeripheral {
    /// Returns whether its adapter's emulator replaces it.
    pub fn is_simulated(&self) -> bool {
        self.address == SIM && self.row.emulate.is_some()
    }

    /// Returns the complete address of the device.
    pub fn full_address(&self) -> String {
        // The blueprint was checked: an address that cannot be completed stays as it is.
        (self.row.address.check)(&self.address).unwrap_or_else(|_| self.address.clone())
    }

    /// Returns what its adapter is made from. `arm`: the arm's `hardware_id`.
    pub fn config(&self, arm: &str) -> AdapterConfig {
        let (address, options) = (self.address.clone(), self.options.clone());
        AdapterConfig { hardware_id: arm.to_owned(), address, dof: 0, options }
    }
}

/// Complete addresses, and where they are written.
pub(super) type Places = Vec<(String, NodeId)>;

/// Checks and returns the peripherals of an arm. `places`: the addresses so far, to which theirs are added.
pub(super) fn resolve(
    checker: &mut Checker<'_>,
    entry: &Located<HardwareEntry>,
    places: &mut Places,
) -> Vec<ArmPeripheral> {
    let parts = [(Part::Gripper, &entry.gripper), (Part::ForceTorque, &entry.force_torque)];
    let given = parts.into_iter().filter_map(|(part, given)| Some((part, given.as_ref()?)));
    given.filter_map(|(part, given)| peripheral(checker, entry, (part, given), places)).collect()
}

fn peripheral(
    checker: &mut Checker<'_>,
    arm: &HardwareEntry,
    (part, given): (Part, &Located<PeripheralEntry>),
    places: &mut Places,
) -> Option<ArmPeripheral> {
    arms_own(checker, arm, part, given.at);
    let row = row(checker, part, given)?;
    let options = match given.options.as_ref().map(|options| options.value.clone()) {
        None | Some(Value::Null) => json!({}),
        Some(options) => options,
    };
    let read = check_options(checker, given, &row);
    let found = ArmPeripheral { row, address: address(checker, given, &row), options };
    if read && let Err(refused) = (row.check)(&found.config(&arm.hardware_id)) {
        let node = given.options.as_ref().map_or(given.adapter_type.at, |options| options.at);
        let at = if refused.option.is_empty() { node } else { checker.tree.nearest(node, &refused.option) };
        checker.error(at, Diag::error(refused.what).maybe_hint(refused.hint));
    }
    if let Some(own) = given.address.as_ref().filter(|own| own.value != SIM) {
        let full = found.full_address();
        if let Some((_, first)) = places.iter().find(|(other, _)| *other == full) {
            let also = checker.tree.label(*first).with_text("first used here");
            let diag = Diag::error(format!("two devices have the address {}", quote(own)));
            checker.error(own.at, diag.also(also).hint("give each device a line of its own"));
        }
        places.push((full, own.at));
    }
    Some(found)
}

/// Warns of an emulator at a real arm: what it reports is not so.
pub(super) fn warn_of_emulators(checker: &mut Checker<'_>, entry: &HardwareEntry, arm: &Arm) {
    for own in arm.peripherals.iter().filter(|own| arm.is_real() && own.is_simulated()) {
        let part = own.row.part;
        let given = if part == Part::Gripper { &entry.gripper } else { &entry.force_torque };
        let at = given.as_ref().and_then(|given| given.address.as_ref()).map_or(entry.hardware_id.at, |at| at.at);
        let diag = Diag::warning(format!("the arm is real, and its {} an emulator", part.text()));
        checker.error(at, diag.hint(format!("give its address: {}", own.row.address.form)));
    }
}

/// Reports a part that the arm's own option sets, too.
fn arms_own(checker: &mut Checker<'_>, arm: &HardwareEntry, part: Part, at: NodeId) {
    let Some(options) = &arm.options else { return };
    let own = options.value.get(part.name());
    if own.is_none_or(|own| own.is_null() || *own == NONE) {
        return;
    }
    let also = checker.tree.label(at).with_text("and here another one");
    let node = checker.tree.nearest(options.at, part.name());
    let diag = Diag::error(format!("the arm has a {} by its own option", part.text()));
    checker.error(
        node,
        diag.also(also).hint(format!("set `options.{part}: none`, or remove the other one", part = part.name())),
    );
}

fn row(checker: &mut Checker<'_>, part: Part, given: &Located<PeripheralEntry>) -> Option<PeripheralSpec> {
    if !checker.has(given.at, "adapter_type") {
        return None;
    }
    let name = &given.adapter_type;
    let adapters = checker.catalog.adapters;
    let found = adapters.peripheral(name).copied();
    let row = found.filter(|row| row.part == part);
    if row.is_none() {
        let names = adapters.peripherals().iter().filter(|row| row.part == part).map(|row| row.name);
        let what = match found {
            Some(other) => format!("{} is a {}, not a {}", quote(name), other.part.text(), part.text()),
            None if adapters.get(name).is_some() => format!("{} is an arm, not a {}", quote(name), part.text()),
            None => format!("there is no {} adapter {}", part.text(), quote(name)),
        };
        checker.error(name.at, Diag::error(what).maybe_hint(did_you_mean(name, names, "there are")));
    }
    row
}

/// Reads the options as the adapter's type and reports every mistake; returns whether there is none.
fn check_options(checker: &mut Checker<'_>, given: &Located<PeripheralEntry>, row: &PeripheralSpec) -> bool {
    if !checker.has(given.at, "options") {
        return false;
    }
    let node = given.options.as_ref().map(|options| options.at);
    let node = node.unwrap_or_else(|| checker.tree.add_empty_map(given.adapter_type.at));
    let before = checker.tree.diags().len() + checker.tree.unlisted();
    (row.options.check)(checker.tree, node);
    checker.tree.diags().len() + checker.tree.unlisted() == before
}

/// Checks and returns the address; empty if there is none.
fn address(checker: &mut Checker<'_>, given: &Located<PeripheralEntry>, row: &PeripheralSpec) -> String {
    if !checker.has(given.at, "address") {
        return String::new();
    }
    let form = row.address.form;
    let or_sim = if row.emulate.is_some() { ", or `sim` for the emulator" } else { "" };
    match &given.address {
        None if row.address.required && !checker.incomplete => {
            let diag = Diag::error(format!("{} needs an address", quote(row.name)));
            checker.error(given.adapter_type.at, diag.hint(format!("add `address: {form}`{or_sim}")));
        }
        Some(address) if address.value == SIM && row.emulate.is_none() => {
            let diag = Diag::error(format!("{} has no emulator", quote(row.name)));
            checker.error(address.at, diag.hint(format!("give the device's address: {form}")));
        }
        None => {}
        Some(address) if address.value == SIM => {}
        Some(address) => {
            if let Err(reason) = (row.address.check)(address) {
                let what = format!("{} is not an address of {}: {reason}", quote(address), quote(row.name));
                checker.error(address.at, Diag::error(what).hint(format!("write it as {form}{or_sim}")));
            }
        }
    }
    given.address.as_ref().map(|address| address.value.clone()).unwrap_or_default()
}
