//! xacro without Python: expands macros, properties, conditions, includes and expressions like the original (version
//! 2.1), including the quirks that files depend on.
//!
//! ```text
//!  text ${…} $(…) ─▶ text ─▶ syntax ─▶ evaluate (functions, methods, format) ─▶ value
//!  elements ───────▶ expand (scope: properties, macros; call: macro calls; include: files, yaml11) ─▶ elements
//! ```
//!
//! A file's power is limited: it reads files of its own package and of given packages, its work and output are counted,
//! and its expressions are not Python.

mod call;
mod evaluate;
mod expand;
mod fill;
mod format;
mod functions;
mod include;
mod methods;
mod property;
mod scope;
mod syntax;
mod text;
mod tokens;
mod value;
mod yaml11;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::packages::Packages;
use crate::xml::{Calls, Document, SourcePos};
use dimos_core::message::Message;
use dimos_yaml::{Diag, Label, SourceId, Tree};

/// Namespace declaration that marks a file as xacro.
const NAMESPACE: &str = "xmlns:xacro";
/// Stack size of the expansion thread [bytes]: recursive macros nest deeply.
const STACK: usize = 256 << 20;

/// Result of an expansion.
#[derive(Debug, Clone, Default)]
pub struct Expansion {
    /// The expanded file.
    pub document: Document,
    /// Macro calls that source positions refer to.
    pub calls: Calls,
    /// Every file read, the main one first.
    pub files: Vec<PathBuf>,
    /// Arguments that no file declares, each with a similar name.
    pub unknown_args: Vec<(String, Option<String>)>,
}

/// Returns whether a description needs expansion: by its file name, or by the namespaces of its root.
pub fn is_xacro(path: &Path, document: &Document) -> bool {
    path.extension().is_some_and(|e| e == "xacro") || document.root.attribute(NAMESPACE).is_some()
}

/// Expands a parsed file. `args` are the values of `xacro:arg`. Reports errors with the macro calls and includes that
/// led there, and then returns nothing.
pub fn expand(
    tree: &mut Tree,
    path: &Path,
    document: Document,
    packages: &Packages,
    args: &BTreeMap<String, String>,
) -> Option<Expansion> {
    let source = document.root.at.source;
    let done = std::thread::scope(|scope| {
        let work = || expand::Expander::new(tree, path, packages, args).run(document);
        let thread = std::thread::Builder::new().name("xacro".to_owned()).stack_size(STACK);
        thread.spawn_scoped(scope, work).map(|thread| thread.join())
    });
    let failed = match done {
        Ok(Ok(expansion)) => return expansion,
        Ok(Err(_)) => "the expansion panicked: a bug in this program".to_owned(),
        Err(error) => format!("the expansion cannot be started: {error}"),
    };
    tree.report(Diag::error(failed).at(SourcePos { source, ..SourcePos::default() }.label()));
    None
}

/// Returns the warning about an argument that no file declares, with a similar name.
pub fn unknown_argument(name: &str, near: Option<&str>, source: SourceId) -> Diag {
    let what = format!("there is no xacro:arg `{name}`: the argument has no effect");
    let diag = Diag::warning(what).at(Label::start_of(source));
    diag.maybe_hint(near.map(|near| format!("did you mean `{near}`?")))
}

/// Why an expansion failed.
#[derive(Debug)]
struct ExpansionError {
    message: String,
    at: Option<SourcePos>,
    hint: Option<String>,
    also: Vec<(SourcePos, String)>,
}

type Result<T = ()> = std::result::Result<T, Box<ExpansionError>>;

impl ExpansionError {
    fn new(message: impl Into<String>) -> Box<Self> {
        let text: String = message.into();
        let Message { what: message, hint } = text.into();
        Box::new(Self { message, at: None, hint, also: Vec::new() })
    }

    fn at(mut self: Box<Self>, place: SourcePos) -> Box<Self> {
        self.at.get_or_insert(place);
        self
    }

    fn hint(mut self: Box<Self>, hint: Option<String>) -> Box<Self> {
        self.hint = self.hint.or(hint);
        self
    }

    /// Adds a position that led here; drops the outer ones of a long chain.
    fn also(mut self: Box<Self>, place: SourcePos, text: impl Into<String>) -> Box<Self> {
        if self.also.len() < 3 && self.at != Some(place) {
            self.also.push((place, text.into()));
        }
        self
    }

    fn diag(self, calls: &Calls, source: SourceId) -> Diag {
        let at = self.at.unwrap_or(SourcePos { source, ..SourcePos::default() });
        let mut diag = calls.explain(Diag::error(self.message).at(at.label()), at).maybe_hint(self.hint);
        for (place, text) in self.also {
            diag = diag.also(place.label().with_text(text));
        }
        diag
    }
}
