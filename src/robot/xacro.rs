//! xacro without Python: macros, properties, conditions, includes and expressions of robot descriptions are expanded
//! as the original (version 2.1) does it; its quirks included, where files depend on them.
//!
//! ```text
//!  text ${…} $(…) ─▶ text ─▶ syntax ─▶ evaluate (functions, methods, format) ─▶ value
//!  elements ───────▶ expand (scope: properties, macros; call: macro calls; include: files, yaml11) ─▶ elements
//! ```
//!
//! What a file may do is bounded: it reads files of its own package and of packages it was given, its work and its
//! output are counted, and its expressions are no Python.

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

use crate::message::Message;
use crate::robot::packages::Packages;
use crate::robot::xml::{Calls, Document, Place};
use crate::yaml::{Diag, SourceId, Tree};

/// The namespace that marks a file as xacro.
const NAMESPACE: &str = "xmlns:xacro";
/// Expansion nests deeply where macros call themselves: it has a stack of its own [bytes].
const STACK: usize = 256 << 20;

/// What an expansion came to.
#[derive(Debug, Clone, Default)]
pub struct Expansion {
    /// The expanded file.
    pub document: Document,
    /// The macro calls that places refer to.
    pub calls: Calls,
    /// Every file that was read, the first one first.
    pub files: Vec<PathBuf>,
    /// Arguments that no file knows, each with a name that is close.
    pub unknown_args: Vec<(String, Option<String>)>,
}

/// Whether a description needs expansion: by its name, or by what its root declares.
pub fn is_xacro(path: &Path, document: &Document) -> bool {
    path.extension().is_some_and(|e| e == "xacro") || document.root.attribute(NAMESPACE).is_some()
}

/// Expands a file that was parsed already. `args` are the values of `xacro:arg`s. What is wrong is reported, with
/// the macro calls and includes that led there; then nothing comes out.
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
        Ok(Err(_)) => "the expansion failed within: this is a mistake of the program".to_owned(),
        Err(error) => format!("the expansion cannot be started: {error}"),
    };
    tree.report(Diag::error(failed).at(Place { source, ..Place::default() }.label()));
    None
}

/// Why an expansion ended.
#[derive(Debug)]
struct Trouble {
    message: String,
    at: Option<Place>,
    hint: Option<String>,
    also: Vec<(Place, String)>,
}

type Result<T = ()> = std::result::Result<T, Box<Trouble>>;

impl Trouble {
    fn new(message: impl Into<String>) -> Box<Self> {
        let text: String = message.into();
        let Message { what: message, hint } = text.into();
        Box::new(Self { message, at: None, hint, also: Vec::new() })
    }

    fn at(mut self: Box<Self>, place: Place) -> Box<Self> {
        self.at.get_or_insert(place);
        self
    }

    fn hint(mut self: Box<Self>, hint: Option<String>) -> Box<Self> {
        self.hint = self.hint.or(hint);
        self
    }

    /// Adds a place that led here; the outer ones of a long way are left out.
    fn also(mut self: Box<Self>, place: Place, text: impl Into<String>) -> Box<Self> {
        if self.also.len() < 3 && self.at != Some(place) {
            self.also.push((place, text.into()));
        }
        self
    }

    fn diag(self, calls: &Calls, source: SourceId) -> Diag {
        let at = self.at.unwrap_or(Place { source, ..Place::default() });
        let mut diag = calls.explain(Diag::error(self.message).at(at.label()), at).maybe_hint(self.hint);
        for (place, text) in self.also {
            diag = diag.also(place.label().with_text(text));
        }
        diag
    }
}
