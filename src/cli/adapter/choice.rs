//! Which adapter, and what it is made from: the arguments that `adapter test` and `adapter emulate` share.

use serde_json::{Map, Value};

use super::super::exit::{Exit, Failure, Result};
use dimos_core::joint::MAX_DOF;
use dimos_hardware::adapter::AdapterError;
use dimos_hardware::check::ConfigError;
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, Registry};

/// Which arm, and how it is made.
#[derive(Debug, Clone, clap::Args)]
pub struct Choice {
    /// The adapter: a name that `dimos list-adapters` shows
    pub name: String,
    /// Number of joints; needed only where the adapter allows several
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=MAX_DOF as i64))]
    pub dof: Option<u8>,
    /// The same as --option model=MODEL
    #[arg(long)]
    pub model: Option<String>,
    /// An option of the adapter, as under `options` in a blueprint: speed_scale=0.5, sim.initial_positions=[…]
    /// (repeatable)
    #[arg(long = "option", value_name = "KEY=VALUE", value_parser = super::super::arguments::setting)]
    pub options: Vec<(String, String)>,
}

impl Choice {
    /// The adapter's row.
    pub fn row(&self, registry: &Registry) -> Result<AdapterSpec> {
        if let Some(row) = registry.get(&self.name) {
            return Ok(*row);
        }
        if let Some(absent) = registry.absent().find(|absent| absent.name == self.name) {
            return Err(Failure::usage(format!("{} is not in this build", absent.name)).hint(absent.remedy));
        }
        let close = |name: &&&str| strsim::damerau_levenshtein(name, &self.name) <= 2;
        let names = registry.names();
        let failure = Failure::usage(format!("no adapter named {:?}; there are {}", self.name, names.join(", ")));
        Err(names.iter().find(close).map_or(failure.clone(), |name| failure.hint(format!("did you mean {name}?"))))
    }

    /// What the adapter is made from: with the joints that were asked for, else with the most that fit the options.
    pub fn config(&self, row: &AdapterSpec, address: &str) -> Result<AdapterConfig> {
        let (least, most) = row.dof;
        let dofs = match self.dof.map(usize::from) {
            Some(dof) if (least..=most).contains(&dof) => dof..=dof,
            Some(dof) => return Err(Failure::usage(format!("{} has {}, not {dof}", row.name, joints(row)))),
            None => least..=most,
        };
        let mut refusal = None;
        for dof in dofs.rev() {
            let config = self.with_dof(address, dof)?;
            match (row.check)(&config) {
                Ok(_) => return Ok(config),
                // With another number of joints it may be the model that was asked for.
                Err(error) => refusal = refusal.or(Some(error)),
            }
        }
        let refusal = refusal.unwrap_or_else(|| ConfigError::new("", format!("{} has no joints", row.name)));
        Err(Failure { hint: refusal.hint, ..Failure::usage(refusal.what) })
    }

    /// Returns the options that were asked for: an object.
    pub fn options(&self) -> Result<Value> {
        let mut options = Map::new();
        let model = self.model.iter().map(|model| ("model", model.as_str()));
        for (path, text) in self.options.iter().map(|(path, text)| (path.as_str(), text.as_str())).chain(model) {
            let value = serde_yaml::from_str(text).map_err(|e| Failure::usage(format!("--option {path}: {e}")))?;
            set(&mut options, path, value).map_err(Failure::usage)?;
        }
        Ok(Value::Object(options))
    }

    fn with_dof(&self, address: &str, dof: usize) -> Result<AdapterConfig> {
        let (hardware_id, address) = (self.name.clone(), address.to_owned());
        Ok(AdapterConfig { hardware_id, address, dof, options: self.options()? })
    }
}

/// Sets an option at a path with dots.
fn set(options: &mut Map<String, Value>, path: &str, value: Value) -> std::result::Result<(), String> {
    match path.split_once('.') {
        None => drop(options.insert(path.to_owned(), value)),
        Some((first, rest)) => {
            let inner = options.entry(first).or_insert_with(|| Value::Object(Map::new()));
            let inner = inner.as_object_mut().ok_or(format!("--option {path}: {first} is set to something else"))?;
            set(inner, rest, value)?;
        }
    }
    Ok(())
}

/// `6 joints`, `1 to 16 joints`.
pub fn joints(row: &AdapterSpec) -> String {
    match row.dof {
        (1, 1) => "1 joint".to_owned(),
        (least, most) if least == most => format!("{least} joints"),
        (least, most) => format!("{least} to {most} joints"),
    }
}

/// Why an emulator does not start: what was asked for cannot be, or the computer does not give what it needs.
pub fn not_started(error: AdapterError) -> Failure {
    let exit = if matches!(error, AdapterError::Rejected(_)) { Exit::Usage } else { Exit::Hardware };
    Failure::of(exit, error)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_hardware::registry::Absent;
    use serde_json::json;

    #[test]
    fn what_this_build_lacks_is_told_also_where_a_program_of_its_own_lacks_it() {
        let servobot = Absent { name: "servobot", about: "an arm", remedy: "build with --features servobot" };
        let registry = dimos_arms::registry().lacking(&[servobot]);
        let choice = Choice { name: "servobot".into(), dof: None, model: None, options: Vec::new() };
        let failure = choice.row(&registry).unwrap_err();
        assert_eq!(failure.hint.as_deref(), Some("build with --features servobot"));
    }

    #[test]
    fn options_nest_by_their_dots() {
        let mut options = Map::new();
        for (path, value) in [("a", json!(1)), ("b.c", json!("x")), ("b.d.e", json!([1, 2]))] {
            set(&mut options, path, value).unwrap();
        }
        assert_eq!(Value::Object(options.clone()), json!({"a": 1, "b": {"c": "x", "d": {"e": [1, 2]}}}));
        assert!(set(&mut options, "a.b", json!(1)).is_err());
    }
}
