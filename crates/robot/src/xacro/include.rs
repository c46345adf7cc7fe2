//! Files that a description reads: `xacro:include`, `load_yaml`. Only from its own package, given packages, and
//! packages known to ROS.

use std::fs;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use super::evaluate::{Evaluated, evaluate};
use super::expand::{Env, Expander, boolean};
use super::scope::{Entry, MacroEntry};
use super::value::Value;
use super::yaml11;
use super::{ExpansionError, Result};
use crate::encoding;
use crate::xml::{self, Document, Element, Node};

/// Maximum nesting of includes.
const MAX_DEPTH: usize = 16;
/// Maximum number of files per expansion.
const MAX_FILES: usize = 1000;

impl Expander<'_> {
    /// `xacro:include`: inserts the file's content.
    pub(super) fn include(&mut self, element: &Element, parent: &mut Element, env: Env) -> Result<Vec<Node>> {
        let at = element.attribute("filename").map_or(element.at, |a| a.at);
        let name = self.needed(element, "filename", env)?;
        let optional = match element.attribute("optional") {
            Some(a) => boolean(&a.value.as_str().into(), &a.value).map_err(|e| ExpansionError::new(e).at(a.at))?,
            None => false,
        };
        let inner = match element.attribute("ns").filter(|ns| !ns.value.is_empty()) {
            Some(_) => {
                let namespace = self.needed(element, "ns", env)?;
                let inner = Env { symbols: self.scopes.below(env.symbols, true), macros: self.macros.below(None) };
                self.scopes.set(env.symbols, &namespace, Entry::Value(Value::Namespace(inner.symbols)));
                self.macros.set(env.macros, &namespace, MacroEntry::Namespace(inner.macros));
                inner
            }
            None => env,
        };
        let path = self.beside(&name);
        let mut content = Vec::new();
        for path in matching(&path) {
            self.allowed(&path).map_err(|e| ExpansionError::new(e).at(at))?;
            if !path.is_file() {
                if optional {
                    continue;
                }
                return Err(ExpansionError::new(format!("No such file or directory: {}", path.display())).at(at));
            }
            if self.files.len() > MAX_DEPTH {
                return Err(ExpansionError::new(format!("includes are nested deeper than {MAX_DEPTH}")).at(at));
            }
            let document = self.parse(&path).map_err(|e| e.at(at))?;
            self.files.push(path);
            let mut root = document.root.clone();
            let done = self.element(&mut root, inner);
            self.files.pop();
            done.map_err(|e| e.also(at, "included here"))?;
            self.import_namespaces(parent, &root);
            content.extend(root.children);
        }
        Ok(content)
    }

    /// Rejects files outside the allowed packages.
    fn allowed(&self, path: &Path) -> Evaluated<()> {
        if self.roots.iter().any(|root| path.starts_with(root)) {
            return Ok(());
        }
        let root = self.roots.first().map(|r| r.display().to_string()).unwrap_or_default();
        Err(format!(
            "{} is not in the package of this description ({root})\nhint: a package is the folder with a package.xml; \
             name others by --package NAME=FOLDER and use $(find NAME)",
            path.display()
        ))
    }

    fn parse(&mut self, path: &Path) -> Result<Rc<Document>> {
        if let Some(known) = self.parsed.get(path) {
            return Ok(known.clone());
        }
        let text = self.content_of(path, xml::MAX_BYTES as u64).map_err(ExpansionError::new)?;
        let source = self.tree.add_source(path.display().to_string(), text);
        let Some(document) = xml::parse(self.tree, source) else {
            return Err(ExpansionError::new(format!("cannot read the included file: {}", path.display())));
        };
        let document = Rc::new(document);
        self.parsed.insert(path.to_owned(), document.clone());
        Ok(document)
    }

    /// Reads a file and counts it.
    fn content_of(&mut self, path: &Path, most: u64) -> Evaluated<String> {
        let named = |what: String| format!("{}: {what}", path.display());
        if self.read.len() >= MAX_FILES {
            return Err(named(format!("more than {MAX_FILES} files")));
        }
        let text = encoding::read(path, most).map_err(named)?;
        self.read.push(path.to_owned());
        Ok(text)
    }

    /// `xacro.load_yaml(path)`
    pub(super) fn load_yaml(&mut self, name: &str) -> Evaluated {
        let path = self.beside(name);
        self.allowed(&path)?;
        if !path.is_file() {
            return Err(format!("No such file or directory: {}", path.display()));
        }
        let text = self.content_of(&path, yaml11::MAX_BYTES)?;
        self.charge(text.len() / 16)?;
        let mut number = |text: &str| {
            let value = evaluate(text, &mut Numbers)?;
            match value {
                Value::Str(text) => text.trim().parse().map_err(|_| format!("{text:?} is not a number")),
                value => value.as_float().ok_or_else(|| format!("{text:?} is not a number")),
            }
        };
        yaml11::load(&text, &mut number).map_err(|what| format!("{}: {what}", path.display()))
    }
}

/// Expressions of units in YAML see built-in names only.
struct Numbers;

impl super::evaluate::Host for Numbers {
    fn name(&mut self, name: &str) -> Evaluated<Option<Value>> {
        Ok(super::functions::global(name))
    }

    fn member(&mut self, _: usize, _: &str) -> Evaluated<Option<Value>> {
        Ok(None)
    }

    fn call(&mut self, function: &str, _: &[Value]) -> Option<Evaluated> {
        (function == "load_yaml").then(|| Err("load_yaml cannot be used here".to_owned()))
    }

    fn charge(&mut self, _: usize) -> Evaluated<()> {
        Ok(())
    }
}

/// Returns the files that match a name: with `*` and `?` in its last part all matches, sorted; otherwise the name
/// itself.
fn matching(path: &Path) -> Vec<PathBuf> {
    let pattern = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    if !pattern.contains(['*', '?']) {
        return vec![path.to_owned()];
    }
    let entries = path.parent().and_then(|folder| fs::read_dir(folder).ok()).into_iter().flatten().flatten();
    let names = entries.filter(|e| fits(&pattern, &e.file_name().to_string_lossy()));
    let mut found: Vec<PathBuf> = names.map(|e| e.path()).collect();
    found.sort();
    found
}

/// Returns whether a name matches a pattern with `*` and `?`.
fn fits(pattern: &str, name: &str) -> bool {
    let (pattern, name): (Vec<char>, Vec<char>) = (pattern.chars().collect(), name.chars().collect());
    let (mut p, mut n) = (0, 0);
    // Position of the last star, and of the character tried with it.
    let mut star: Option<(usize, usize)> = None;
    while n < name.len() {
        match pattern.get(p) {
            Some('*') => {
                star = Some((p, n));
                p += 1;
            }
            Some(c) if *c == '?' || name.get(n) == Some(c) => {
                p += 1;
                n += 1;
            }
            _ => match &mut star {
                Some((at, tried)) => {
                    *tried += 1;
                    (p, n) = (*at + 1, *tried);
                }
                None => return false,
            },
        }
    }
    pattern.get(p..).is_none_or(|rest| rest.iter().all(|c| *c == '*'))
}
