//! Questions with their options: an option answers its question; on a terminal the others are asked, elsewhere all that
//! are missing are named at once.

use std::cell::RefCell;
use std::io::{self, IsTerminal, Write};

use crate::cli::ask;
use crate::cli::exit::{Failure, Result};
use crate::cli::follow::Signals;
use crate::cli::output;

/// Wrong answers to one question after which it is given up.
const MAX_WRONG: usize = 5;

/// Asks a person, if there is one.
pub struct Asker {
    /// Watched while a person is asked.
    person: Option<Signals>,
    /// Options without an answer, and their questions.
    missing: RefCell<Vec<(&'static str, String)>>,
}

/// A question.
pub struct Question<'q> {
    /// The option that answers it.
    pub option: &'static str,
    /// For a person, without question mark.
    pub text: String,
    /// The answer of an empty line; empty: there is none.
    pub default: &'q str,
}

impl Asker {
    /// Asks if stdin and stderr are a terminal.
    pub fn new() -> Self {
        let is_asked = io::stdin().is_terminal() && io::stderr().is_terminal();
        Self { person: is_asked.then(Signals::watch), missing: RefCell::default() }
    }

    /// Notes that an option is missing, if no person is asked.
    pub fn miss(&self, option: &'static str, text: impl Into<String>) {
        if self.person.is_none() {
            self.missing.borrow_mut().push((option, text.into()));
        }
    }

    /// Fails if options are missing.
    pub fn complete(&self) -> Result<()> {
        let missing = self.missing.borrow();
        let what = match missing.as_slice() {
            [] => return Ok(()),
            [(option, text)] => format!("{option} is missing: {text}"),
            several => {
                let line = |(option, text): &(&str, String)| format!("\n  {option:9}  {text}");
                format!("these options are missing:{}", several.iter().map(line).collect::<String>())
            }
        };
        let hint = "stdin is not a terminal, so that all answers must be options: `dimos new --help` shows them";
        Err(Failure::usage(what).hint(hint))
    }

    /// Prints what helps to answer, if a person is asked.
    pub fn explain(&self, lines: impl IntoIterator<Item = String>) {
        if self.person.is_some() {
            lines.into_iter().for_each(output::note);
        }
    }

    /// Returns the answer: of the option if it is given, otherwise of the person; `None`: the option is missing. The
    /// error of `read` is that of a wrong answer; a person gets it, and may answer again.
    pub fn ask<T>(
        &self,
        question: &Question<'_>,
        given: Option<&str>,
        read: impl Fn(&str) -> std::result::Result<T, Failure>,
    ) -> Result<Option<T>> {
        let option = question.option;
        if let Some(given) = given {
            return read(given).map(Some).map_err(|f| Failure { what: format!("{option}: {}", f.what), ..f });
        }
        let Some(signals) = &self.person else {
            self.miss(option, &question.text);
            return Ok(None);
        };
        let default = question.default;
        let prompt = if default.is_empty() { String::new() } else { format!(" [{default}]") };
        for _ in 0..MAX_WRONG {
            let _ = write!(io::stderr(), "{}{prompt}: ", question.text);
            let answer = ask::line(signals).ok_or_else(|| ask::interrupted(signals))?;
            match read(if answer.is_empty() { default } else { &answer }) {
                Ok(value) => return Ok(Some(value)),
                Err(failure) => output::failure(&failure),
            }
        }
        Err(Failure::usage(format!("{option}: {MAX_WRONG} wrong answers")).hint("`dimos new --help` shows the options"))
    }
}
