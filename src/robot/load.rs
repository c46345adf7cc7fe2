//! A description on disk, or one of those in the box → the robot, and everything that is wrong with it.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::json;

use crate::robot::model::RobotModel;
use crate::robot::packages::{Packages, absolute};
use crate::robot::urdf::{self, Meshes};
use crate::robot::xml::{self, Calls, Document};
use crate::robot::{builtin, xacro};
use crate::yaml::{Diag, Label, Report, Severity, Tree, render};

/// Which description to read, and how.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Source {
    /// A URDF or xacro file, or `builtin:NAME`.
    pub path: PathBuf,
    /// Folders of packages by name; those that ROS's environment variables show are found too.
    pub packages: BTreeMap<String, PathBuf>,
    /// Values of `xacro:arg`s.
    pub xacro_args: BTreeMap<String, String>,
    /// What to do about mesh files.
    pub meshes: Meshes,
}

impl Source {
    /// A description without arguments.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        Self { path: path.into(), ..Self::default() }
    }
}

/// A description that was read.
#[derive(Debug, Default)]
pub struct Loaded {
    tree: Tree,
    /// The robot; `None` when there are mistakes.
    pub model: Option<RobotModel>,
    /// The expanded URDF.
    pub document: Option<Document>,
    /// Every file that was read, the first one first. Empty for those in the box.
    pub files: Vec<PathBuf>,
}

impl Loaded {
    /// All mistakes as text.
    pub fn render(&self, colour: bool) -> String {
        self.tree.diags().iter().map(|diag| render(&self.tree, diag, colour) + "\n").collect()
    }

    /// All mistakes as data.
    pub fn reports(&self) -> Vec<Report> {
        self.tree.diags().iter().map(|diag| diag.located(&self.tree)).collect()
    }

    /// Number of warnings.
    pub fn warnings(&self) -> usize {
        self.tree.diags().iter().filter(|d| d.severity == Severity::Warning).count()
    }

    /// Whether anything must be put right.
    pub fn has_errors(&self) -> bool {
        self.tree.has_errors()
    }

    /// Adds a mistake that showed later; `range` is the place in the first file, where it has one.
    pub fn report(&mut self, diag: Diag) {
        self.tree.report(diag);
    }

    /// The expanded URDF as text.
    pub fn urdf(&self) -> Option<String> {
        self.document.as_ref().map(Document::to_text)
    }

    /// The robot, or all mistakes as text.
    pub fn into_model(self) -> Result<RobotModel, String> {
        let text = self.render(false);
        self.model.ok_or(text)
    }

    /// The mistakes for `--json`.
    pub fn to_json(&self) -> serde_json::Value {
        json!({"valid": !self.has_errors() && self.model.is_some(), "problems": self.reports()})
    }

    /// The sources and mistakes, for readers of files that belong to the description.
    pub(super) fn tree(&mut self) -> &mut Tree {
        &mut self.tree
    }
}

/// Reads a description: expanded if it is xacro, with every mistake that it has.
pub fn load(source: &Source) -> Loaded {
    let mut loaded = Loaded::default();
    let name = source.path.display().to_string();
    let Some(text) = text_of(source, &name, &mut loaded) else { return loaded };
    let id = loaded.tree.add_source(name, text);
    let Some(document) = xml::parse(&mut loaded.tree, id) else { return loaded };
    let packages = Packages::named(source.packages.clone()).with_environment();
    let mut calls = Calls::default();
    let document = if xacro::is_xacro(&source.path, &document) {
        let expansion = xacro::expand(&mut loaded.tree, &source.path, document, &packages, &source.xacro_args);
        let Some(expansion) = expansion else { return loaded };
        calls = expansion.calls;
        loaded.files = expansion.files;
        expansion.document
    } else {
        for name in source.xacro_args.keys() {
            let what = format!("the argument `{name}` has no effect: the description is no xacro");
            loaded.tree.report(Diag::warning(what).at(Label::start_of(id)));
        }
        document
    };
    let folder = absolute(&source.path).parent().map(Path::to_owned).unwrap_or_default();
    let resolve = |uri: &str| packages.resolve(uri, &folder);
    loaded.model = urdf::read(&document.root, &mut loaded.tree, &calls, source.meshes, &resolve);
    loaded.document = Some(document);
    loaded
}

/// The text of the first file.
fn text_of(source: &Source, name: &str, loaded: &mut Loaded) -> Option<String> {
    if let Some(robot) = name.strip_prefix(builtin::PREFIX) {
        if let Some(text) = builtin::text(robot) {
            return Some(text.to_owned());
        }
        let hint = crate::yaml::did_you_mean(robot, builtin::NAMES.iter().copied(), "there are");
        loaded.tree.report(Diag::error(format!("no robot in the box is named `{robot}`")).maybe_hint(hint));
        return None;
    }
    let path = &source.path;
    let refused = |what: String| Diag::error(format!("{}: {what}", path.display()));
    let read = || {
        let size = fs::metadata(path).map_err(|e| refused(e.to_string()))?.len();
        if size > xml::MAX_BYTES as u64 {
            return Err(refused(format!("the file is larger than {} MiB", xml::MAX_BYTES >> 20)));
        }
        let bytes = fs::read(path).map_err(|e| refused(e.to_string()))?;
        String::from_utf8(bytes).map_err(|_| refused("bytes that are not UTF-8".to_owned()))
    };
    match read() {
        Ok(text) => {
            loaded.files.push(absolute(path));
            Some(text)
        }
        Err(diag) => {
            loaded.tree.report(diag);
            None
        }
    }
}
