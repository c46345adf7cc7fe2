//! The values of a pickle, as far as calls of a coordinator need them.

use super::pickle_reader::PickleError;

/// Index of a value.
pub type Id = u32;

/// A value of a pickle.
#[derive(Debug, Clone, PartialEq)]
pub enum Node<'a> {
    /// `None`.
    None,
    /// A truth value.
    Bool(bool),
    /// An integer.
    Int(i64),
    /// A number.
    Float(f64),
    /// A string.
    Text(&'a str),
    /// Bytes.
    Bytes(&'a [u8]),
    /// A list.
    List(Vec<Id>),
    /// A tuple.
    Tuple(Vec<Id>),
    /// A dict, as its entries.
    Dict(Vec<(Id, Id)>),
    /// A class, by name.
    Class(Class),
    /// An object: its class, and what it would be created with. Nothing is.
    Object {
        /// Its class.
        class: Class,
        /// Arguments of its creation: a tuple.
        arguments: Id,
        /// Its state, if that was set.
        state: Option<Id>,
    },
}

/// Classes that are accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Class {
    /// A trajectory.
    JointTrajectory,
    /// A point of one.
    TrajectoryPoint,
    /// A number of numpy.
    Scalar,
    /// The type of such a number.
    Dtype,
}

impl Class {
    /// Returns the class of this name, if it is accepted.
    pub fn of(module: &str, name: &str) -> Option<Self> {
        Some(match (module, name) {
            ("dimos.msgs.trajectory_msgs.JointTrajectory", "JointTrajectory") => Self::JointTrajectory,
            ("dimos.msgs.trajectory_msgs.TrajectoryPoint", "TrajectoryPoint") => Self::TrajectoryPoint,
            ("numpy._core.multiarray" | "numpy.core.multiarray", "scalar") => Self::Scalar,
            ("numpy", "dtype") => Self::Dtype,
            _ => return None,
        })
    }
}

/// A pickle that was read.
#[derive(Debug, Clone)]
pub struct Pickled<'a> {
    pub(super) nodes: Vec<Node<'a>>,
    pub(super) root: Id,
}

impl<'a> Pickled<'a> {
    /// Returns the value that was pickled.
    pub fn root(&self) -> Id {
        self.root
    }

    /// Returns a value.
    pub fn node(&self, id: Id) -> &Node<'a> {
        self.nodes.get(id as usize).unwrap_or(&Node::None)
    }

    /// Returns what a value is, for messages.
    pub fn kind(&self, id: Id) -> &'static str {
        match self.node(id) {
            Node::None => "None",
            Node::Bool(_) => "bool",
            Node::Int(_) => "int",
            Node::Float(_) => "float",
            Node::Text(_) => "str",
            Node::Bytes(_) => "bytes",
            Node::List(_) => "list",
            Node::Tuple(_) => "tuple",
            Node::Dict(_) => "dict",
            Node::Class(_) => "type",
            Node::Object { class: Class::JointTrajectory, .. } => "JointTrajectory",
            Node::Object { class: Class::TrajectoryPoint, .. } => "TrajectoryPoint",
            Node::Object { class: Class::Scalar, .. } => "numpy number",
            Node::Object { class: Class::Dtype, .. } => "dtype",
        }
    }

    /// Returns a string; the error says what `what` is instead.
    pub fn text(&self, id: Id, what: &str) -> Result<&'a str, PickleError> {
        match self.node(id) {
            Node::Text(text) => Ok(text),
            _ => self.unlike(id, what, "str"),
        }
    }

    /// Returns a truth value.
    pub fn truth(&self, id: Id, what: &str) -> Result<bool, PickleError> {
        match self.node(id) {
            Node::Bool(value) => Ok(*value),
            _ => self.unlike(id, what, "bool"),
        }
    }

    /// Returns the values of a list or a tuple.
    pub fn items(&self, id: Id, what: &str) -> Result<&[Id], PickleError> {
        match self.node(id) {
            Node::List(items) | Node::Tuple(items) => Ok(items),
            _ => self.unlike(id, what, "list"),
        }
    }

    /// Returns the entries of a dict; the last one of a key counts.
    pub fn entries(&self, id: Id, what: &str) -> Result<&[(Id, Id)], PickleError> {
        match self.node(id) {
            Node::Dict(entries) => Ok(entries),
            _ => self.unlike(id, what, "dict"),
        }
    }

    /// Returns an attribute of an object of this class. Both layouts of state are known: a dict, and that of classes
    /// with slots, `(None, dict)`.
    pub fn attribute(&self, id: Id, class: Class, name: &str) -> Result<Id, PickleError> {
        let missing = || PickleError(format!("the {} has no `{name}`", self.kind(id)));
        let Node::Object { class: found, state: Some(state), .. } = self.node(id) else { return Err(missing()) };
        if *found != class {
            return Err(missing());
        }
        let state = match self.node(*state) {
            Node::Tuple(parts) => *parts.get(1).ok_or_else(missing)?,
            _ => *state,
        };
        let entries = self.entries(state, "the state of an object")?;
        let named = |entry: &&(Id, Id)| *self.node(entry.0) == Node::Text(name);
        entries.iter().rev().find(named).map(|entry| entry.1).ok_or_else(missing)
    }

    /// Returns a number, also one of numpy.
    pub fn number(&self, id: Id, what: &str) -> Result<f64, PickleError> {
        match self.node(id) {
            Node::Float(value) => Ok(*value),
            Node::Int(value) => Ok(*value as f64),
            Node::Object { class: Class::Scalar, arguments, .. } => {
                self.scalar(*arguments).map_or_else(|| self.unlike(id, what, "float"), Ok)
            }
            _ => self.unlike(id, what, "float"),
        }
    }

    /// Returns the numbers of a list.
    pub fn numbers(&self, id: Id, what: &str) -> Result<Vec<f64>, PickleError> {
        self.items(id, what)?.iter().map(|item| self.number(*item, what)).collect()
    }

    /// Returns a number of numpy: its type and its bytes.
    fn scalar(&self, arguments: Id) -> Option<f64> {
        let Node::Tuple(arguments) = self.node(arguments) else { return None };
        let [dtype, bytes] = arguments[..] else { return None };
        let (Node::Object { class: Class::Dtype, arguments, state }, Node::Bytes(bytes)) =
            (self.node(dtype), self.node(bytes))
        else {
            return None;
        };
        let (Node::Tuple(arguments), Node::Tuple(state)) = (self.node(*arguments), self.node((*state)?)) else {
            return None;
        };
        let (Node::Text(code), Node::Text(order)) = (self.node(*arguments.first()?), self.node(*state.get(1)?)) else {
            return None;
        };
        if *order == ">" {
            return None;
        }
        Some(match *code {
            "f8" => f64::from_le_bytes((*bytes).try_into().ok()?),
            "f4" => f32::from_le_bytes((*bytes).try_into().ok()?).into(),
            "i8" => i64::from_le_bytes((*bytes).try_into().ok()?) as f64,
            "i4" => i32::from_le_bytes((*bytes).try_into().ok()?).into(),
            _ => return None,
        })
    }

    fn unlike<T>(&self, id: Id, what: &str, wanted: &str) -> Result<T, PickleError> {
        Err(PickleError(format!("{what} is a {}, must be a {wanted}", self.kind(id))))
    }
}
