//! The language of the programs on a controller, URScript, as far as the programs use it that dimos and the vendor
//! send: a reader that refuses what a controller would refuse (`syntax`, `types`, `names`), and the execution of a
//! program that defines no functions (`machine`). The emulator runs the text of `control.script` with it.

mod lexer;
pub mod machine;
mod names;
mod syntax;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_motion;
#[cfg(test)]
mod tests_patterns;
mod types;

use std::fmt;

/// Why a controller would not run a program, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refused {
    /// Line, from 1.
    pub line: u32,
    /// What is wrong there.
    pub what: String,
}

impl Refused {
    fn new<T>(line: u32, what: impl Into<String>) -> Result<T, Self> {
        Err(Self { line, what: what.into() })
    }
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "line {}: {}", self.line, self.what)
    }
}

/// Reads a program: its syntax, its names, its types.
pub fn read(text: &str) -> Result<Vec<Statement>, Refused> {
    let program = syntax::parse(lexer::tokens(text)?)?;
    types::check(&program)?;
    Ok(program)
}

/// An expression and its line.
#[derive(Debug, Clone, PartialEq)]
pub struct Expression {
    pub line: u32,
    pub kind: Kind,
}

/// What an expression is.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    Int(i32),
    Float(f64),
    Bool(bool),
    Text,
    Name(String),
    List(Vec<Expression>),
    Pose(Vec<Expression>),
    Item(Box<Expression>, Box<Expression>),
    /// A call; arguments may have names.
    Call(String, Vec<(Option<String>, Expression)>),
    /// Starts a thread.
    Run(Box<Expression>),
    Not(Box<Expression>),
    Negative(Box<Expression>),
    Binary(Operator, Box<Expression>, Box<Expression>),
}

/// An operator between two values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operator {
    Or,
    And,
    Equal,
    Unequal,
    Less,
    Greater,
    LessOrEqual,
    GreaterOrEqual,
    Add,
    Subtract,
    Multiply,
    Divide,
    Remainder,
}

/// A statement and its line.
#[derive(Debug, Clone, PartialEq)]
pub struct Statement {
    pub line: u32,
    pub action: Action,
}

/// What a statement does.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    Assign {
        local: bool,
        name: String,
        value: Expression,
    },
    AssignItem {
        name: String,
        index: Expression,
        value: Expression,
    },
    Evaluate(Expression),
    If {
        cases: Vec<(Expression, Vec<Statement>)>,
        otherwise: Vec<Statement>,
    },
    While(Expression, Vec<Statement>),
    Define(Function),
    Return(Option<Expression>),
    /// `kill` and `join` of a thread.
    Thread(Expression),
    /// `break` and `continue`.
    Loop,
    /// `halt`, `enter_critical` and `exit_critical`.
    Other,
}

/// A function, a thread, or a program.
#[derive(Debug, Clone, PartialEq)]
pub struct Function {
    pub name: String,
    /// Parameters, and their values where a call has none.
    pub parameters: Vec<(String, Option<Expression>)>,
    pub body: Vec<Statement>,
}
