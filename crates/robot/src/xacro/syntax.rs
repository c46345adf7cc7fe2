//! Expressions: tokens → a tree. A subset of Python's: no statements, no lambda, no f-strings.

use super::tokens::{KEYWORDS, Token, is_identifier, number, shown, tokens};
use super::value::Value;

/// Maximum length of an expression [bytes].
const MAX_LENGTH: usize = 16 << 10;
/// Maximum number of tokens: bounds the depth of the tree and of its evaluation.
const MAX_TOKENS: usize = 2000;
/// Maximum nesting of parentheses.
const MAX_DEPTH: usize = 60;

/// An expression.
#[derive(Debug, Clone)]
pub(super) enum Expr {
    Const(Value),
    Name(String),
    Not(Box<Expr>),
    Negative(Box<Expr>),
    Positive(Box<Expr>),
    Binary(&'static str, Box<Expr>, Box<Expr>),
    Compare(Box<Expr>, Vec<(&'static str, Expr)>),
    And(Box<Expr>, Box<Expr>),
    Or(Box<Expr>, Box<Expr>),
    /// `then if condition else otherwise`: condition, then, otherwise.
    If(Box<Expr>, Box<Expr>, Box<Expr>),
    Attribute(Box<Expr>, String),
    Index(Box<Expr>, Box<Expr>),
    Slice(Box<Expr>, [Option<Box<Expr>>; 3]),
    Call(Box<Expr>, Vec<Expr>, Vec<(String, Expr)>),
    List(Vec<Expr>),
    Tuple(Vec<Expr>),
    Dict(Vec<(Expr, Expr)>),
    /// `[item for names in source if …]`
    Each(Box<Expr>, Vec<Loop>),
}

/// One `for … in … if …`.
#[derive(Debug, Clone)]
pub(super) struct Loop {
    pub(super) names: Vec<String>,
    pub(super) source: Expr,
    pub(super) conditions: Vec<Expr>,
}

/// Parses an expression. The error describes what is wrong.
pub(super) fn parse(text: &str) -> Result<Expr, String> {
    if text.len() > MAX_LENGTH {
        return Err(format!("the expression is longer than {MAX_LENGTH} bytes"));
    }
    let tokens = tokens(text)?;
    if tokens.len() > MAX_TOKENS {
        return Err(format!("the expression has more than {MAX_TOKENS} words"));
    }
    let mut parser = Parser { tokens, at: 0, depth: 0 };
    let expr = parser.tuple()?;
    match parser.peek() {
        None => Ok(expr),
        Some(token) => Err(format!("invalid syntax: {} is not expected here", shown(token))),
    }
}

struct Parser {
    tokens: Vec<Token>,
    at: usize,
    depth: usize,
}

type Parsed = Result<Expr, String>;

impl Parser {
    fn peek(&self) -> Option<&Token> {
        self.tokens.get(self.at)
    }

    fn next(&mut self) -> Option<Token> {
        let token = self.tokens.get(self.at).cloned();
        self.at += 1;
        token
    }

    fn sign(&mut self, sign: &str) -> bool {
        let found = matches!(self.peek(), Some(Token::Sign(s)) if *s == sign);
        self.at += usize::from(found);
        found
    }

    fn word(&mut self, word: &str) -> bool {
        let found = matches!(self.peek(), Some(Token::Name(n)) if n == word);
        self.at += usize::from(found);
        found
    }

    fn expect(&mut self, sign: &str) -> Result<(), String> {
        if self.sign(sign) {
            return Ok(());
        }
        Err(match self.peek() {
            Some(token) => format!("invalid syntax: `{sign}` is expected before {}", shown(token)),
            None => format!("invalid syntax: `{sign}` is missing at the end"),
        })
    }

    /// Parses one expression, or several separated by commas.
    fn tuple(&mut self) -> Parsed {
        let first = self.ternary()?;
        if !matches!(self.peek(), Some(Token::Sign(","))) {
            return Ok(first);
        }
        let mut items = vec![first];
        while self.sign(",") {
            if self.peek().is_none() || matches!(self.peek(), Some(Token::Sign(")" | "]"))) {
                break;
            }
            items.push(self.ternary()?);
        }
        Ok(Expr::Tuple(items))
    }

    fn ternary(&mut self) -> Parsed {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err("the expression is nested too deeply".to_owned());
        }
        let then = self.or()?;
        let expr = if self.word("if") {
            let condition = self.or()?;
            if !self.word("else") {
                return Err("invalid syntax: `else` is missing".to_owned());
            }
            Expr::If(Box::new(condition), Box::new(then), Box::new(self.ternary()?))
        } else {
            then
        };
        self.depth -= 1;
        Ok(expr)
    }

    fn or(&mut self) -> Parsed {
        let mut left = self.and()?;
        while self.word("or") {
            left = Expr::Or(Box::new(left), Box::new(self.and()?));
        }
        Ok(left)
    }

    fn and(&mut self) -> Parsed {
        let mut left = self.not()?;
        while self.word("and") {
            left = Expr::And(Box::new(left), Box::new(self.not()?));
        }
        Ok(left)
    }

    fn not(&mut self) -> Parsed {
        let mut times = 0;
        while self.word("not") {
            times += 1;
        }
        let mut expr = self.comparison()?;
        for _ in 0..times {
            expr = Expr::Not(Box::new(expr));
        }
        Ok(expr)
    }

    fn comparison(&mut self) -> Parsed {
        let left = self.sum()?;
        let mut steps = Vec::new();
        while let Some(operator) = self.comparator() {
            steps.push((operator, self.sum()?));
        }
        Ok(if steps.is_empty() { left } else { Expr::Compare(Box::new(left), steps) })
    }

    fn comparator(&mut self) -> Option<&'static str> {
        let signs = ["==", "!=", "<=", ">=", "<", ">"];
        if let Some(sign) = signs.into_iter().find(|sign| self.sign(sign)) {
            return Some(sign);
        }
        if self.word("in") {
            return Some("in");
        }
        if self.word("is") {
            return Some(if self.word("not") { "is not" } else { "is" });
        }
        let ahead = matches!(self.tokens.get(self.at + 1), Some(Token::Name(n)) if n == "in");
        if ahead && self.word("not") && self.word("in") {
            return Some("not in");
        }
        None
    }

    fn sum(&mut self) -> Parsed {
        self.chain(&["+", "-"], Self::product)
    }

    fn product(&mut self) -> Parsed {
        self.chain(&["*", "/", "//", "%"], Self::factor)
    }

    fn chain(&mut self, signs: &[&'static str], inner: fn(&mut Self) -> Parsed) -> Parsed {
        let mut left = inner(self)?;
        while let Some(sign) = signs.iter().copied().find(|sign| self.sign(sign)) {
            left = Expr::Binary(sign, Box::new(left), Box::new(inner(self)?));
        }
        Ok(left)
    }

    fn factor(&mut self) -> Parsed {
        let mut signs = Vec::new();
        while let Some(sign) = ["-", "+"].into_iter().find(|sign| self.sign(sign)) {
            signs.push(sign);
        }
        let mut expr = self.power()?;
        for sign in signs.into_iter().rev() {
            expr = if sign == "-" { Expr::Negative(Box::new(expr)) } else { Expr::Positive(Box::new(expr)) };
        }
        Ok(expr)
    }

    fn power(&mut self) -> Parsed {
        let base = self.postfix()?;
        if !self.sign("**") {
            return Ok(base);
        }
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err("the expression is nested too deeply".to_owned());
        }
        let exponent = self.factor()?;
        self.depth -= 1;
        Ok(Expr::Binary("**", Box::new(base), Box::new(exponent)))
    }

    fn postfix(&mut self) -> Parsed {
        let mut expr = self.atom()?;
        loop {
            if self.sign(".") {
                let Some(Token::Name(name)) = self.next() else {
                    return Err("invalid syntax: a name is expected after `.`".to_owned());
                };
                expr = Expr::Attribute(Box::new(expr), allowed(name)?);
            } else if self.sign("(") {
                let (values, named) = self.arguments()?;
                expr = Expr::Call(Box::new(expr), values, named);
            } else if self.sign("[") {
                expr = self.subscript(expr)?;
            } else {
                return Ok(expr);
            }
        }
    }

    #[expect(clippy::type_complexity, reason = "positional and named arguments, used once")]
    fn arguments(&mut self) -> Result<(Vec<Expr>, Vec<(String, Expr)>), String> {
        let (mut values, mut named) = (Vec::new(), Vec::new());
        while !self.sign(")") {
            if !values.is_empty() || !named.is_empty() {
                self.expect(",")?;
                if self.sign(")") {
                    break;
                }
            }
            match (self.peek().cloned(), self.tokens.get(self.at + 1)) {
                (Some(Token::Name(name)), Some(Token::Sign("="))) => {
                    self.at += 2;
                    named.push((name, self.ternary()?));
                }
                _ => {
                    let value = self.ternary()?;
                    let value = if matches!(self.peek(), Some(Token::Name(n)) if n == "for") {
                        self.each(value)?
                    } else {
                        value
                    };
                    values.push(value);
                }
            }
        }
        Ok((values, named))
    }

    fn subscript(&mut self, value: Expr) -> Parsed {
        let ends = |parser: &Self| matches!(parser.peek(), Some(Token::Sign(":" | "]")));
        let first = if ends(self) { None } else { Some(Box::new(self.tuple()?)) };
        if self.sign("]") {
            let index = first.ok_or("invalid syntax: an index is missing")?;
            return Ok(Expr::Index(Box::new(value), index));
        }
        let mut parts = [first, None, None];
        for part in parts.iter_mut().skip(1) {
            if self.sign(":") && !ends(self) {
                *part = Some(Box::new(self.ternary()?));
            }
        }
        self.expect("]")?;
        Ok(Expr::Slice(Box::new(value), parts))
    }

    fn atom(&mut self) -> Parsed {
        match self.next() {
            Some(Token::Number(text)) => number(&text).map(Expr::Const),
            Some(Token::Text(mut text)) => {
                while let Some(Token::Text(more)) = self.peek().cloned() {
                    text.push_str(&more);
                    self.at += 1;
                }
                Ok(Expr::Const(text.into()))
            }
            Some(Token::Name(name)) => match name.as_str() {
                "None" => Ok(Expr::Const(Value::None)),
                "True" => Ok(Expr::Const(Value::Bool(true))),
                "False" => Ok(Expr::Const(Value::Bool(false))),
                "lambda" => Err("`lambda` is not supported".to_owned()),
                word if KEYWORDS.contains(&word) => Err(format!("invalid syntax: `{word}` is not expected here")),
                _ => allowed(name).map(Expr::Name),
            },
            Some(Token::Sign("(")) => {
                if self.sign(")") {
                    return Ok(Expr::Tuple(Vec::new()));
                }
                let inside = self.tuple()?;
                let inside =
                    if matches!(self.peek(), Some(Token::Name(n)) if n == "for") { self.each(inside)? } else { inside };
                self.expect(")")?;
                Ok(inside)
            }
            Some(Token::Sign("[")) => self.list(),
            Some(Token::Sign("{")) => self.dict(),
            Some(token) => Err(format!("invalid syntax: {} is not expected here", shown(&token))),
            None => Err("invalid syntax: the expression ends too early".to_owned()),
        }
    }

    fn list(&mut self) -> Parsed {
        let mut items = Vec::new();
        while !self.sign("]") {
            if !items.is_empty() {
                self.expect(",")?;
                if self.sign("]") {
                    break;
                }
            }
            let item = self.ternary()?;
            if items.is_empty() && matches!(self.peek(), Some(Token::Name(n)) if n == "for") {
                let each = self.each(item)?;
                self.expect("]")?;
                return Ok(each);
            }
            items.push(item);
        }
        Ok(Expr::List(items))
    }

    fn dict(&mut self) -> Parsed {
        let mut entries = Vec::new();
        while !self.sign("}") {
            if !entries.is_empty() {
                self.expect(",")?;
                if self.sign("}") {
                    break;
                }
            }
            let key = self.ternary()?;
            self.expect(":")?;
            entries.push((key, self.ternary()?));
        }
        Ok(Expr::Dict(entries))
    }

    /// Parses the loops after an item.
    fn each(&mut self, item: Expr) -> Parsed {
        let mut loops = Vec::new();
        while self.word("for") {
            let mut names = Vec::new();
            let parenthesis = self.sign("(");
            loop {
                match self.next() {
                    Some(Token::Name(name)) if is_identifier(&name) => names.push(allowed(name)?),
                    _ => return Err("invalid syntax: a name is expected after `for`".to_owned()),
                }
                if !self.sign(",") {
                    break;
                }
            }
            if parenthesis {
                self.expect(")")?;
            }
            if !self.word("in") {
                return Err("invalid syntax: `in` is missing".to_owned());
            }
            let source = self.or()?;
            let mut conditions = Vec::new();
            while self.word("if") {
                conditions.push(self.or()?);
            }
            loops.push(Loop { names, source, conditions });
        }
        Ok(Expr::Each(Box::new(item), loops))
    }
}

/// Rejects names with two underscores, like xacro: they lead into Python's internals.
fn allowed(name: String) -> Result<String, String> {
    if name.starts_with("__") { Err(format!("Use of invalid name(s): {name}")) } else { Ok(name) }
}
