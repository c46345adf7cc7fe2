//! The text of a new blueprint.

use std::fmt::Write;
use std::net::Ipv4Addr;
use std::path::Path;

use serde_json::{Map, Value};

use super::choice::{Cell, Robot};
use super::shipped::Known;
use crate::offline::GripperJoint;
use dimos_hardware::registry::SIM;

/// The arm's name in the blueprint.
pub const ARM: &str = "arm";
/// Size of the table [m], and its gap below the base of an arm that is mounted on it.
const TABLE: [f64; 3] = [1.2, 1.2, 0.02];
const GAP: f64 = 0.01;

/// Returns the next commands, and what each is for.
pub fn next(path: &Path, known: &Known) -> [(String, &'static str); 5] {
    let file = path.display();
    let pose = match known.home {
        Some(_) => (format!("dimos move {ARM} --named home"), "planned around what is in its world"),
        None => ("dimos pose save home".to_owned(), "where the arm is, for `dimos move arm --named home`"),
    };
    [
        (format!("dimos check {file}"), "joints, limits, mistakes with their lines"),
        (format!("dimos run {file} --sim"), "with the emulator, whatever the address is"),
        (format!("dimos arm enable {ARM}"), "in a second terminal: motors on; moves nothing"),
        pose,
        (format!("dimos run {file}"), "with the arm itself: read docs/safety.md before"),
    ]
}

/// Returns a line for each command.
pub fn in_columns(next: &[(String, &'static str)]) -> impl Iterator<Item = String> {
    let width = next.iter().map(|(command, _)| command.len()).max().unwrap_or(0);
    next.iter().map(move |(command, why)| format!("  {command:width$}  # {why}"))
}

/// Returns the text of a blueprint at `path`.
pub fn of(cell: &Cell, path: &Path, known: &Known) -> String {
    let row = &cell.row;
    let next: String = in_columns(&next(path, known)).map(|line| format!("# {line}\n")).collect();
    let joints = joints(cell);
    let holds = if row.holds_when_disabled { "its brakes hold it" } else { "it FALLS unless supported" };
    let mut text = format!(
        "# {about}. Written by `dimos new`; to look at next:
#
{next}#
# Every key is in docs/blueprint-reference.md. Angles are in rad, lengths in m, times in s.
description: {about}

coordinator:
  tick_rate: 100.0 # how often the arm is commanded [Hz]; it reports at {rate} Hz

hardware:
  - hardware_id: {ARM} # its name in every command: `dimos move {ARM} …`
    joints: {joints}
    adapter_type: {adapter}
",
        about = format_args!("{}, {} joints", model_name(cell), cell.joints),
        rate = row.native_rate,
        adapter = row.name,
    );
    let mut add = |line: std::fmt::Arguments<'_>| {
        // A String takes everything.
        let _ = text.write_fmt(line);
    };
    if !cell.address.is_empty() {
        let form =
            if cell.address == SIM { format!(" # the emulator; the arm: {}", row.address.form) } else { String::new() };
        add(format_args!("    address: {}{form}\n", scalar(&cell.address)));
    }
    add(format_args!(
        "    auto_enable: false # `dimos arm enable {ARM}` switches the motors on; true: the start does\n"
    ));
    let exit = if row.holds_when_disabled { "disable" } else { "hold" };
    add(format_args!("    on_exit: {exit} # without its motors {holds}\n"));
    if !cell.options.is_empty() {
        add(format_args!("    options: {} # `dimos list-adapters` shows the others\n", flow(&cell.options)));
    }
    add(format_args!("    # limits: {{velocity: 0.5}} # narrower than the arm's own [rad/s], for its first days\n"));
    add(format_args!(
        "
tasks:
  - name: traj_{ARM}
    type: trajectory # `dimos move`, `dimos do` and the planner use it
    joint_names: {{hardware: {ARM}}}
    priority: 10
"
    ));
    if let Some(robot) = &cell.robot {
        add(format_args!(
            "
  # Moves the end effector from keys: `dimos jog {ARM}`. It claims nothing until its first target.
  - name: twist_{ARM}
    type: eef_twist
    joint_names: {{hardware: {ARM}}}
    priority: 20
"
        ));
        text += &planner(robot, cell.table, known);
    }
    text
}

/// Returns the names of the arm's joints: those of the model behind the arm's, or numbered.
fn joints(cell: &Cell) -> String {
    let count = cell.joints;
    let numbered: Vec<String> = (1..=count).map(|number| format!("joint{number}")).collect();
    match cell.robot.as_ref().filter(|robot| robot.joints != numbered) {
        Some(robot) => {
            let names: Vec<String> = robot.joints.iter().map(|name| scalar(&format!("{ARM}_{name}"))).collect();
            format!("[{}] # base first", names.join(", "))
        }
        None => format!("{{prefix: {ARM}, count: {count}}} # {ARM}_joint1 … {ARM}_joint{count}, base first"),
    }
}

fn planner(robot: &Robot, table: Option<f64>, known: &Known) -> String {
    let names: Vec<String> = robot.joints.iter().map(|name| scalar(name)).collect();
    let mut text = format!(
        "
planner:
  robots:
    - name: {ARM} # as in `dimos plan {ARM} …`
      model_path: {}
      base_link: {} # the link that stays where the arm is mounted
      end_effector_link: {} # its pose, or that of the tool on it, is the arm's
",
        scalar(&robot.path),
        scalar(&robot.base),
        scalar(&robot.end),
    );
    if let Some(flange) = &robot.flange {
        text += &format!("      flange_link: {} # compared with the flange of the controller\n", scalar(flange));
    }
    if let Some([x, y, z]) = robot.tool {
        text += &format!("      tool: {{xyz: [{x}, {y}, {z}]}} # tool centre point in the frame of that link\n");
    }
    text += &format!(
        "      joint_names: [{}]
      joint_prefix: {ARM}_ # the coordinator's {ARM}_{} is the model's {}
      coordinator_task_name: traj_{ARM}
",
        names.join(", "),
        robot.joints.first().map_or("", |name| name),
        names.first().map_or("", |name| name),
    );
    if let Some(GripperJoint { joint, closed, open }) = &robot.gripper_joint {
        let joint = scalar(joint);
        text += &format!(
            "      gripper_joint: {{joint: {joint}, closed: {closed}, open: {open}}} # planned for where it is\n"
        );
    }
    if !known.exclusions.is_empty() {
        let pairs = known.exclusions.iter().map(|[a, b]| format!("[{}, {}]", scalar(a), scalar(b)));
        text += &format!(
            "      # The shapes of these links are fuller than the arm: they are not checked against each other.
      collision_exclusion_pairs: [{}]\n",
            pairs.collect::<Vec<_>>().join(", ")
        );
    }
    if let Some(home) = &known.home {
        text += &format!("      named_poses: {{home: {home:?}}}\n");
    }
    text += "
  # What the arm keeps clear of, by name. Every shape's pose is that of its middle, in the frame `map`.
";
    let [x, y, thickness] = TABLE;
    match table {
        Some(height) => {
            // An arm that is mounted on the table touches it.
            let top = if height.abs() < GAP { height - GAP } else { height };
            let middle = (1e4 * (top - thickness / 2.0)).round() / 1e4;
            let pose = format!("{{xyz: [0, 0, {middle}]}}");
            text += &format!("  world:\n    table: {{shape: {{box: [{x}, {y}, {thickness}]}}, pose: {pose}}}\n");
        }
        None => {
            text += &format!(
                "  world: {{}} # table: {{shape: {{box: [{x}, {y}, {thickness}]}}, pose: {{xyz: [0, 0, -0.02]}}}}\n"
            );
        }
    }
    text
}

fn model_name(cell: &Cell) -> &str {
    cell.options.get("model").and_then(Value::as_str).unwrap_or(cell.row.name)
}

/// Returns options as a flow mapping.
fn flow(options: &Map<String, Value>) -> String {
    let entry = |(key, value): (&String, &Value)| {
        let value = value.as_str().map_or_else(|| value.to_string(), scalar);
        format!("{key}: {value}")
    };
    format!("{{{}}}", options.iter().map(entry).collect::<Vec<_>>().join(", "))
}

/// Returns a text as YAML reads it: plain where no reader takes it for something else, otherwise quoted.
fn scalar(text: &str) -> String {
    let is_word = text.starts_with(|c: char| c.is_ascii_alphabetic() || c == '/')
        && text.chars().all(|c| c.is_ascii_alphanumeric() || "_-./@:".contains(c))
        && !text.ends_with(':')
        && !["true", "false", "null", "yes", "no", "on", "off", "y", "n"].contains(&text.to_lowercase().as_str());
    let is_plain = is_word || text.parse::<Ipv4Addr>().is_ok();
    if is_plain { text.to_owned() } else { Value::from(text).to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_text_is_read_as_it_is() {
        let texts = [
            "can0",
            "192.168.1.185",
            "192.168.1.185:502",
            "[::1]:7",
            "/dev/ttyACM0@1000000",
            "unix:/run/a b",
            "no",
            "1e3",
            "a,b",
        ];
        for text in texts {
            let line = format!("[{}]", scalar(text));
            let read: Vec<String> = serde_yaml::from_str(&line).unwrap_or_else(|e| panic!("{line}: {e}"));
            assert_eq!(read, [text], "{line}");
        }
    }
}
