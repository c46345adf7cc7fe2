//! Loads a description, from disk or built in, and collects everything wrong with it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::json;

use crate::calibrated::{self, Places};
use crate::model::RobotModel;
use crate::packages::{Packages, absolute};
use crate::srdf::{self, Semantics};
use crate::urdf::{self, Meshes};
use crate::xml::{self, Calls, Document};
use crate::{builtin, encoding, joint_limits, xacro};
use dimos_core::message::Message;
use dimos_yaml::{Diag, Label, Report, Severity, Tree, render};

/// A description and how to read it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Source {
    /// A URDF or xacro file, or `builtin:NAME`.
    pub path: PathBuf,
    /// Folders of packages by name; those of ROS's environment variables are found too.
    pub packages: BTreeMap<String, PathBuf>,
    /// Values of `xacro:arg`.
    pub xacro_args: BTreeMap<String, String>,
    /// The robot's SRDF; may be xacro.
    pub srdf: Option<PathBuf>,
    /// The robot's `joint_limits.yaml`.
    pub joint_limits: Option<PathBuf>,
    /// Whether to look for mesh files.
    pub meshes: Meshes,
    /// Frames of joints that replace those of the description: of an arm whose own dimensions are known.
    pub places: Places,
}

impl Source {
    /// Creates a source without arguments.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        Self { path: path.into(), ..Self::default() }
    }
}

/// A loaded description.
#[derive(Debug, Default)]
pub struct Loaded {
    tree: Tree,
    /// The robot; `None` if there are errors.
    pub model: Option<RobotModel>,
    /// Contents of its SRDF; empty without one.
    pub semantics: Semantics,
    /// The expanded URDF.
    pub document: Option<Document>,
    /// Every file read, the main one first. Empty for built-in robots.
    pub files: Vec<PathBuf>,
}

impl Loaded {
    /// Returns all diagnostics as text.
    pub fn render(&self, colour: bool) -> String {
        let listed = self.tree.diags().iter().map(|diag| render(&self.tree, diag, colour) + "\n");
        let rest = (self.tree.unlisted() > 0).then(|| format!("{} more are not listed\n", self.tree.unlisted()));
        listed.chain(rest).collect()
    }

    /// Returns all diagnostics as data.
    pub fn reports(&self) -> Vec<Report> {
        self.tree.diags().iter().map(|diag| diag.located(&self.tree)).collect()
    }

    /// Returns the number of warnings.
    pub fn warnings(&self) -> usize {
        self.tree.warnings()
    }

    /// Returns whether there are errors.
    pub fn has_errors(&self) -> bool {
        self.tree.has_errors()
    }

    /// Returns why the description could not be read at all; `None` if it was, and the mistakes are in it.
    pub fn unreadable(&self) -> Option<&Diag> {
        let positioned = |diag: &&Diag| diag.severity == Severity::Error && diag.at.is_none();
        self.tree.diags().iter().find(positioned).filter(|_| self.document.is_none())
    }

    /// Adds a diagnostic found later, in a file that the description refers to.
    pub fn report(&mut self, diag: Diag) {
        self.tree.report(diag);
    }

    /// Returns the expanded URDF as text.
    pub fn urdf(&self) -> Option<String> {
        self.document.as_ref().map(Document::to_text)
    }

    /// Returns the robot, or all diagnostics as text.
    pub fn into_model(self) -> Result<RobotModel, String> {
        let text = self.render(false);
        self.model.ok_or(text)
    }

    /// Returns the diagnostics for `--json`.
    pub fn to_json(&self) -> serde_json::Value {
        json!({"valid": !self.has_errors() && self.model.is_some(), "problems": self.reports()})
    }
}

/// Loads a description: expands xacro, applies SRDF and limits, and collects every mistake.
pub fn load(source: &Source) -> Loaded {
    let mut loaded = Loaded::default();
    let packages = Packages::named(source.packages.clone()).with_environment();
    let Some((mut document, calls)) = expanded(&source.path, source, &packages, true, &mut loaded) else {
        return loaded;
    };
    let folder = absolute(&source.path).parent().map(Path::to_owned).unwrap_or_default();
    let resolve = |uri: &str| packages.resolve(uri, &folder);
    let mut model = urdf::read(&document.root, &mut loaded.tree, &calls, source.meshes, &resolve);
    calibrated::put(&source.places, model.as_mut(), &mut document);
    loaded.document = Some(document);
    if let Some(robot) = &mut model {
        if let Some(path) = &source.srdf
            && let Some((document, calls)) = expanded(path, source, &packages, false, &mut loaded)
        {
            loaded.semantics = srdf::read(&document.root, robot, &mut loaded.tree, &calls).unwrap_or_default();
        }
        if let Some(path) = &source.joint_limits
            && let Some(text) = text_of(path, &mut loaded)
        {
            let id = loaded.tree.add_source(path.display().to_string(), text);
            joint_limits::apply(&mut loaded.tree, id, robot);
        }
    }
    loaded.model = model.filter(|_| !loaded.tree.has_errors());
    loaded
}

/// Reads an XML file, expanded if it is xacro. `arguments`: only the main file reports arguments without effect.
fn expanded(
    path: &Path,
    source: &Source,
    packages: &Packages,
    main: bool,
    loaded: &mut Loaded,
) -> Option<(Document, Calls)> {
    let text = text_of(path, loaded)?;
    let id = loaded.tree.add_source(path.display().to_string(), text);
    let document = xml::parse(&mut loaded.tree, id)?;
    if xacro::is_xacro(path, &document) {
        let expansion = xacro::expand(&mut loaded.tree, path, document, packages, &source.xacro_args)?;
        loaded.files.extend(expansion.files.into_iter().skip(1));
        for (name, near) in expansion.unknown_args.into_iter().filter(|_| main) {
            loaded.tree.report(xacro::unknown_argument(&name, near.as_deref(), id));
        }
        return Some((expansion.document, expansion.calls));
    }
    for name in source.xacro_args.keys().filter(|_| main) {
        let what = format!("the argument `{name}` has no effect: the description is not xacro");
        loaded.tree.report(Diag::warning(what).at(Label::start_of(id)));
    }
    Some((document, Calls::default()))
}

/// Returns the text of a file, or of a built-in robot.
fn text_of(path: &Path, loaded: &mut Loaded) -> Option<String> {
    if let Some(robot) = path.to_str().and_then(|name| name.strip_prefix(builtin::PREFIX)) {
        if let Some(text) = builtin::text(robot) {
            return Some(text.to_owned());
        }
        let hint = dimos_yaml::did_you_mean(robot, builtin::names(), "there are");
        loaded.tree.report(Diag::error(format!("unknown built-in robot `{robot}`")).maybe_hint(hint));
        return None;
    }
    match encoding::read(path, xml::MAX_BYTES as u64) {
        Ok(text) => {
            loaded.files.push(absolute(path));
            Some(text)
        }
        Err(why) => {
            let Message { what, hint } = why.into();
            loaded.tree.report(Diag::error(format!("{}: {what}", path.display())).maybe_hint(hint));
            None
        }
    }
}
