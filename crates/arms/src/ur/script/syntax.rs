//! The structure of a program.

use std::iter::Peekable;
use std::vec::IntoIter;

use super::lexer::Token;
use super::{Action, Expression, Function, Kind, Operator, Refused, Statement};

/// Words that name nothing.
const KEYWORDS: [&str; 25] = [
    "and",
    "break",
    "continue",
    "def",
    "elif",
    "else",
    "end",
    "enter_critical",
    "exit_critical",
    "False",
    "global",
    "halt",
    "if",
    "join",
    "kill",
    "local",
    "not",
    "or",
    "return",
    "run",
    "sec",
    "thread",
    "True",
    "while",
    "xor",
];
/// Operators, by how strongly they bind.
const OPERATORS: [&[(&str, Operator)]; 5] = [
    &[("or", Operator::Or)],
    &[("and", Operator::And)],
    &[
        ("==", Operator::Equal),
        ("!=", Operator::Unequal),
        ("<=", Operator::LessOrEqual),
        (">=", Operator::GreaterOrEqual),
        ("<", Operator::Less),
        (">", Operator::Greater),
    ],
    &[("+", Operator::Add), ("-", Operator::Subtract)],
    &[("*", Operator::Multiply), ("/", Operator::Divide), ("%", Operator::Remainder)],
];
/// Most brackets and blocks within each other.
const DEEPEST: u32 = 64;

struct Parser {
    tokens: Peekable<IntoIter<(u32, Token)>>,
    /// The line of the last word.
    line: u32,
    depth: u32,
}

/// Reads the statements of a text.
pub(super) fn parse(tokens: Vec<(u32, Token)>) -> Result<Vec<Statement>, Refused> {
    let mut parser = Parser { tokens: tokens.into_iter().peekable(), line: 1, depth: 0 };
    let program = parser.block(&[])?;
    match parser.tokens.next() {
        Some((line, token)) => Refused::new(line, format!("{token:?} ends nothing")),
        None => Ok(program),
    }
}

impl Parser {
    fn fail<T>(&self, what: impl Into<String>) -> Result<T, Refused> {
        Refused::new(self.line, what)
    }

    fn next(&mut self) -> Result<Token, Refused> {
        match self.tokens.next() {
            Some((line, token)) => {
                self.line = line;
                Ok(token)
            }
            None => self.fail("the text ends too early"),
        }
    }

    fn is(&mut self, wanted: &str) -> bool {
        match self.tokens.peek() {
            Some((_, Token::Name(name))) => name == wanted,
            Some((_, Token::Sign(sign))) => *sign == wanted,
            _ => false,
        }
    }

    /// Takes a word if it comes next.
    fn takes(&mut self, wanted: &str) -> bool {
        let is = self.is(wanted);
        if is && let Some((line, _)) = self.tokens.next() {
            self.line = line;
        }
        is
    }

    fn require(&mut self, wanted: &str) -> Result<(), Refused> {
        if self.takes(wanted) {
            return Ok(());
        }
        let found = self.tokens.peek().map(|(_, token)| token.clone());
        self.fail(format!("{wanted:?} is missing, found {found:?}"))
    }

    fn end_of_line(&mut self) -> Result<(), Refused> {
        match self.next()? {
            Token::Newline => Ok(()),
            token => self.fail(format!("{token:?} after the end of a statement")),
        }
    }

    /// A name that the program gives.
    fn name(&mut self) -> Result<String, Refused> {
        match self.next()? {
            Token::Name(name) if !KEYWORDS.contains(&name.as_str()) => Ok(name),
            token => self.fail(format!("{token:?} is no name")),
        }
    }

    /// Statements up to one of these words, which stays.
    fn block(&mut self, ends: &[&str]) -> Result<Vec<Statement>, Refused> {
        self.deeper(|parser| {
            let mut statements = Vec::new();
            while parser.tokens.peek().is_some() && !ends.iter().any(|end| parser.is(end)) {
                statements.push(parser.statement()?);
            }
            Ok(statements)
        })
    }

    fn deeper<T>(&mut self, act: impl FnOnce(&mut Self) -> Result<T, Refused>) -> Result<T, Refused> {
        self.depth += 1;
        if self.depth > DEEPEST {
            return self.fail("too many brackets or blocks within each other");
        }
        let result = act(self);
        self.depth -= 1;
        result
    }

    /// A colon, statements, `end`.
    fn body(&mut self) -> Result<Vec<Statement>, Refused> {
        self.require(":")?;
        self.end_of_line()?;
        let body = self.block(&["end"])?;
        self.require("end")?;
        Ok(body)
    }

    fn statement(&mut self) -> Result<Statement, Refused> {
        if let Some((line, _)) = self.tokens.peek() {
            self.line = *line;
        }
        let line = self.line;
        let action = self.action()?;
        self.end_of_line()?;
        Ok(Statement { line, action })
    }

    fn action(&mut self) -> Result<Action, Refused> {
        let Some((_, Token::Name(word))) = self.tokens.peek().cloned() else {
            return self.fail("a statement begins with a name");
        };
        if !KEYWORDS.contains(&word.as_str()) {
            return self.assignment(false);
        }
        self.next()?;
        Ok(match word.as_str() {
            "global" | "local" => return self.assignment(word == "local"),
            "def" | "sec" | "thread" => Action::Define(self.function()?),
            "if" => return self.conditional(),
            "while" => Action::While(self.expression()?, self.body()?),
            "return" => {
                let value = if matches!(self.tokens.peek(), Some((_, Token::Newline))) { None } else { Some(()) };
                Action::Return(value.map(|()| self.expression()).transpose()?)
            }
            "kill" | "join" => Action::Thread(self.expression()?),
            "run" => Action::Evaluate(self.thread()?),
            "break" | "continue" => Action::Loop,
            "halt" | "enter_critical" | "exit_critical" => Action::Other,
            word => return self.fail(format!("{word:?} begins no statement")),
        })
    }

    fn assignment(&mut self, local: bool) -> Result<Action, Refused> {
        let target = self.operand()?;
        if self.takes("=") {
            let value = self.expression()?;
            return match target.kind {
                Kind::Name(name) => Ok(Action::Assign { local, name, value }),
                Kind::Item(list, index) => match list.kind {
                    Kind::Name(name) => Ok(Action::AssignItem { name, index: *index, value }),
                    _ => self.fail("only an item of a variable is assigned"),
                },
                _ => self.fail("only a variable is assigned"),
            };
        }
        match target.kind {
            Kind::Call(..) => Ok(Action::Evaluate(target)),
            _ => self.fail("this statement does nothing"),
        }
    }

    fn conditional(&mut self) -> Result<Action, Refused> {
        let (mut cases, mut otherwise) = (Vec::new(), Vec::new());
        loop {
            let condition = self.expression()?;
            self.require(":")?;
            self.end_of_line()?;
            cases.push((condition, self.block(&["elif", "else", "end"])?));
            if self.takes("elif") {
                continue;
            }
            if self.takes("else") {
                otherwise = self.body()?;
            } else {
                self.require("end")?;
            }
            return Ok(Action::If { cases, otherwise });
        }
    }

    fn function(&mut self) -> Result<Function, Refused> {
        let (name, mut parameters) = (self.name()?, Vec::new());
        self.require("(")?;
        while !self.takes(")") {
            let parameter = self.name()?;
            let default = if self.takes("=") { Some(self.expression()?) } else { None };
            parameters.push((parameter, default));
            if !self.is(")") {
                self.require(",")?;
            }
        }
        Ok(Function { name, parameters, body: self.body()? })
    }

    fn expression(&mut self) -> Result<Expression, Refused> {
        self.deeper(|parser| parser.binary(0))
    }

    fn binary(&mut self, level: usize) -> Result<Expression, Refused> {
        let Some(operators) = OPERATORS.get(level) else { return self.unary() };
        let mut left = self.binary(level + 1)?;
        while let Some((_, operator)) = operators.iter().find(|(sign, _)| self.is(sign)) {
            self.next()?;
            let line = self.line;
            let right = self.binary(level + 1)?;
            left = Expression { line, kind: Kind::Binary(*operator, Box::new(left), Box::new(right)) };
        }
        Ok(left)
    }

    fn unary(&mut self) -> Result<Expression, Refused> {
        if self.takes("not") {
            let operand = self.deeper(|parser| parser.binary(2))?;
            return Ok(Expression { line: self.line, kind: Kind::Not(Box::new(operand)) });
        }
        if self.takes("-") {
            let operand = self.deeper(Self::unary)?;
            return Ok(Expression { line: self.line, kind: Kind::Negative(Box::new(operand)) });
        }
        if self.takes("run") { self.thread() } else { self.operand() }
    }

    fn thread(&mut self) -> Result<Expression, Refused> {
        let call = self.operand()?;
        Ok(Expression { line: self.line, kind: Kind::Run(Box::new(call)) })
    }

    fn operand(&mut self) -> Result<Expression, Refused> {
        let token = self.next()?;
        let line = self.line;
        let kind = match token {
            Token::Int(value) => Kind::Int(value),
            Token::Float(value) => Kind::Float(value),
            Token::Text => Kind::Text,
            Token::Sign("[") => Kind::List(self.items()?),
            Token::Sign("(") => {
                let inner = self.expression()?;
                self.require(")")?;
                inner.kind
            }
            Token::Name(name) if name == "True" || name == "False" => Kind::Bool(name == "True"),
            Token::Name(name) if KEYWORDS.contains(&name.as_str()) => {
                return self.fail(format!("{name:?} is no value"));
            }
            Token::Name(name) if name == "p" && self.takes("[") => Kind::Pose(self.items()?),
            Token::Name(name) if self.takes("(") => Kind::Call(name, self.arguments()?),
            Token::Name(name) => Kind::Name(name),
            token => return self.fail(format!("{token:?} is no value")),
        };
        let mut value = Expression { line, kind };
        while self.takes("[") {
            let index = self.expression()?;
            self.require("]")?;
            value = Expression { line, kind: Kind::Item(Box::new(value), Box::new(index)) };
        }
        Ok(value)
    }

    fn items(&mut self) -> Result<Vec<Expression>, Refused> {
        let mut items = Vec::new();
        while !self.takes("]") {
            items.push(self.expression()?);
            if !self.is("]") {
                self.require(",")?;
            }
        }
        Ok(items)
    }

    fn arguments(&mut self) -> Result<Vec<(Option<String>, Expression)>, Refused> {
        let mut arguments = Vec::new();
        while !self.takes(")") {
            let value = self.expression()?;
            let argument = match value.kind {
                Kind::Name(name) if self.takes("=") => (Some(name), self.expression()?),
                kind => (None, Expression { line: value.line, kind }),
            };
            arguments.push(argument);
            if !self.is(")") {
                self.require(",")?;
            }
        }
        Ok(arguments)
    }
}
