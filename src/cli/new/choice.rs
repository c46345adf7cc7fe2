//! What the answers choose: an arm of the table, and what a blueprint needs to know of it.

use std::path::{Path, PathBuf};

use schemars::SchemaGenerator;
use serde_json::{Map, Value, json};

use super::answers::{Asker, Question};
use super::{Args, shipped};
use crate::blueprint::Catalog;
use crate::cli::adapter::choice::joints as joints_of_row;
use crate::cli::arguments::length;
use crate::cli::exit::{Failure, Result};
use crate::cli::model::chain::end_of_arm;
use crate::cli::model::robot as checked_robot;
use crate::offline::GripperJoint;
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, Registry, SIM};
use dimos_robot::builtin;
use dimos_robot::{self as robot, Source};
use dimos_yaml::did_you_mean;

/// The answer for what there is not.
const NONE: &str = "none";

/// The cell to write.
pub struct Cell {
    /// The arm's row of the table.
    pub row: AdapterSpec,
    /// Its address; empty: it needs none.
    pub address: String,
    /// The adapter's own options.
    pub options: Map<String, Value>,
    /// Number of joints.
    pub joints: usize,
    /// The model that motions are planned with.
    pub robot: Option<Robot>,
    /// Height of the table above the base [m].
    pub table: Option<f64>,
}

/// A model, as the planner uses it.
pub struct Robot {
    /// Its path in the blueprint.
    pub path: String,
    /// The link at its root.
    pub base: String,
    /// The link at the end of the arm.
    pub end: String,
    /// The link of the flange, where the adapter knows its name.
    pub flange: Option<String>,
    /// The joints between root and end.
    pub joints: Vec<String>,
    /// All links.
    pub links: Vec<String>,
    /// The joint of the model that the gripper drives, where a built-in blueprint names it.
    pub gripper_joint: Option<GripperJoint>,
    /// The tool centre point in the frame of the end [m].
    pub tool: Option<[f64; 3]>,
}

impl Cell {
    /// Asks what the options do not answer. `path`: where the blueprint is to be.
    pub fn ask(args: &Args, path: &Path, asker: &Asker, catalog: Catalog<'_>) -> Result<Self> {
        let registry = catalog.adapters;
        if args.arm.is_none() {
            asker.explain(arms(registry));
        }
        let question = Question { option: "--arm", text: "Which arm".into(), default: "" };
        let Some((row, model)) = asker.ask(&question, args.arm.as_deref(), |text| arm(registry, text))? else {
            return Err(nothing_without_an_arm(args, asker));
        };
        let address = address(args, asker, &row)?;
        let mut options = Map::new();
        model.iter().for_each(|model| drop(options.insert("model".into(), json!(model))));
        let gripper = gripper(args, asker, &row)?;
        gripper.iter().for_each(|gripper| drop(options.insert("gripper".into(), gripper.clone())));

        let stem = model.as_deref().unwrap_or(row.name);
        let has_gripper = gripper.is_some_and(|gripper| gripper != json!(NONE) && gripper != json!(false));
        let fitting = fitting(&row, &options)?;
        let read = |text: &str| planned(text, path, catalog);
        let default = default_model(stem, has_gripper);
        let fits = read(&default)?.is_none_or(|robot| fitting.contains(&robot.joints.len()));
        let default = if fits { default } else { NONE.to_owned() };
        let text = "Model to plan with: builtin:NAME, a .urdf or .xacro file, or none".to_owned();
        let question = Question { option: "--model", text, default: &default };
        let robot = asker.ask(&question, args.model.as_deref(), read)?;
        // What the default model would be asked is missing, too.
        let mut robot = robot.map_or_else(|| read(&default), Ok)?;
        let joints = joints(args, asker, &row, robot.as_ref(), &fitting)?;
        let mut table = None;
        if let Some(robot) = &mut robot {
            robot.flange = flange(&row, &options, joints, robot);
            let given = Some(args.tool.join(" ")).filter(|tool| !tool.is_empty());
            let text = format!("Tool centre point from {}: x y z [m], or none", robot.end);
            let question = Question { option: "--tool", text, default: NONE };
            robot.tool = asker.ask(&question, given.as_deref(), tool)?.flatten();
            let text = "Height of the table above the arm's base [m], or none".to_owned();
            let question = Question { option: "--table", text, default: NONE };
            table = asker.ask(&question, args.table.as_deref(), height)?.flatten();
        }
        asker.complete()?;
        if robot.is_none() && args.tool.iter().chain(&args.table).any(|text| text != NONE) {
            let what = "--tool and --table are for planning, which needs a model";
            return Err(Failure::usage(what).hint("give --model, or omit them"));
        }
        Ok(Self { row, address, options, joints, robot, table })
    }
}

/// Returns an error that names all that is missing where not even the arm is known.
fn nothing_without_an_arm(args: &Args, asker: &Asker) -> Failure {
    let is_planned = args.model.as_deref() != Some(NONE);
    for (option, text, is_missing) in [
        ("--address", "Its address, or sim; of an arm that has one", args.address.is_none()),
        ("--gripper", "Its gripper, or none; of an arm that has a choice", args.gripper.is_none()),
        ("--model", "Model to plan with, or none", args.model.is_none()),
        ("--tool", "Tool centre point, or none; with a model", args.tool.is_empty() && is_planned),
        ("--table", "Height of the table, or none; with a model", args.table.is_none() && is_planned),
    ] {
        if is_missing {
            asker.miss(option, text);
        }
    }
    let left_out = || Failure::usage("--arm is missing").hint("`dimos list-adapters` lists them");
    asker.complete().err().unwrap_or_else(left_out)
}

/// Returns the arms for a person: each adapter with its models.
fn arms(registry: &Registry) -> Vec<String> {
    let width = registry.names().iter().map(|name| name.len()).max().unwrap_or(0);
    let line = |row: &AdapterSpec| {
        let (models, _) = choices(row, "model");
        let models = if models.is_empty() { String::new() } else { format!(": {}", models.join(" ")) };
        format!("  {:width$}  {}{models}", row.name, row.about)
    };
    registry.rows().iter().map(line).collect()
}

/// Returns the row of an adapter or of one of its models, and the model.
fn arm(registry: &Registry, text: &str) -> Result<(AdapterSpec, Option<String>)> {
    let models = |row: &AdapterSpec| choices(row, "model").0;
    if let Some(row) = registry.rows().iter().find(|row| models(row).iter().any(|model| model == text)) {
        return Ok((*row, Some(text.to_owned())));
    }
    match registry.get(text) {
        Some(row) if models(row).is_empty() => Ok((*row, None)),
        Some(row) => Err(Failure::usage(format!("which {text}? {}", models(row).join(", "))).hint("name the model")),
        None => {
            let known: Vec<String> =
                registry.rows().iter().flat_map(|row| [vec![row.name.to_owned()], models(row)].concat()).collect();
            let hint = did_you_mean(text, known.iter().map(String::as_str), "there are");
            Err(Failure::usage(format!("no arm named {text:?}")).maybe_hint(hint))
        }
    }
}

fn address(args: &Args, asker: &Asker, row: &AdapterSpec) -> Result<String> {
    if !row.address.required && args.address.as_deref().is_none_or(|address| address == SIM) {
        return Ok(String::new());
    }
    let read = |text: &str| match text {
        SIM if row.emulate.is_some() => Ok(text.to_owned()),
        _ => {
            let wrong = |what| Failure::usage(what).hint(format!("its form: {}", row.address.form));
            (row.address.check)(text).map_err(wrong).map(|_| text.to_owned())
        }
    };
    let (form, sim) = (row.address.form, if row.emulate.is_some() { SIM } else { "" });
    let text = format!("Its address: {form}, or sim while you have none");
    let question = Question { option: "--address", text, default: sim };
    Ok(asker.ask(&question, args.address.as_deref(), read)?.unwrap_or_default())
}

/// Returns the option `gripper` of an adapter that has one.
fn gripper(args: &Args, asker: &Asker, row: &AdapterSpec) -> Result<Option<Value>> {
    let (known, default) = choices(row, "gripper");
    if known.is_empty() {
        return match args.gripper.as_deref() {
            None | Some(NONE) => Ok(None),
            Some(_) => Err(Failure::usage(format!("--gripper: {} has no choice of grippers", row.name))
                .hint("omit it: `dimos list-adapters` says whether the adapter drives one")),
        };
    }
    // A switch: whether it has the vendor's own.
    let is_switch = known.iter().any(|value| value == "true");
    let shown = if is_switch { vec!["yes".to_owned(), NONE.to_owned()] } else { known };
    let default = match default.as_str() {
        "true" => "yes",
        "false" => NONE,
        other => other,
    };
    let read = |text: &str| match shown.iter().any(|value| value == text) {
        true if is_switch => Ok(json!(text == "yes")),
        true => Ok(json!(text)),
        false => {
            let hint = did_you_mean(text, shown.iter().map(String::as_str), "there are");
            Err(Failure::usage(format!("{} knows no gripper {text:?}", row.name)).maybe_hint(hint))
        }
    };
    let text = format!("Its gripper: {}", shown.join(", "));
    asker.ask(&Question { option: "--gripper", text, default }, args.gripper.as_deref(), read)
}

/// Returns the values that an option of an adapter may have by its schema, and its default.
fn choices(row: &AdapterSpec, option: &str) -> (Vec<String>, String) {
    let mut generator = SchemaGenerator::default();
    let schema = (row.options.schema)(&mut generator);
    let property = schema.as_value().pointer(&format!("/properties/{option}")).cloned().unwrap_or_default();
    let mut values = Vec::new();
    collect(&property, generator.definitions(), &mut values);
    let default = property.get("default").map_or_else(String::new, text);
    (values, default)
}

fn text(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

fn collect(schema: &Value, definitions: &Map<String, Value>, values: &mut Vec<String>) {
    let list = |key: &str| schema.get(key).and_then(Value::as_array).into_iter().flatten();
    if let Some(name) = schema.get("$ref").and_then(Value::as_str).and_then(|path| path.rsplit('/').next()) {
        definitions.get(name).into_iter().for_each(|inner| collect(inner, definitions, values));
    }
    list("oneOf").chain(list("anyOf")).for_each(|inner| collect(inner, definitions, values));
    values.extend(list("enum").chain(schema.get("const")).map(text));
    if schema.get("type").is_some_and(|kind| kind == "boolean") {
        values.extend(["true", "false"].map(str::to_owned));
    }
}

fn default_model(stem: &str, gripper: bool) -> String {
    let with_gripper = gripper.then(|| format!("{stem}_gripper"));
    let names = with_gripper.into_iter().chain([stem.to_owned()]);
    let known = names.into_iter().find(|name| builtin::text(name).is_some());
    known.map_or_else(|| NONE.to_owned(), |name| format!("{}{name}", builtin::PREFIX))
}

/// Reads a model. Of a built-in one, a built-in blueprint may know which joint is no joint of the arm.
fn planned(text: &str, blueprint: &Path, catalog: Catalog<'_>) -> Result<Option<Robot>> {
    if text == NONE {
        return Ok(None);
    }
    let file = if builtin::text(text).is_some() { format!("{}{text}", builtin::PREFIX) } else { text.to_owned() };
    let or_hint = || Some("builtin:NAME, a .urdf or .xacro file, or none".to_owned());
    let (model, _) = checked_robot(robot::load(&Source::new(&file)), Path::new(&file))
        .map_err(|failure| Failure { hint: failure.hint.clone().or_else(or_hint), ..failure })?;
    let known = shipped::with_gripper_joint(&file, catalog);
    let end = known.as_ref().and_then(|known| model.link_index(&known.end_effector_link));
    let end = end.unwrap_or_else(|| end_of_arm(&model));
    let name = |link: usize| model.links.get(link).map(|link| link.name.clone()).unwrap_or_default();
    let between = model.independent_of(&model.path(0, end));
    let joints: Vec<String> = between.iter().filter_map(|joint| Some(model.joints.get(*joint)?.name.clone())).collect();
    if joints.is_empty() {
        return Err(Failure::usage(format!("{file} has no joint that moves")).hint("`dimos model tree FILE` shows it"));
    }
    // A path in a blueprint is relative to that file.
    let elsewhere = blueprint.parent().is_some_and(|folder| folder != Path::new(""));
    let path = match elsewhere && !file.starts_with(builtin::PREFIX) {
        true => std::path::absolute(&file).unwrap_or_else(|_| PathBuf::from(&file)).display().to_string(),
        false => file,
    };
    let links = model.links.iter().map(|link| link.name.clone()).collect();
    let gripper_joint = known.and_then(|known| known.gripper_joint);
    Ok(Some(Robot { path, base: name(0), end: name(end), flange: None, joints, links, gripper_joint, tool: None }))
}

fn config(row: &AdapterSpec, options: &Map<String, Value>, dof: usize) -> AdapterConfig {
    let options = Value::Object(options.clone());
    AdapterConfig { hardware_id: row.name.to_owned(), address: String::new(), dof, options }
}

/// Returns the numbers of joints that an arm may have with its options.
fn fitting(row: &AdapterSpec, options: &Map<String, Value>) -> Result<Vec<usize>> {
    let mut refusal = None;
    let mut fits = |dof: &usize| {
        let checked = (row.check)(&config(row, options, *dof));
        checked.map_err(|error| refusal = Some(error)).is_ok()
    };
    let fitting: Vec<usize> = (row.dof.0..=row.dof.1).filter(|dof| fits(dof)).collect();
    match refusal.filter(|_| fitting.is_empty()) {
        Some(error) => Err(Failure { hint: error.hint, ..Failure::usage(error.what) }),
        None => Ok(fitting),
    }
}

/// Returns the number of joints.
fn joints(args: &Args, asker: &Asker, row: &AdapterSpec, robot: Option<&Robot>, fitting: &[usize]) -> Result<usize> {
    let known = joints_of_row(row);
    let read = |text: &str| match text.parse::<usize>() {
        Ok(count) if fitting.contains(&count) => Ok(count),
        _ => Err(Failure::usage(format!("{} cannot have {text} joints", row.name)).hint(format!("it has {known}"))),
    };
    let of_model = robot.map(|robot| robot.joints.len().to_string());
    match (fitting, &of_model, &args.joints) {
        (_, Some(count), None) => {
            let hint = "give the model of this arm, or --model none";
            read(count).map_err(|f| Failure { what: format!("--model: {}, as its model has", f.what), ..f }.hint(hint))
        }
        ([only], None, None) => Ok(*only),
        (_, Some(count), Some(given)) if count != given => {
            Err(Failure::usage(format!("--joints: the model has {count} joints, not {given}")).hint("omit --joints"))
        }
        _ => {
            let question = Question { option: "--joints", text: format!("Number of joints: {known}"), default: "" };
            let least = fitting.first().copied().unwrap_or_default();
            Ok(asker.ask(&question, args.joints.as_deref(), read)?.unwrap_or(least))
        }
    }
}

/// Returns the flange of a model that is one of those that the adapter names.
fn flange(row: &AdapterSpec, options: &Map<String, Value>, joints: usize, planned: &Robot) -> Option<String> {
    let (name, flange) = (row.check)(&config(row, options, joints)).ok()?.tool.model?;
    let stem = planned.path.strip_prefix(builtin::PREFIX)?;
    stem.starts_with(name).then(|| flange.to_owned())
}

fn tool(text: &str) -> Result<Option<[f64; 3]>> {
    if text == NONE {
        return Ok(None);
    }
    let numbers: std::result::Result<Vec<f64>, String> = text.split_whitespace().map(length).collect();
    match numbers.map(<[f64; 3]>::try_from) {
        Ok(Ok(xyz)) => Ok(Some(xyz)),
        Ok(Err(_)) => Err(Failure::usage("expected three numbers").hint("x y z [m], as 0 0 0.12, or none")),
        Err(what) => Err(Failure::usage(what).hint("x y z [m], as 0 0 0.12, or none")),
    }
}

fn height(text: &str) -> Result<Option<f64>> {
    if text == NONE {
        return Ok(None);
    }
    length(text).map(Some).map_err(|what| Failure::usage(what).hint("a height [m], as 0 or -0.05, or none"))
}
