//! Reads pickles without executing anything: the classes that they name stay names, and only a few are accepted.
//!
//! A pickle is a program for a stack machine. This one only collects values in a list of nodes that refer to each other
//! by index. So an object that occurs a thousand times is one node, values that contain themselves are no trouble, and
//! the work is proportional to the bytes.

use super::pickle_node::{Class, Id, Node, Pickled};

/// Largest pickle [bytes].
pub const MAX_BYTES: usize = 16 << 20;
/// Largest number of values in a pickle, and in its memo.
const MAX_NODES: usize = 1 << 18;
/// Largest number of values in lists, tuples and dicts, counted for each list that has them, and on the stack.
const MAX_ITEMS: usize = 1 << 20;
/// Largest number of lists that have begun and not ended.
const MAX_DEPTH: usize = 1 << 10;
/// Highest protocol: its opcodes for values are those of protocol 4.
const MAX_PROTOCOL: u8 = 5;

/// Why a pickle was refused, for people.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct PickleError(pub String);

fn refused<T>(what: impl Into<String>) -> Result<T, PickleError> {
    Err(PickleError(what.into()))
}

/// Reads a pickle. Fails on opcodes and classes that calls of a coordinator do not need, and beyond the bounds.
pub fn read(bytes: &[u8]) -> Result<Pickled<'_>, PickleError> {
    if bytes.len() > MAX_BYTES {
        return refused(format!("the pickle has {} bytes (limit {MAX_BYTES})", bytes.len()));
    }
    let mut machine =
        Machine { bytes, at: 0, nodes: Vec::new(), stack: Vec::new(), marks: Vec::new(), memo: Vec::new(), items: 0 };
    let root = machine.run()?;
    Ok(Pickled { nodes: machine.nodes, root })
}

struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    nodes: Vec<Node<'a>>,
    stack: Vec<Id>,
    /// Heights of the stack at the marks.
    marks: Vec<usize>,
    memo: Vec<Id>,
    /// Values that lists, tuples and dicts have together.
    items: usize,
}

impl<'a> Machine<'a> {
    fn run(&mut self) -> Result<Id, PickleError> {
        loop {
            let start = self.at;
            let [opcode] = self.take_array()?;
            match opcode {
                // PROTO
                0x80 => {
                    let [protocol] = self.take_array()?;
                    if protocol > MAX_PROTOCOL {
                        return refused(format!("the pickle has protocol {protocol} (limit {MAX_PROTOCOL})"));
                    }
                }
                // FRAME: says how much may be read at once.
                0x95 => drop(self.take(8)?),
                // STOP
                b'.' => return self.pop(),
                // MARK
                b'(' if self.marks.len() < MAX_DEPTH => self.marks.push(self.stack.len()),
                b'(' => return refused(format!("the lists of the pickle are nested more than {MAX_DEPTH} deep")),
                b'N' => self.push(Node::None)?,
                // NEWTRUE, NEWFALSE
                0x88 => self.push(Node::Bool(true))?,
                0x89 => self.push(Node::Bool(false))?,
                // BININT, BININT1, BININT2, LONG1
                b'J' => {
                    let value = i32::from_le_bytes(self.take_array()?);
                    self.push(Node::Int(value.into()))?;
                }
                b'K' => {
                    let [value] = self.take_array()?;
                    self.push(Node::Int(value.into()))?;
                }
                b'M' => {
                    let value = u16::from_le_bytes(self.take_array()?);
                    self.push(Node::Int(value.into()))?;
                }
                0x8a => self.long()?,
                // BINFLOAT
                b'G' => {
                    let value = f64::from_be_bytes(self.take_array()?);
                    self.push(Node::Float(value))?;
                }
                // SHORT_BINUNICODE, BINUNICODE
                0x8c => self.text(1)?,
                b'X' => self.text(4)?,
                // SHORT_BINBYTES, BINBYTES: the values of numpy's numbers
                b'C' => self.binary(1)?,
                b'B' => self.binary(4)?,
                b']' => self.push(Node::List(Vec::new()))?,
                b'}' => self.push(Node::Dict(Vec::new()))?,
                b')' => self.push(Node::Tuple(Vec::new()))?,
                // TUPLE1, TUPLE2, TUPLE3, TUPLE
                0x85..=0x87 => {
                    let values = self.pop_many(usize::from(opcode - 0x84))?;
                    self.push_tuple(values)?;
                }
                b't' => {
                    let values = self.pop_to_mark()?;
                    self.push_tuple(values)?;
                }
                // APPEND, APPENDS
                b'a' => {
                    let value = self.pop_many(1)?;
                    self.append(value)?;
                }
                b'e' => {
                    let values = self.pop_to_mark()?;
                    self.append(values)?;
                }
                // SETITEM, SETITEMS
                b's' => {
                    let entry = self.pop_many(2)?;
                    self.set_items(&entry)?;
                }
                b'u' => {
                    let entries = self.pop_to_mark()?;
                    self.set_items(&entries)?;
                }
                // MEMOIZE, BINPUT; BINGET, LONG_BINGET
                0x94 => {
                    let top = self.top()?;
                    self.put(self.memo.len(), top)?;
                }
                b'q' => {
                    let [number] = self.take_array()?;
                    let top = self.top()?;
                    self.put(number.into(), top)?;
                }
                b'h' => {
                    let [number] = self.take_array()?;
                    self.get(number.into())?;
                }
                b'j' => {
                    let number = u32::from_le_bytes(self.take_array()?);
                    self.get(number as usize)?;
                }
                // STACK_GLOBAL, NEWOBJ, REDUCE, BUILD
                0x93 => self.class()?,
                0x81 | b'R' => self.object()?,
                b'b' => self.build()?,
                _ => {
                    return refused(format!(
                        "the pickle has the opcode {opcode:#04x} at byte {start}, which is not accepted"
                    ));
                }
            }
        }
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], PickleError> {
        let end = self.at.checked_add(count).filter(|end| *end <= self.bytes.len());
        let Some(taken) = end.and_then(|end| self.bytes.get(self.at..end)) else {
            return refused("the pickle ends early");
        };
        self.at += count;
        Ok(taken)
    }

    fn take_array<const N: usize>(&mut self) -> Result<[u8; N], PickleError> {
        let taken = self.take(N)?;
        taken.try_into().or_else(|_| refused("the pickle ends early"))
    }

    /// Takes bytes after their length, which has one byte or four.
    fn take_counted(&mut self, width: usize) -> Result<&'a [u8], PickleError> {
        let length = match width {
            1 => u32::from(self.take_array::<1>()?[0]),
            _ => u32::from_le_bytes(self.take_array()?),
        };
        self.take(length as usize)
    }

    fn push(&mut self, node: Node<'a>) -> Result<(), PickleError> {
        if self.nodes.len() >= MAX_NODES {
            return refused(format!("the pickle has more than {MAX_NODES} values"));
        }
        self.stack.push(self.nodes.len() as Id);
        self.nodes.push(node);
        Ok(())
    }

    fn top(&self) -> Result<Id, PickleError> {
        // What is below a mark belongs to what comes after its end.
        let floor = self.marks.last().copied().unwrap_or_default();
        match self.stack.last() {
            Some(top) if self.stack.len() > floor => Ok(*top),
            _ => refused("the pickle takes a value that is not there"),
        }
    }

    fn pop(&mut self) -> Result<Id, PickleError> {
        let top = self.top()?;
        self.stack.pop();
        Ok(top)
    }

    fn pop_many(&mut self, count: usize) -> Result<Vec<Id>, PickleError> {
        let floor = self.marks.last().copied().unwrap_or_default();
        match self.stack.len().checked_sub(count).filter(|start| *start >= floor) {
            Some(start) => Ok(self.stack.split_off(start)),
            None => refused("the pickle takes a value that is not there"),
        }
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Id>, PickleError> {
        match self.marks.pop() {
            Some(height) if height <= self.stack.len() => Ok(self.stack.split_off(height)),
            _ => refused("the pickle ends a list that has not begun"),
        }
    }

    fn count_items(&mut self, count: usize) -> Result<(), PickleError> {
        self.items += count;
        if self.items > MAX_ITEMS {
            return refused(format!("the lists of the pickle have more than {MAX_ITEMS} values"));
        }
        Ok(())
    }

    fn push_tuple(&mut self, values: Vec<Id>) -> Result<(), PickleError> {
        self.count_items(values.len())?;
        self.push(Node::Tuple(values))
    }

    fn append(&mut self, values: Vec<Id>) -> Result<(), PickleError> {
        self.count_items(values.len())?;
        let list = self.top()?;
        match self.nodes.get_mut(list as usize) {
            Some(Node::List(list)) => {
                list.extend(values);
                Ok(())
            }
            _ => refused("the pickle appends to what is no list"),
        }
    }

    fn set_items(&mut self, entries: &[Id]) -> Result<(), PickleError> {
        self.count_items(entries.len())?;
        let dict = self.top()?;
        match self.nodes.get_mut(dict as usize) {
            Some(Node::Dict(dict)) if entries.len().is_multiple_of(2) => {
                dict.extend(entries.chunks_exact(2).map(|entry| (entry[0], entry[1])));
                Ok(())
            }
            _ => refused("the pickle sets items of what is no dict"),
        }
    }

    fn put(&mut self, number: usize, value: Id) -> Result<(), PickleError> {
        let length = self.memo.len();
        match self.memo.get_mut(number) {
            Some(place) => *place = value,
            None if number >= MAX_NODES => return refused(format!("the memo has more than {MAX_NODES} values")),
            None if number == length => self.memo.push(value),
            None => return refused("the pickle leaves gaps in its memo"),
        }
        Ok(())
    }

    fn get(&mut self, number: usize) -> Result<(), PickleError> {
        match self.memo.get(number) {
            Some(_) if self.stack.len() >= MAX_ITEMS => {
                return refused(format!("the pickle has more than {MAX_ITEMS} values in one list"));
            }
            Some(value) => self.stack.push(*value),
            None => return refused("the pickle refers to a value that is not there"),
        }
        Ok(())
    }

    fn long(&mut self) -> Result<(), PickleError> {
        let bytes = self.take_counted(1)?;
        let Some(sign) = bytes.last() else { return self.push(Node::Int(0)) };
        let mut whole = if sign & 0x80 == 0 { [0; 8] } else { [0xff; 8] };
        match whole.get_mut(..bytes.len()) {
            Some(place) => place.copy_from_slice(bytes),
            None => return refused("the pickle has an integer of more than 64 bits"),
        }
        self.push(Node::Int(i64::from_le_bytes(whole)))
    }

    fn text(&mut self, width: usize) -> Result<(), PickleError> {
        match std::str::from_utf8(self.take_counted(width)?) {
            Ok(text) => self.push(Node::Text(text)),
            Err(_) => refused("the pickle has a string that is not UTF-8"),
        }
    }

    fn binary(&mut self, width: usize) -> Result<(), PickleError> {
        let bytes = self.take_counted(width)?;
        self.push(Node::Bytes(bytes))
    }

    fn class(&mut self) -> Result<(), PickleError> {
        let names = self.pop_many(2)?;
        let text = |id: &Id| match self.nodes.get(*id as usize) {
            Some(Node::Text(text)) => Ok(*text),
            _ => refused("the pickle names a class by what is no string"),
        };
        let [module, name] = [text(&names[0])?, text(&names[1])?];
        match Class::of(module, name) {
            Some(class) => self.push(Node::Class(class)),
            None => {
                let shown: String = format!("{module}.{name}").chars().take(120).collect();
                refused(format!("the pickle names {shown:?}, which is not accepted"))
            }
        }
    }

    fn object(&mut self) -> Result<(), PickleError> {
        let [class, arguments] = self.pop_many(2)?[..] else { return refused("the pickle ends early") };
        match (self.nodes.get(class as usize), self.nodes.get(arguments as usize)) {
            (Some(Node::Class(class)), Some(Node::Tuple(_))) => {
                let class = *class;
                self.push(Node::Object { class, arguments, state: None })
            }
            _ => refused("the pickle creates an object without class or arguments"),
        }
    }

    fn build(&mut self) -> Result<(), PickleError> {
        let built = self.pop()?;
        let object = self.top()?;
        match self.nodes.get_mut(object as usize) {
            Some(Node::Object { state, .. }) => {
                *state = Some(built);
                Ok(())
            }
            _ => refused("the pickle sets the state of what is no object"),
        }
    }
}
