//! Reads and checks a blueprint, and collects every mistake in it.

use serde::Serialize;

use crate::blueprint::assets::Assets;
use crate::blueprint::catalog::Catalog;
use crate::blueprint::include::{Includer, RULES};
use crate::blueprint::json_schema::hint_of;
use crate::blueprint::registry::{Found, SearchPath};
use crate::blueprint::resolve::{Blueprint, Checker, resolve};
use crate::blueprint::schema::BlueprintFile;
use dimos_hardware::registry::{Registry, SIM};
use dimos_yaml as yaml;
use dimos_yaml::{Diag, Keyed, Label, Missing, NodeId, Report, Severity, Tree, did_you_mean, quote, read};

/// Changes of a blueprint by command-line options.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Overrides {
    /// `--set path=value`, in the order given.
    pub set: Vec<String>,
    /// `--address arm=address`: names of arms and their addresses; they win over those of the blueprint and of `set`.
    pub address: Vec<(String, String)>,
    /// `--sim`: replaces every arm by its emulator. An error if the adapter of a real arm has none.
    pub sim: bool,
    /// `--sim=physics`: with `sim`, the emulators of arms have bodies with mass.
    pub physics: bool,
}

/// A loaded blueprint and its diagnostics.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// The blueprint; `None` if there are errors.
    pub blueprint: Option<Blueprint>,
    tree: Tree,
    diags: Vec<Diag>,
}

impl Loaded {
    /// Returns all diagnostics, file by file from top to bottom.
    pub fn diagnostics(&self) -> &[Diag] {
        &self.diags
    }

    /// Returns the number of errors.
    pub fn errors(&self) -> usize {
        self.tree.errors()
    }

    /// Returns the number of warnings.
    pub fn warnings(&self) -> usize {
        self.tree.warnings()
    }

    /// Adds a diagnostic that a later check found, without a position in the blueprint.
    pub fn report(&mut self, diag: Diag) {
        self.tree.report(diag);
        self.diags = in_order(&self.tree);
    }

    /// Returns all diagnostics as text, with the numbers of errors and warnings in the last line; empty if there are
    /// none.
    pub fn render(&self, colour: bool) -> String {
        let mut out = String::new();
        for diag in &self.diags {
            out.push_str(&yaml::render(&self.tree, diag, colour));
            out.push_str("\n\n");
        }
        if self.tree.unlisted() > 0 {
            let what = if self.errors() > 0 { "mistakes" } else { "warnings" };
            out.push_str(&format!("Not all {what} are listed; fix these first.\n"));
        }
        let count = |n: usize, what: &str| match n {
            0 => None,
            1 => Some(format!("1 {what}")),
            n => Some(format!("{n} {what}s")),
        };
        let counts: Vec<String> =
            [count(self.errors(), "error"), count(self.warnings(), "warning")].into_iter().flatten().collect();
        if !counts.is_empty() {
            out.push_str(&format!("{}\n", counts.join(", ")));
        }
        out
    }

    /// Returns all diagnostics as data.
    pub fn reports(&self) -> Vec<Report> {
        self.diags.iter().map(|diag| diag.located(&self.tree)).collect()
    }

    /// Returns all diagnostics as JSON: `{"ok", "errors", "warnings", "diagnostics": […]}`.
    pub fn to_json(&self) -> serde_json::Value {
        #[derive(Serialize)]
        struct Document {
            ok: bool,
            errors: usize,
            warnings: usize,
            diagnostics: Vec<Report>,
        }
        let document = Document {
            ok: self.errors() == 0,
            errors: self.errors(),
            warnings: self.warnings(),
            diagnostics: self.reports(),
        };
        serde_json::to_value(document).unwrap_or_default()
    }

    /// Returns the first error in one line, with its position.
    pub(super) fn first_problem(&self) -> Option<String> {
        let report = self.reports().into_iter().find(|r| r.severity == Severity::Error)?;
        Some(match (report.line, report.column) {
            (Some(line), Some(column)) => format!("{line}:{column}: {}", report.message),
            _ => report.message,
        })
    }
}

/// Reads and checks a blueprint; searches includes in the folders of [`SearchPath::from_env`].
pub fn load<'a>(found: &Found, overrides: &Overrides, catalog: impl Into<Catalog<'a>>) -> Loaded {
    load_from(&SearchPath::from_env(), found, overrides, catalog)
}

/// Reads and checks a blueprint; searches includes in `search`.
pub fn load_from<'a>(
    search: &SearchPath,
    found: &Found,
    overrides: &Overrides,
    catalog: impl Into<Catalog<'a>>,
) -> Loaded {
    let mut tree = Tree::new();
    let blueprint = read_blueprint(&mut tree, search, found, overrides, catalog.into());
    let diags = in_order(&tree);
    Loaded { blueprint, tree, diags }
}

/// Returns the diagnostics in the order of the text. The main file is the first source, arguments are the last;
/// diagnostics without a position come first.
fn in_order(tree: &Tree) -> Vec<Diag> {
    let mut diags = tree.diags().to_vec();
    diags.sort_by_key(|d| d.at.as_ref().map(|at| (at.source, at.range.start)));
    diags
}

fn read_blueprint(
    tree: &mut Tree,
    search: &SearchPath,
    found: &Found,
    overrides: &Overrides,
    catalog: Catalog<'_>,
) -> Option<Blueprint> {
    tree.know_hints(hint_of);
    let mut includer = Includer::new(tree, search);
    let root = includer.read(found);
    let incomplete = includer.incomplete;
    let root = root?;
    let sources = tree.sources().iter().map(|s| (s.name.clone(), s.text.clone())).collect();

    for argument in &overrides.set {
        yaml::set(tree, root, argument, &RULES);
    }
    for (arm, address) in &overrides.address {
        use_address(tree, root, arm, address);
    }
    if overrides.sim {
        simulate(tree, root, catalog.adapters, overrides.physics);
    }
    let missing = if incomplete { Missing::Ignore } else { Missing::Report };
    let (file, lost) = read::<BlueprintFile>(tree, root, missing);
    let assets = Assets::of(Keyed::default());
    let checker = Checker { tree, root, lost, catalog, assets, incomplete };
    let mut blueprint = resolve(checker, file?, &found.name);
    blueprint.sources = sources;
    if tree.has_errors() {
        return None;
    }
    blueprint.source_yaml = merged_yaml(tree, root, &blueprint.name);
    Some(blueprint)
}

/// `--address`: sets the address of one arm. An arm that the blueprint does not have is an error.
fn use_address(tree: &mut Tree, root: NodeId, arm: &str, address: &str) {
    let argument = format!("{arm}={address}");
    let source = tree.add_source("--address", &argument);
    let hardware = tree.get(root, "hardware").map(|list| tree.items(list).to_vec()).unwrap_or_default();
    let id = |entry: &NodeId| tree.get(*entry, "hardware_id").and_then(|node| tree.text(node)).map(str::to_owned);
    let arms: Vec<(String, NodeId)> = hardware.iter().filter_map(|entry| Some((id(entry)?, *entry))).collect();
    match arms.iter().find(|(id, _)| id == arm) {
        Some((_, entry)) => tree.put_text(*entry, "address", address, (source, arm.len() + 1..argument.len())),
        None => {
            let at = Label { source, range: 0..arm.len(), text: String::new() };
            let hint = did_you_mean(arm, arms.iter().map(|(id, _)| id.as_str()), "its arms are");
            tree.report(Diag::error(format!("the blueprint has no arm {}", quote(arm))).at(at).maybe_hint(hint));
        }
    }
}

/// `--sim`: sets the address of every arm and peripheral to its emulator. A real arm without an emulator is an error.
fn simulate(tree: &mut Tree, root: NodeId, adapters: &Registry, physics: bool) {
    let source = tree.add_source("--sim", "--sim");
    let hardware = tree.get(root, "hardware").map(|list| tree.items(list).to_vec()).unwrap_or_default();
    for entry in hardware {
        let own: Vec<NodeId> = ["gripper", "force_torque"].iter().filter_map(|part| tree.get(entry, part)).collect();
        own.into_iter().for_each(|own| tree.put_text(own, "address", SIM, (source, 0..5)));
        let name = tree.get(entry, "adapter_type").and_then(|node| tree.text(node));
        let Some(row) = name.and_then(|name| adapters.get(name)) else { continue };
        if physics && row.transport == "memory" {
            let at = tree.get(entry, "adapter_type").map(|node| tree.label(node));
            let diag = Diag::warning(format!("{} has no body: its joints follow without mass", quote(row.name)));
            tree.report(at.into_iter().fold(diag, Diag::at));
        }
        if row.emulate.is_some() {
            tree.put_text(entry, "address", SIM, (source, 0..5));
            if physics {
                has_body(tree, root, entry);
            }
        } else if row.address.required {
            let at = tree.get(entry, "adapter_type").map(|node| tree.label(node));
            let diag =
                Diag::error(format!("{} has no emulator: with --sim its arm would be the real one", quote(row.name)));
            let diag = diag.at(Label { source, range: 0..5, text: String::new() });
            let diag = at.into_iter().fold(diag, |diag, at| diag.also(at.with_text("this arm")));
            tree.report(diag.hint("run without --sim, or use `adapter_type: mock` for this arm"));
        }
    }
}

/// Gives the emulator of an arm a body with mass, unless the blueprint has given it one.
fn has_body(tree: &mut Tree, root: NodeId, entry: NodeId) {
    let given = ["options", "sim", "physics"].iter().try_fold(entry, |node, key| tree.get(node, key));
    let id = tree.get(entry, "hardware_id").and_then(|node| tree.text(node)).map(str::to_owned);
    if let Some(id) = id.filter(|_| given.is_none()) {
        yaml::set(tree, root, &format!("hardware.{id}.options.sim.physics={{}}"), &RULES);
    }
}

/// Returns the merged blueprint as YAML.
fn merged_yaml(tree: &mut Tree, root: NodeId, name: &str) -> String {
    let (value, _) = read::<serde_yaml::Value>(tree, root, Missing::Ignore);
    let Some(serde_yaml::Value::Mapping(merged)) = value else { return String::new() };
    let mut whole = serde_yaml::Mapping::new();
    whole.insert("name".into(), name.into());
    whole.extend(merged.into_iter().filter(|(key, _)| !matches!(key.as_str(), Some("name" | "include"))));
    serde_yaml::to_string(&whole).unwrap_or_default()
}
