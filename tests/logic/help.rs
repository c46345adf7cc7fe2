//! Help texts on a terminal of 80 columns.

use clap::Command;

/// Calls `see` for each verb with its path.
fn each(command: &Command, path: &str, see: &mut dyn FnMut(&str, &Command)) {
    see(path, command);
    for verb in command.get_subcommands().filter(|verb| verb.get_name() != "help") {
        each(verb, &format!("{path} {}", verb.get_name()), see);
    }
}

fn program() -> Command {
    let mut program = dimos::cli::command().term_width(80);
    program.build();
    program
}

#[test]
fn every_help_fits_80_columns() {
    let mut wrong = Vec::new();
    each(&program(), "dimos", &mut |path, verb| {
        let text = verb.clone().term_width(80).render_long_help().to_string();
        let long = text.lines().filter(|line| line.chars().count() > 80);
        // A word that is longer than the room for it stays whole.
        wrong.extend(long.filter(|line| line.trim().contains(' ')).map(|line| format!("{path}: {line}")));
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Paragraphs are one line each, so that only the terminal wraps them.
#[test]
fn no_epilogue_is_wrapped_in_its_source() {
    let mut wrong = Vec::new();
    each(&program(), "dimos", &mut |path, verb| {
        let text = verb.get_after_long_help().or(verb.get_after_help()).map(ToString::to_string).unwrap_or_default();
        for (line, next) in text.lines().zip(text.lines().skip(1)) {
            let continues = next.starts_with(|c: char| c.is_lowercase() || c == '(') && !next.contains(":  ");
            if line.chars().count() > 60 && continues {
                wrong.push(format!("{path}: {line:?} continues with {next:?}"));
            }
        }
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Examples and tables are not wrapped, so they are this short as written.
#[test]
fn no_example_is_wider_than_80_columns() {
    let mut wrong = Vec::new();
    each(&program(), "dimos", &mut |path, verb| {
        let text = verb.get_after_long_help().or(verb.get_after_help()).map(ToString::to_string).unwrap_or_default();
        let long = text.lines().filter(|line| line.starts_with(' ') && line.chars().count() > 80);
        wrong.extend(long.map(|line| format!("{path}: {line}")));
    });
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn usage_lines_have_the_order_that_is_parsed() {
    for (line, usage) in
        [("dimos move", "dimos move ARM Q… [OPTIONS]"), ("dimos plan arm --rpy 0 0 0", "dimos plan ARM Q… [OPTIONS]")]
    {
        let error = dimos::cli::command().try_get_matches_from(line.split(' ')).unwrap_err();
        let text = error.to_string();
        assert!(text.contains(usage) && text.contains("--pose X Y Z [--rpy R P Y"), "{text}");
        let required = text.split("Usage:").next().unwrap();
        let goal = ["--rpy", "--frame", "--tolerance", "--blend"].iter().find(|option| required.contains(**option));
        assert!(goal.is_none() || line.contains(goal.unwrap()), "a goal is none of its settings: {text}");
    }
    let reads = |line: &str| dimos::cli::command().try_get_matches_from(line.split(' ')).is_ok();
    assert!(reads("dimos move arm 0.1 -0.2") && reads("dimos move arm --named home"));
    assert!(reads("dimos move arm --pose 0.3 0.1 0.4 --rpy 0 1.57 0") && reads("dimos move --goal left=named:home"));
}

#[test]
fn mistakes_in_goals_get_a_hint() {
    let refused = |line: &str| dimos::cli::command().try_get_matches_from(line.split(' ')).unwrap_err().to_string();
    assert!(refused("dimos move arm home").contains("--named home"));
    assert!(refused("dimos move arm 0.1,0.2").contains("separate the numbers by blanks: 0.1 0.2"));
    assert!(refused("dimos move arm --pose 0.3,x 0 0").contains("separate the numbers by blanks"));
    assert!(refused("dimos plan --goal arm=home").contains("arm=named:home"));
    assert!(refused("dimos move arm nan").contains("must be finite"));
}
