//! Merges one tree over another, for includes: groups key by key, named lists by id, everything else replaced. And
//! YAML's own merge keys, for files of other programs; a blueprint has none.

use crate::diag::Diag;
use crate::tree::{Kind, NodeId, Tree};

/// Merge rules. Paths are keys joined by dots.
#[derive(Debug, Clone, Copy)]
pub struct MergeRules {
    /// Lists whose entries are matched by a key: path and key.
    pub by_id: &'static [(&'static str, &'static str)],
    /// Keys whose value is replaced as a whole, even if it is a group.
    pub whole: &'static [&'static str],
}

impl MergeRules {
    /// Returns the key that identifies the entries of a list.
    pub fn id_key(&self, path: &str) -> Option<&'static str> {
        self.by_id.iter().find(|(p, _)| *p == path).map(|(_, key)| *key)
    }
}

/// Merges `over` into `base` and returns the result's node. Both must come from separate reads.
pub fn merge(tree: &mut Tree, base: NodeId, over: NodeId, rules: &MergeRules) -> NodeId {
    merge_at(tree, base, over, rules, "")
}

fn merge_at(tree: &mut Tree, base: NodeId, over: NodeId, rules: &MergeRules, path: &str) -> NodeId {
    let kinds = (tree.node(base).map(|n| n.kind.clone()), tree.node(over).map(|n| n.kind.clone()));
    let merged = match kinds {
        (Some(Kind::Map(mut entries)), Some(Kind::Map(more))) => {
            for (key, value) in more {
                let name = tree.text(key).unwrap_or_default().to_owned();
                let inner = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
                let found = entries.iter().position(|(k, _)| tree.text(*k) == Some(name.as_str()));
                match found.and_then(|at| entries.get_mut(at)) {
                    Some(entry) if rules.whole.contains(&name.as_str()) => *entry = (key, value),
                    Some(entry) => *entry = (key, merge_at(tree, entry.1, value, rules, &inner)),
                    None => entries.push((key, value)),
                }
            }
            Kind::Map(entries)
        }
        (Some(Kind::Seq(mut items)), Some(Kind::Seq(more))) if rules.id_key(path).is_some() => {
            let id_key = rules.id_key(path).unwrap_or_default();
            let id_of = |tree: &Tree, item| tree.get(item, id_key).and_then(|id| tree.text(id).map(str::to_owned));
            // An id that one file uses twice is merged once, so that the second is still reported as a duplicate.
            let mut open: Vec<usize> = (0..items.len()).collect();
            for item in more {
                let id = id_of(tree, item);
                let found = id.and_then(|id| {
                    let same = |at: &usize| items.get(*at).and_then(|i| id_of(tree, *i)).is_some_and(|i| i == id);
                    open.iter().position(same)
                });
                match found.map(|at| open.remove(at)).and_then(|at| items.get_mut(at)) {
                    Some(slot) => *slot = merge_at(tree, *slot, item, rules, &format!("{path}[]")),
                    None => items.push(item),
                }
            }
            Kind::Seq(items)
        }
        _ => return over,
    };
    if tree.damaged.contains(&base) {
        tree.damaged.insert(over);
    }
    // The result has the position of the later text.
    tree.set_kind(over, merged);
    over
}

impl Tree {
    /// Returns the entries of a group with those of its merge key (`<<`: a group or a list of groups) as YAML 1.1
    /// defines it: own keys win, then those of the earlier group. Reports a merge key with another value.
    pub fn flattened(&mut self, map: NodeId) -> Vec<(NodeId, NodeId)> {
        let is_merge = |tree: &Self, key| {
            let kind = tree.node(key).map(|node| &node.kind);
            matches!(kind, Some(Kind::Scalar { text, plain: true }) if text == "<<")
        };
        let all = self.entries(map).to_vec();
        let (merges, mut entries): (Vec<_>, Vec<_>) = all.into_iter().partition(|(key, _)| is_merge(self, *key));
        for (_, value) in merges {
            let groups = match self.node(value).map(|n| &n.kind) {
                Some(Kind::Seq(groups)) => groups.clone(),
                _ => vec![value],
            };
            for group in groups {
                if !matches!(self.node(group).map(|n| &n.kind), Some(Kind::Map(_))) {
                    let diag = Diag::error("`<<` takes a group or a list of groups").at(self.label(group));
                    self.report(diag);
                }
                for (key, value) in self.flattened(group) {
                    if !entries.iter().any(|(known, _)| self.text(*known) == self.text(key)) {
                        entries.push((key, value));
                    }
                }
            }
        }
        entries
    }
}
