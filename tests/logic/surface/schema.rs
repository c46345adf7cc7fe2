//! A JSON Schema as lines: one per key, with its path, kind and default. Descriptions are left out: words may change.

use serde_json::Value;

/// One line per key below `node`, each beginning with `at`.
pub fn lines(root: &Value, node: &Value, at: &str) -> Vec<String> {
    let mut out = Flat { root, lines: Vec::new(), open: Vec::new() };
    out.node(node, at, at);
    out.lines
}

struct Flat<'s> {
    root: &'s Value,
    lines: Vec<String>,
    /// Definitions that are being written: a type may hold itself.
    open: Vec<String>,
}

impl Flat<'_> {
    fn push(&mut self, line: String) {
        if !self.lines.contains(&line) {
            self.lines.push(line);
        }
    }

    /// The keys of a node at the path `at`; `indent` is the part before the path.
    fn node(&mut self, node: &Value, at: &str, indent: &str) {
        if let Some(name) = node.get("$ref").and_then(Value::as_str)
            && !self.open.iter().any(|open| open == name)
        {
            self.open.push(name.to_owned());
            if let Some(target) = self.root.pointer(name.trim_start_matches('#')) {
                self.node(target, at, indent);
            }
            self.open.pop();
        }
        let required: Vec<&str> =
            node.get("required").and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_str).collect();
        let properties = node.get("properties").and_then(Value::as_object);
        let dot = if at == indent { "" } else { "." };
        for (key, value) in properties.into_iter().flatten() {
            let path = format!("{at}{dot}{key}");
            let kind = self.kind(value, 0);
            if !kind.is_empty() {
                let needed = if required.contains(&key.as_str()) { " (required)" } else { "" };
                let default = value.get("default").map(|d| format!(" = {d}")).unwrap_or_default();
                self.push(format!("{path}: {kind}{needed}{default}"));
            }
            self.node(value, &path, indent);
        }
        let elsewhere = required.iter().filter(|key| !properties.is_some_and(|p| p.contains_key(**key)));
        let elsewhere: Vec<&str> = elsewhere.copied().collect();
        if !elsewhere.is_empty() {
            self.push(format!("{at} requires {}", elsewhere.join(", ")));
        }
        for (key, suffix) in [("items", "[]"), ("additionalProperties", ".*")] {
            if let Some(inner) = node.get(key).filter(|inner| inner.is_object()) {
                self.node(inner, &format!("{at}{suffix}"), indent);
            }
        }
        for (index, inner) in node.get("prefixItems").and_then(Value::as_array).into_iter().flatten().enumerate() {
            self.node(inner, &format!("{at}[{index}]"), indent);
        }
        for key in ["anyOf", "oneOf", "allOf"] {
            for choice in node.get(key).and_then(Value::as_array).into_iter().flatten() {
                self.node(choice, at, indent);
            }
        }
        if let (Some(condition), Some(then)) = (node.get("if"), node.get("then")) {
            self.node(then, &format!("{at}{{{}}}", words(condition)), indent);
        }
    }

    /// What a value may be; empty where nothing is said.
    fn kind(&self, node: &Value, depth: u32) -> String {
        if depth > 8 {
            return "…".to_owned();
        }
        let inner = |node: &Value| self.kind(node, depth + 1);
        if let Some(name) = node.get("$ref").and_then(Value::as_str) {
            return self.root.pointer(name.trim_start_matches('#')).map(inner).unwrap_or_default();
        }
        if let Some(word) = node.get("const") {
            return word.to_string();
        }
        if let Some(words) = node.get("enum").and_then(Value::as_array) {
            return join(words.iter().map(Value::to_string));
        }
        if let Some(choices) = node.get("anyOf").or_else(|| node.get("oneOf")).and_then(Value::as_array) {
            return join(choices.iter().map(inner));
        }
        let names: Vec<&str> = match node.get("type") {
            Some(Value::String(name)) => vec![name],
            Some(Value::Array(names)) => names.iter().filter_map(Value::as_str).collect(),
            _ if node.get("properties").is_some() => vec!["object"],
            _ if node.as_object().is_some_and(|o| !o.contains_key("required") && !o.contains_key("items")) => {
                return "anything".to_owned();
            }
            _ => return String::new(),
        };
        join(names.into_iter().map(|name| match name {
            "array" => match (node.get("items"), node.get("prefixItems").and_then(Value::as_array)) {
                (_, Some(parts)) => format!("[{}]", parts.iter().map(inner).collect::<Vec<_>>().join(", ")),
                (Some(items), _) => format!("list of {}{}", inner(items), bounds(node, "minItems", "maxItems")),
                _ => name.to_owned(),
            },
            "object" => match node.get("additionalProperties") {
                Some(inner_node @ Value::Object(_)) => format!("group of {}", inner(inner_node)),
                _ => name.to_owned(),
            },
            "integer" | "number" => {
                let format = node.get("format").and_then(Value::as_str).unwrap_or(name);
                format!("{format}{}{}", bounds(node, "minimum", "maximum"), above(node))
            }
            _ => name.to_owned(),
        }))
    }
}

/// `type=xarm`, or the condition as it is.
fn words(condition: &Value) -> String {
    let properties = condition.get("properties").and_then(Value::as_object);
    let words = properties.into_iter().flatten().filter_map(|(key, value)| {
        let word = value.get("const")?.as_str()?;
        Some(format!("{key}={word}"))
    });
    let words: Vec<String> = words.collect();
    if words.is_empty() { condition.to_string() } else { words.join(",") }
}

fn join(kinds: impl Iterator<Item = String>) -> String {
    let mut all: Vec<String> = Vec::new();
    for kind in kinds.filter(|kind| !kind.is_empty()) {
        if !all.contains(&kind) {
            all.push(kind);
        }
    }
    all.join(" | ")
}

/// ` 0..1`, where a bound is stated.
fn bounds(node: &Value, low: &str, high: &str) -> String {
    let text = |key: &str| node.get(key).map(Value::to_string).unwrap_or_default();
    let (low, high) = (text(low), text(high));
    if low.is_empty() && high.is_empty() { low } else { format!(" {low}..{high}") }
}

fn above(node: &Value) -> String {
    node.get("exclusiveMinimum").map(|low| format!(" >{low}")).unwrap_or_default()
}
