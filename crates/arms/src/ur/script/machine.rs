//! Runs a program step by step: numbers, lists of six numbers, conditions, loops, and calls of what a controller has.
//! The reader has checked its types, so numbers, truth values and integers are all `f64` here.

use std::collections::BTreeMap;

use super::{Action, Expression, Kind, Operator, Refused, Statement};

/// Instructions that a program may carry out without waiting for the next step of the controller.
const MOST: u32 = 20_000;

/// Lookahead time of a servoj that gives none [s].
const LOOKAHEAD: f64 = 0.1;

/// What a program finds on its controller.
pub trait Controller {
    /// Time of a step [s].
    fn step_time(&self) -> f64;
    /// Joint positions that the controller commands [rad].
    fn target(&self) -> [f64; 6];
    fn read_integer(&self, register: usize) -> i32;
    fn read_float(&self, register: usize) -> f64;
    fn write_integer(&mut self, register: usize, value: i32);
    /// Follows a point for one step; `lookahead`: time over which its trajectory is smoothed [s].
    fn servoj(&mut self, point: &[f64; 6], lookahead: f64);
    /// Decelerates to rest [rad/s²].
    fn stopj(&mut self, deceleration: f64);
}

/// A program, and where it is.
#[derive(Debug, Clone)]
pub struct Machine {
    code: Vec<Instruction>,
    at: usize,
    numbers: Vec<f64>,
    lists: Vec<[f64; 6]>,
}

/// What one instruction does. Variables have numbers.
#[derive(Debug, Clone)]
enum Instruction {
    Number(usize, Number),
    List(usize, List),
    Item(usize, Number, Number),
    Jump(usize),
    Unless(Number, usize),
    Write(Number, Number),
    Servoj(List, Number),
    Stopj(Number),
    Sync,
}

#[derive(Debug, Clone)]
enum Number {
    Constant(f64),
    Variable(usize),
    Item(usize, Box<Number>),
    Not(Box<Number>),
    Negative(Box<Number>),
    Binary(Operator, Box<Number>, Box<Number>),
    Floor(Box<Number>),
    Power(Box<Number>, Box<Number>),
    StepTime,
    ReadInteger(Box<Number>),
    ReadFloat(Box<Number>),
}

#[derive(Debug, Clone)]
enum List {
    Variable(usize),
    Items(Box<[Number; 6]>),
    Target,
}

impl Machine {
    /// Reads the program of this name, and goes to its first line.
    pub fn new(text: &str, name: &str) -> Result<Self, Refused> {
        let program = super::read(text)?;
        let body = program.iter().find_map(|statement| match &statement.action {
            Action::Define(function) if function.name == name => Some(&function.body),
            _ => None,
        });
        let Some(body) = body else { return Refused::new(1, format!("there is no program {name}")) };
        let mut compiler = Compiler { code: Vec::new(), numbers: BTreeMap::new(), lists: BTreeMap::new() };
        compiler.block(body)?;
        let (numbers, lists) = (vec![0.0; compiler.numbers.len()], vec![[0.0; 6]; compiler.lists.len()]);
        Ok(Self { code: compiler.code, at: 0, numbers, lists })
    }

    /// Runs the program up to its next call that takes a step; whether there was one, and the program continues.
    pub fn step(&mut self, controller: &mut impl Controller) -> bool {
        for _ in 0..MOST {
            let Some(instruction) = self.code.get(self.at) else { return false };
            self.at += 1;
            match instruction {
                Instruction::Number(to, value) => {
                    let value = self.number(value, controller);
                    if let Some(to) = self.numbers.get_mut(*to) {
                        *to = value;
                    }
                }
                Instruction::List(to, value) => {
                    let value = self.list(value, controller);
                    if let Some(to) = self.lists.get_mut(*to) {
                        *to = value;
                    }
                }
                Instruction::Item(list, index, value) => {
                    let (index, value) = (self.number(index, controller), self.number(value, controller));
                    let item = self.lists.get_mut(*list).and_then(|list| list.get_mut(index as usize));
                    let Some(item) = item else { return false };
                    *item = value;
                }
                Instruction::Jump(to) => self.at = *to,
                Instruction::Unless(condition, to) => {
                    if self.number(condition, controller) == 0.0 {
                        self.at = *to;
                    }
                }
                Instruction::Write(register, value) => {
                    let (register, value) = (self.number(register, controller), self.number(value, controller));
                    controller.write_integer(register as usize, value as i32);
                }
                Instruction::Stopj(deceleration) => controller.stopj(self.number(deceleration, controller)),
                Instruction::Servoj(point, lookahead) => {
                    let lookahead = self.number(lookahead, controller);
                    controller.servoj(&self.list(point, controller), lookahead);
                    return true;
                }
                Instruction::Sync => return true,
            }
        }
        false
    }

    fn list(&self, list: &List, controller: &impl Controller) -> [f64; 6] {
        match list {
            List::Variable(at) => self.lists.get(*at).copied().unwrap_or_default(),
            List::Items(items) => items.each_ref().map(|item| self.number(item, controller)),
            List::Target => controller.target(),
        }
    }

    fn number(&self, number: &Number, controller: &impl Controller) -> f64 {
        match number {
            Number::Constant(value) => *value,
            Number::Variable(at) => self.numbers.get(*at).copied().unwrap_or(f64::NAN),
            Number::Item(list, index) => {
                let index = self.number(index, controller) as usize;
                self.lists.get(*list).and_then(|list| list.get(index)).copied().unwrap_or(f64::NAN)
            }
            Number::Binary(Operator::And, left, right) => {
                if self.number(left, controller) == 0.0 {
                    0.0
                } else {
                    self.number(right, controller)
                }
            }
            Number::Binary(Operator::Or, left, right) => {
                if self.number(left, controller) == 0.0 {
                    self.number(right, controller)
                } else {
                    1.0
                }
            }
            Number::Binary(operator, left, right) => {
                apply(*operator, self.number(left, controller), self.number(right, controller))
            }
            Number::Not(operand) => truth(self.number(operand, controller) == 0.0),
            Number::Negative(operand) => -self.number(operand, controller),
            Number::Floor(operand) => self.number(operand, controller).floor(),
            Number::Power(base, exponent) => self.number(base, controller).powf(self.number(exponent, controller)),
            Number::StepTime => controller.step_time(),
            Number::ReadInteger(register) => controller.read_integer(self.number(register, controller) as usize).into(),
            Number::ReadFloat(register) => controller.read_float(self.number(register, controller) as usize),
        }
    }
}

fn truth(value: bool) -> f64 {
    if value { 1.0 } else { 0.0 }
}

fn apply(operator: Operator, a: f64, b: f64) -> f64 {
    match operator {
        Operator::Add => a + b,
        Operator::Subtract => a - b,
        Operator::Multiply => a * b,
        Operator::Divide => a / b,
        Operator::Remainder => a % b,
        Operator::Equal => truth(a == b),
        Operator::Unequal => truth(a != b),
        Operator::Less => truth(a < b),
        Operator::Greater => truth(a > b),
        Operator::LessOrEqual => truth(a <= b),
        Operator::GreaterOrEqual => truth(a >= b),
        Operator::And => truth(a != 0.0 && b != 0.0),
        Operator::Or => truth(a != 0.0 || b != 0.0),
    }
}

struct Compiler<'a> {
    code: Vec<Instruction>,
    numbers: BTreeMap<&'a str, usize>,
    lists: BTreeMap<&'a str, usize>,
}

/// What is part of the language, but not carried out here.
fn cannot<T>(line: u32, what: &str) -> Result<T, Refused> {
    Refused::new(line, format!("{what} is not carried out here"))
}

impl<'a> Compiler<'a> {
    fn block(&mut self, statements: &'a [Statement]) -> Result<(), Refused> {
        statements.iter().try_for_each(|statement| self.statement(statement))
    }

    fn statement(&mut self, statement: &'a Statement) -> Result<(), Refused> {
        match &statement.action {
            Action::Assign { name, value, .. } => {
                let instruction = match self.list(value)? {
                    Some(list) => Instruction::List(number_of(&mut self.lists, name), list),
                    None => {
                        let value = self.number(value)?;
                        Instruction::Number(number_of(&mut self.numbers, name), value)
                    }
                };
                self.code.push(instruction);
            }
            Action::AssignItem { name, index, value } => {
                let (index, value) = (self.number(index)?, self.number(value)?);
                self.code.push(Instruction::Item(number_of(&mut self.lists, name), index, value));
            }
            // The emulator takes settings of the tool from the text: they take no step.
            Action::Evaluate(Expression { kind: Kind::Call(name, _), .. }) if name.starts_with("set_tool_") => {}
            Action::Evaluate(call) => {
                let instruction = self.call(call)?;
                self.code.push(instruction);
            }
            Action::If { cases, otherwise } => {
                let mut ends = Vec::new();
                for (condition, body) in cases {
                    let skip = self.skip_unless(condition)?;
                    self.block(body)?;
                    ends.push(self.code.len());
                    self.code.push(Instruction::Jump(0));
                    self.arrive(skip);
                }
                self.block(otherwise)?;
                ends.into_iter().for_each(|end| self.arrive(end));
            }
            Action::While(condition, body) => {
                let begin = self.code.len();
                let skip = self.skip_unless(condition)?;
                self.block(body)?;
                self.code.push(Instruction::Jump(begin));
                self.arrive(skip);
            }
            _ => return cannot(statement.line, "this statement"),
        }
        Ok(())
    }

    fn skip_unless(&mut self, condition: &Expression) -> Result<usize, Refused> {
        let condition = self.number(condition)?;
        self.code.push(Instruction::Unless(condition, 0));
        Ok(self.code.len() - 1)
    }

    /// Lets a jump lead to the next instruction.
    fn arrive(&mut self, jump: usize) {
        let here = self.code.len();
        if let Some(Instruction::Jump(to) | Instruction::Unless(_, to)) = self.code.get_mut(jump) {
            *to = here;
        }
    }

    fn call(&self, call: &Expression) -> Result<Instruction, Refused> {
        let Kind::Call(name, arguments) = &call.kind else { return cannot(call.line, "this statement") };
        match (name.as_str(), &arguments[..]) {
            ("servoj", [(None, point), rest @ ..]) => match self.list(point)? {
                Some(point) => {
                    let named = |(name, _): &&(Option<String>, Expression)| name.as_deref() == Some("lookahead_time");
                    let given = rest.iter().find(named).or_else(|| rest.get(3).filter(|(name, _)| name.is_none()));
                    let lookahead = given.map_or(Ok(Number::Constant(LOOKAHEAD)), |(_, value)| self.number(value))?;
                    Ok(Instruction::Servoj(point, lookahead))
                }
                None => cannot(call.line, "servoj to a pose"),
            },
            ("stopj", [(None, deceleration)]) => Ok(Instruction::Stopj(self.number(deceleration)?)),
            ("sync", []) => Ok(Instruction::Sync),
            ("write_output_integer_register", [(None, register), (None, value)]) => {
                Ok(Instruction::Write(self.number(register)?, self.number(value)?))
            }
            _ => cannot(call.line, name),
        }
    }

    /// An expression that is a list; `None` for a number.
    fn list(&self, expression: &Expression) -> Result<Option<List>, Refused> {
        Ok(match &expression.kind {
            Kind::Name(name) => self.lists.get(name.as_str()).map(|at| List::Variable(*at)),
            Kind::List(items) => {
                let items = items.iter().map(|item| self.number(item)).collect::<Result<Vec<_>, _>>()?;
                match items.try_into() {
                    Ok(items) => Some(List::Items(Box::new(items))),
                    Err(_) => return cannot(expression.line, "a list of other than six numbers"),
                }
            }
            Kind::Call(name, _) if name == "get_target_joint_positions" => Some(List::Target),
            _ => None,
        })
    }

    fn number(&self, expression: &Expression) -> Result<Number, Refused> {
        let inner = |expression: &Expression| self.number(expression).map(Box::new);
        Ok(match &expression.kind {
            Kind::Int(value) => Number::Constant((*value).into()),
            Kind::Float(value) => Number::Constant(*value),
            Kind::Bool(value) => Number::Constant(truth(*value)),
            Kind::Name(name) => match self.numbers.get(name.as_str()) {
                Some(at) => Number::Variable(*at),
                None => return cannot(expression.line, name),
            },
            Kind::Item(list, index) => match &list.kind {
                Kind::Name(name) if self.lists.contains_key(name.as_str()) => {
                    Number::Item(self.lists.get(name.as_str()).copied().unwrap_or_default(), inner(index)?)
                }
                _ => return cannot(expression.line, "this item"),
            },
            Kind::Not(operand) => Number::Not(inner(operand)?),
            Kind::Negative(operand) => Number::Negative(inner(operand)?),
            Kind::Binary(operator, left, right) => Number::Binary(*operator, inner(left)?, inner(right)?),
            Kind::Call(name, arguments) => match (name.as_str(), &arguments[..]) {
                ("floor", [(None, value)]) => Number::Floor(inner(value)?),
                ("pow", [(None, base), (None, exponent)]) => Number::Power(inner(base)?, inner(exponent)?),
                ("get_steptime", []) => Number::StepTime,
                ("read_input_integer_register", [(None, register)]) => Number::ReadInteger(inner(register)?),
                ("read_input_float_register", [(None, register)]) => Number::ReadFloat(inner(register)?),
                _ => return cannot(expression.line, name),
            },
            _ => return cannot(expression.line, "this value"),
        })
    }
}

fn number_of<'a>(names: &mut BTreeMap<&'a str, usize>, name: &'a str) -> usize {
    let next = names.len();
    *names.entry(name).or_insert(next)
}
