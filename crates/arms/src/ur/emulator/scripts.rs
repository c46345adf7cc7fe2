//! Text on the script's ports: programs, programs that run beside them, and single commands.

use super::controller::Controller;
use super::ours::{self, Ours};
use super::programs::{Program, RtdeControl};

impl Controller {
    /// Takes the line of a connection that has arrived. A program ends with a line `end` at its margin.
    pub(super) fn script_line(&mut self, who: (usize, u64), line: &str) {
        let Some(session) = self.sessions.get_mut(&who) else { return };
        let begins = line.starts_with("def ") || line.starts_with("sec ");
        if session.text.is_empty() && !begins {
            return self.command(who, line.trim());
        }
        session.text.push_str(line);
        session.text.push('\n');
        if line.trim_end() == "end" {
            let text = std::mem::take(&mut session.text);
            self.take_program(who, &text);
        }
    }

    /// A connection that was opened in local control stays read-only.
    fn is_refused(&mut self, who: (usize, u64)) -> bool {
        let local = !self.remote && !self.model.is_cb3();
        let refused = local || self.sessions.get(&who).is_some_and(|session| session.read_only);
        if refused {
            self.report_error(210, 0, 2);
        }
        refused
    }

    fn take_program(&mut self, who: (usize, u64), text: &str) {
        if self.is_refused(who) {
            return;
        }
        let (kind, head) = text.split_once(' ').unwrap_or_default();
        let name = head.split('(').next().unwrap_or_default().to_owned();
        if kind == "def" {
            text.lines()
                .map(str::trim)
                .filter(|line| line.starts_with("set_tool_"))
                .for_each(|line| self.statement(line));
        }
        match (kind, name.as_str()) {
            ("sec", _) => text.lines().for_each(|line| self.statement(line.trim())),
            (_, ours::NAME) => match Ours::new(text) {
                Ok(program) => self.run(Program::Ours(Box::new(program))),
                Err(refused) => self.report_exception(refused.line as i32, &refused.what),
            },
            (_, "rtde_control") => {
                // The registers keep what an earlier program has left.
                self.registers.int_out[0] = 0;
                self.run(Program::Rtde(RtdeControl::default()));
            }
            _ => self.run(Program::Other(name)),
        }
    }

    /// Executes a statement of a program that runs beside the main one, if it is known.
    fn statement(&mut self, line: &str) {
        let Some((name, arguments)) = line.strip_suffix(')').and_then(|line| line.split_once('(')) else { return };
        let values: Vec<f64> = arguments
            .split([',', '[', ']', ' '])
            .filter(|word| !word.is_empty())
            .filter_map(|word| word.parse().ok())
            .collect();
        match (name, &values[..]) {
            ("set_gravity", [x, y, z]) => self.gravity = [*x, *y, *z],
            ("set_tcp", [x, y, z, a, b, c]) => self.set_tcp([*x, *y, *z, *a, *b, *c]),
            ("set_payload", [mass, x, y, z]) => (self.payload.0, self.payload.1) = (*mass, [*x, *y, *z]),
            ("set_target_payload", [mass, x, y, z, inertia @ ..]) => {
                (self.payload.0, self.payload.1) = (*mass, [*x, *y, *z]);
                self.payload.2.iter_mut().zip(inertia).for_each(|(to, value)| *to = *value);
            }
            ("set_tool_communication", [baud, _, _, _, _]) => {
                self.tool_rate = arguments.starts_with("True").then_some(*baud as u32);
            }
            ("set_tool_voltage", [volts]) => self.outputs.tool_voltage = *volts as i32,
            _ => {}
        }
    }

    /// Executes a command outside of a program.
    fn command(&mut self, who: (usize, u64), line: &str) {
        if line.is_empty() || self.is_refused(who) {
            return;
        }
        match line {
            "power on" => self.power_on(false),
            "power off" => self.power_off(),
            "set robotmode run" => self.power_on(true),
            "set unlock protective stop" => drop(self.unlock()),
            "stop program" => self.stop_program(),
            _ => {}
        }
    }
}
