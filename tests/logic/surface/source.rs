//! Public names and signatures, read from source text.

use std::fs;
use std::path::Path;

/// The public classes, functions, constants and fields of a Python file, in its order. The form is that of our own
/// files: four spaces, one statement per line, brackets that may continue on the next.
pub fn python(text: &str) -> Vec<String> {
    let mut out = Vec::new();
    // Whether what is indented belongs to a public class.
    let (mut public_class, mut in_text) = (false, false);
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        if line.trim().is_empty() {
            continue;
        }
        let quotes = line.matches("\"\"\"").count();
        if in_text || quotes == 1 {
            in_text ^= quotes == 1;
            continue;
        }
        let mut statement = line.to_owned();
        while open_brackets(&statement) {
            let Some(next) = lines.next() else { break };
            statement = format!("{statement} {}", next.trim());
        }
        // As if it were on one line.
        let statement = statement.replace("( ", "(").replace(", )", ")").replace(" )", ")");
        let body = statement.trim_start();
        let indent = statement.len() - body.len();
        let name: String = body
            .trim_start_matches("async ")
            .trim_start_matches("def ")
            .trim_start_matches("class ")
            .chars()
            .take_while(|c| c.is_alphanumeric() || *c == '_')
            .collect();
        let dunder = name.starts_with("__") && name.ends_with("__");
        if name.is_empty() || (name.starts_with('_') && !dunder) {
            public_class &= indent > 0;
            continue;
        }
        let code = statement.split("  #").next().unwrap_or_default().trim_end();
        let definition = body.starts_with("def ") || body.starts_with("class ");
        let after = body.get(name.len()..).unwrap_or_default().trim_start();
        if indent == 0 {
            public_class = body.starts_with("class ");
        }
        if indent == 0 || (public_class && indent == 4) {
            if definition {
                out.push(head(code).to_owned());
            } else if !dunder && (after.starts_with(':') || (indent == 0 && after.starts_with('='))) {
                out.push(code.to_owned());
            }
        }
    }
    out
}

fn open_brackets(statement: &str) -> bool {
    let code = statement.split("  #").next().unwrap_or_default();
    let count = |all: &[char]| code.matches(all).count();
    let starts = ["def ", "class "].iter().any(|word| statement.trim_start().starts_with(word));
    starts && count(&['(', '[']) > count(&[')', ']'])
}

/// A definition up to its colon.
fn head(signature: &str) -> &str {
    let mut depth = 0;
    for (at, c) in signature.char_indices() {
        match c {
            '(' | '[' | '{' => depth += 1,
            ')' | ']' | '}' => depth -= 1,
            ':' if depth == 0 => return &signature[..at],
            _ => {}
        }
    }
    signature
}

/// The public traits in the files of a folder, each with its methods: name, then one line per method.
pub fn traits(folder: &Path) -> Vec<(String, Vec<String>)> {
    let mut out = Vec::new();
    for entry in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
        if entry.extension().is_none_or(|extension| extension != "rs") {
            continue;
        }
        let text = fs::read_to_string(&entry).unwrap();
        for part in text.split("\npub trait ").skip(1) {
            let (head, body) = part.split_once('{').unwrap();
            let name: String = head.chars().take_while(|c| c.is_alphanumeric()).collect();
            let body = body.split("\n}").next().unwrap();
            let mut lines = vec![format!("trait {}", head.trim())];
            // A method begins at the trait's own indent, so nothing inside a default body does.
            for method in format!("\n{body}\n").split("\n    fn ").skip(1) {
                // `;` also occurs in the type of an array.
                let end = [" {", ";\n"].iter().filter_map(|end| method.find(end)).min();
                let signature = &method[..end.unwrap_or(method.len())];
                lines.push(format!("  fn {}", signature.split_whitespace().collect::<Vec<_>>().join(" ")));
            }
            out.push((name, lines));
        }
    }
    out
}
