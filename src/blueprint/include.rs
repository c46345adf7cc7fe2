//! Reads a blueprint's file and its includes into one tree.

use crate::blueprint::registry::{Found, SearchPath, Source};
use dimos_yaml::{Diag, Kind, Label, Located, MergeRules, Missing, NodeId, Tree, merge, quote, read};

/// Merge rules of blueprints.
pub(super) const RULES: MergeRules = MergeRules {
    by_id: &[("hardware", "hardware_id"), ("tasks", "name"), ("planner.robots", "name")],
    whole: &["joints", "joint_names", "base_pose"],
};

/// Maximum number of files per blueprint: nested includes multiply.
const MAX_FILES: usize = 50;

/// Identity of a file, to detect include cycles.
type Identity = (String, Source);

/// Reads files into a tree.
pub(super) struct Includer<'t> {
    pub(super) tree: &'t mut Tree,
    pub(super) search: &'t SearchPath,
    /// Stack of the files being read, the outermost first.
    open: Vec<Identity>,
    files: usize,
    /// Whether a file could not be read, so that names may be missing.
    pub(super) incomplete: bool,
}

impl<'t> Includer<'t> {
    pub(super) fn new(tree: &'t mut Tree, search: &'t SearchPath) -> Self {
        Self { tree, search, open: Vec::new(), files: 0, incomplete: false }
    }

    /// Reads a file and merges it over its includes. Returns `None` if nothing is usable; the reason has been reported.
    pub(super) fn read(&mut self, found: &Found) -> Option<NodeId> {
        self.files += 1;
        let source = self.tree.add_bytes(found.file(), &found.bytes)?;
        let before = self.tree.diags().len();
        let Some(root) = self.tree.parse(source) else {
            if self.tree.diags().len() == before {
                let diag = Diag::error("the blueprint is empty").at(Label::start_of(source));
                self.tree.report(diag.hint("`dimos list-blueprints` shows examples to copy"));
            }
            return None;
        };
        if !matches!(self.tree.node(root).map(|n| &n.kind), Some(Kind::Map(_))) {
            let diag = Diag::error("a blueprint is a group of keys: `hardware: …`, `tasks: …`");
            let diag = diag.at(self.tree.label(root));
            self.tree.report(diag.hint("`dimos list-blueprints` shows examples to copy"));
            return None;
        }
        self.open.push(identity(found));
        let merged = self.merge_includes(found, root);
        self.open.pop();
        Some(merged)
    }

    fn merge_includes(&mut self, found: &Found, root: NodeId) -> NodeId {
        let Some(node) = self.tree.get(root, "include") else { return root };
        let (names, lost) = read::<Vec<Located<String>>>(self.tree, node, Missing::Report);
        self.incomplete |= lost.contains(node);
        let mut base: Option<NodeId> = None;
        for name in names.unwrap_or_default() {
            let Some(next) = self.include(found, &name) else {
                self.incomplete = true;
                continue;
            };
            // These describe the file that contains them.
            for key in ["name", "description", "include"] {
                self.tree.remove(next, key);
            }
            base = Some(match base {
                Some(base) => merge(self.tree, base, next, &RULES),
                None => next,
            });
        }
        match base {
            Some(base) => merge(self.tree, base, root, &RULES),
            None => root,
        }
    }

    fn include(&mut self, from: &Found, name: &Located<String>) -> Option<NodeId> {
        let at = self.tree.label(name.at);
        let next = match self.search.find_include(from, name) {
            Ok(next) => next,
            Err(error) => {
                self.tree.report(Diag::error(error.message).at(at).hint(error.hint));
                return None;
            }
        };
        let id = identity(&next);
        if let Some(start) = self.open.iter().position(|open| *open == id) {
            let chain: Vec<&str> = self.open.iter().skip(start).map(|(file, _)| file.as_str()).collect();
            let diag = Diag::error(format!("{} includes itself", quote(name))).at(at);
            let diag = diag.note(format!("{} → {}", chain.join(" → "), id.0));
            self.tree.report(diag.hint("remove one of these includes"));
            return None;
        }
        if self.files >= MAX_FILES {
            let diag = Diag::error(format!("more than {MAX_FILES} files are included")).at(at);
            self.tree.report(diag.hint("include each file once"));
            return None;
        }
        self.read(&next)
    }
}

fn identity(found: &Found) -> Identity {
    let source = match &found.source {
        Source::Path(path) => Source::Path(path.canonicalize().unwrap_or_else(|_| path.clone())),
        Source::Embedded => Source::Embedded,
    };
    (found.file(), source)
}
