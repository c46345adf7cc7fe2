//! The lines that put an arm into the tables of a checkout: `src/hardware/arms/mod.rs`, the adapters, and
//! `src/robot/builtin.rs`, the robot descriptions.

/// The text of the table's file with a module and a row more; what is wrong with it where they have no place.
pub fn with_row(text: &str, module: &str) -> Result<String, String> {
    let declaration = format!("pub mod {module};");
    if text.lines().any(|line| line.trim() == declaration) {
        return Err(format!("it has `{declaration}` already"));
    }
    with_entry(&with_module(text, module, &declaration)?, module)
}

/// Modules are in alphabetical order, each after its attributes.
fn with_module(text: &str, module: &str, declaration: &str) -> Result<String, String> {
    let lines: Vec<&str> = text.lines().collect();
    let named = |line: &str| line.strip_prefix("pub mod ").and_then(|rest| rest.strip_suffix(';')).map(str::to_owned);
    let modules = || lines.iter().enumerate().filter_map(|(i, line)| named(line).map(|name| (i, name)));
    let last = modules().next_back().ok_or("it declares no modules")?.0;
    let at = modules().find(|(_, name)| name.as_str() > module).map_or(last + 1, |(i, _)| {
        let attributes =
            lines.iter().take(i).rev().take_while(|line| line.starts_with("#[") || line.starts_with("///"));
        i - attributes.count()
    });
    let mut out = lines;
    out.insert(at, declaration);
    Ok(out.join("\n") + "\n")
}

/// The row comes last.
fn with_entry(text: &str, module: &str) -> Result<String, String> {
    let missing = "it has no `pub const TABLE: &[AdapterSpec] = &[ … ];`";
    let start = text.find("pub const TABLE").ok_or(missing)?;
    let end = start + text.get(start..).and_then(|rest| rest.find("];")).ok_or(missing)?;
    let (before, after) = text.split_at(end);
    let rows = before.trim_end();
    let entry = match rows.ends_with(',') {
        true => format!("{rows}\n    {module}::SPEC,\n"),
        false if rows.ends_with('[') => format!("{rows}{module}::SPEC"),
        false => format!("{rows}, {module}::SPEC"),
    };
    Ok(entry + after)
}

/// The text of the file of robot descriptions with a name more; what is wrong with it where that has no place.
pub fn with_robot(text: &str, name: &str) -> Result<String, String> {
    let missing = "it has no `robots!( … );` with a name on each line";
    let start = text.find("\nrobots!(\n").ok_or(missing)? + "\nrobots!(\n".len();
    let (before, rest) = text.split_at(start);
    let (list, after) = rest.split_once("\n);").ok_or(missing)?;
    let mut names: Vec<&str> = list.lines().map(|line| line.trim().trim_end_matches(',')).collect();
    let own = format!("{name:?}");
    if names.contains(&own.as_str()) {
        return Err(format!("it has {own} already"));
    }
    // Names are in alphabetical order.
    let at = names.iter().position(|other| *other > own.as_str()).unwrap_or(names.len());
    names.insert(at, &own);
    let list: Vec<String> = names.iter().map(|name| format!("    {name}")).collect();
    Ok(format!("{before}{}\n);{after}", list.join(",\n")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_robots_of_this_checkout_take_a_name() {
        let text = include_str!("../../../robot/builtin.rs");
        for (name, place) in [
            ("acme", "robots!(\n    \"acme\",\n    \"lite6\","),
            ("penny", "    \"lite6_gripper\",\n    \"penny\",\n    \"piper\","),
            ("zorro", "    \"yourarm_gripper\",\n    \"zorro\"\n);"),
        ] {
            let with = with_robot(text, name).unwrap();
            assert!(with.contains(place), "{with}");
            assert_eq!(with.len(), text.len() + name.len() + "    \"\",\n".len());
            assert!(with_robot(&with, name).unwrap_err().contains("already"));
        }
        assert!(with_robot("robots!(\"a\");", "b").is_err());
    }

    #[test]
    fn the_table_of_this_checkout_takes_a_row() {
        let text = include_str!("../../../hardware/arms/mod.rs");
        let with = with_row(text, "acme").unwrap();
        assert!(with.lines().any(|line| line == "pub mod acme;"));
        assert_eq!(with.matches("acme::SPEC").count(), 1);
        let without: String = with.replace("pub mod acme;\n", "");
        let squeezed = |text: &str| text.split_whitespace().collect::<String>();
        assert_eq!(squeezed(&without).replace(",acme::SPEC", "").replace("acme::SPEC,", ""), squeezed(text));
        assert!(with_row(&with, "acme").unwrap_err().contains("already"));
    }

    #[test]
    fn modules_keep_their_order_and_their_attributes() {
        let text = "pub mod mock;\n#[cfg(feature = \"can\")]\npub mod piper;\n\npub const TABLE: &[AdapterSpec] = &[mock::SPEC];\n";
        let with = with_row(text, "otto").unwrap();
        assert!(
            with.starts_with("pub mod mock;\npub mod otto;\n#[cfg(feature = \"can\")]\npub mod piper;\n"),
            "{with}"
        );
        assert!(with.contains("&[mock::SPEC, otto::SPEC];"), "{with}");
        assert!(with_row(text, "zorro").unwrap().contains("pub mod piper;\npub mod zorro;\n"));
    }

    #[test]
    fn rows_on_lines_of_their_own_stay_so() {
        let text =
            "pub mod mock;\npub const TABLE: &[AdapterSpec] = &[\n    mock::SPEC,\n    #[cfg(x)]\n    b::SPEC,\n];\n";
        assert!(with_row(text, "acme").unwrap().ends_with("    b::SPEC,\n    acme::SPEC,\n];\n"));
        assert!(with_row("pub mod mock;\n", "acme").unwrap_err().contains("TABLE"));
        assert!(with_row("", "acme").is_err());
    }
}
