//! Writes Parquet files: columns of numbers and texts, and lists of them, without missing values; plain, uncompressed.
//!
//! A file is the magic `PAR1`, one page for each column of each group of rows, and a footer in Thrift's compact form
//! (<https://parquet.apache.org/docs/file-format/>).

use std::io::{self, Write};

const MAGIC: &[u8] = b"PAR1";
/// Rows of a group: a column of it is 512 kB.
pub const GROUP: usize = 65_536;

/// The values of a column, row by row.
#[derive(Debug, Clone, PartialEq)]
pub enum Column {
    /// Numbers; NaN is unknown.
    Numbers(Vec<f64>),
    /// Short numbers.
    Floats(Vec<f32>),
    /// Whole numbers.
    Integers(Vec<i64>),
    /// Texts.
    Texts(Vec<String>),
    /// Lists of short numbers, all of this length.
    Lists(usize, Vec<f32>),
    /// Lists of one text.
    TextLists(Vec<String>),
}

impl Column {
    /// Returns the number of rows.
    fn rows(&self) -> usize {
        match self {
            Self::Numbers(list) => list.len(),
            Self::Floats(list) => list.len(),
            Self::Integers(list) => list.len(),
            Self::Texts(list) | Self::TextLists(list) => list.len(),
            Self::Lists(length, list) => list.len() / (*length).max(1),
        }
    }

    /// Returns the number of values in a row, if a row is a list.
    fn list(&self) -> Option<usize> {
        match self {
            Self::Lists(length, _) => Some(*length),
            Self::TextLists(_) => Some(1),
            _ => None,
        }
    }

    /// Returns the physical type: INT64 2, FLOAT 4, DOUBLE 5, BYTE_ARRAY 6.
    fn kind(&self) -> i64 {
        match self {
            Self::Integers(_) => 2,
            Self::Floats(_) | Self::Lists(..) => 4,
            Self::Numbers(_) => 5,
            Self::Texts(_) | Self::TextLists(_) => 6,
        }
    }

    fn clear(&mut self) {
        match self {
            Self::Numbers(list) => list.clear(),
            Self::Floats(list) | Self::Lists(_, list) => list.clear(),
            Self::Integers(list) => list.clear(),
            Self::Texts(list) | Self::TextLists(list) => list.clear(),
        }
    }

    /// Returns the contents of its page.
    fn page(&self) -> Vec<u8> {
        let mut page = Vec::new();
        if let Some(length) = self.list() {
            // Runs of levels: each list begins with repetition level 0, its other values have 1; all are defined.
            let mut repeated = Vec::new();
            for _ in 0..self.rows() {
                run(&mut repeated, 1, 0);
                run(&mut repeated, length - 1, 1);
            }
            let mut defined = Vec::new();
            run(&mut defined, self.rows() * length, 1);
            for levels in [repeated, defined] {
                page.extend((levels.len() as u32).to_le_bytes());
                page.extend(levels);
            }
        }
        match self {
            Self::Numbers(list) => list.iter().for_each(|v| page.extend(v.to_le_bytes())),
            Self::Floats(list) | Self::Lists(_, list) => list.iter().for_each(|v| page.extend(v.to_le_bytes())),
            Self::Integers(list) => list.iter().for_each(|v| page.extend(v.to_le_bytes())),
            Self::Texts(list) | Self::TextLists(list) => list.iter().for_each(|text| {
                page.extend((text.len() as u32).to_le_bytes());
                page.extend(text.as_bytes());
            }),
        }
        page
    }
}

/// Appends a run of a level of one bit.
fn run(out: &mut Vec<u8>, length: usize, level: u8) {
    if length > 0 {
        varint(out, (length as u64) << 1);
        out.push(level);
    }
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// A struct in Thrift's compact form. Fields are added in the order of their numbers.
#[derive(Default)]
struct Thrift {
    bytes: Vec<u8>,
    last: u8,
}

/// Types of fields.
const I32: u8 = 5;
const I64: u8 = 6;
const BINARY: u8 = 8;
const LIST: u8 = 9;
const STRUCT: u8 = 12;

impl Thrift {
    fn field(&mut self, number: u8, kind: u8) -> &mut Vec<u8> {
        self.bytes.push((number - self.last) << 4 | kind);
        self.last = number;
        &mut self.bytes
    }

    fn number(mut self, number: u8, kind: u8, value: i64) -> Self {
        varint(self.field(number, kind), ((value << 1) ^ (value >> 63)) as u64);
        self
    }

    fn text(mut self, number: u8, text: &str) -> Self {
        binary(self.field(number, BINARY), text);
        self
    }

    fn inner(mut self, number: u8, inner: Self) -> Self {
        let inner = inner.end();
        self.field(number, STRUCT).extend(inner);
        self
    }

    /// Adds a list of elements that are encoded already.
    fn list(mut self, number: u8, kind: u8, elements: &[Vec<u8>]) -> Self {
        let out = self.field(number, LIST);
        out.push(0xf0 | kind);
        varint(out, elements.len() as u64);
        elements.iter().for_each(|element| out.extend(element));
        self
    }

    fn end(mut self) -> Vec<u8> {
        self.bytes.push(0);
        self.bytes
    }
}

fn binary(out: &mut Vec<u8>, text: &str) {
    varint(out, text.len() as u64);
    out.extend(text.as_bytes());
}

/// A file that is written a group of rows at a time.
pub struct ParquetWriter<W> {
    out: W,
    at: usize,
    names: Vec<String>,
    /// Values of the rows that are not written yet.
    pub columns: Vec<Column>,
    groups: Vec<Vec<u8>>,
    rows: usize,
}

impl<W: Write> ParquetWriter<W> {
    /// Begins a file with these columns, which are empty.
    pub fn new(mut out: W, columns: Vec<(String, Column)>) -> io::Result<Self> {
        out.write_all(MAGIC)?;
        let (names, columns) = columns.into_iter().unzip();
        Ok(Self { out, at: MAGIC.len(), names, columns, groups: Vec::new(), rows: 0 })
    }

    /// Returns the number of rows so far.
    pub fn rows(&self) -> usize {
        self.rows + self.waiting()
    }

    fn waiting(&self) -> usize {
        self.columns.first().map_or(0, Column::rows)
    }

    /// Writes the rows so far if they make a group. Call it after each row.
    pub fn row_added(&mut self) -> io::Result<()> {
        if self.waiting() >= GROUP { self.write_group() } else { Ok(()) }
    }

    fn write_group(&mut self) -> io::Result<()> {
        let (rows, start) = (self.waiting(), self.at);
        let mut chunks = Vec::new();
        for (name, column) in self.names.iter().zip(&mut self.columns) {
            let page = column.page();
            let values = (rows * column.list().unwrap_or(1)) as i64;
            // Plain values, and levels as runs.
            let data = Thrift::default().number(1, I32, values).number(2, I32, 0).number(3, I32, 3).number(4, I32, 3);
            let length = page.len() as i64;
            let header = Thrift::default().number(1, I32, 0).number(2, I32, length).number(3, I32, length);
            let header = header.inner(5, data).end();
            self.out.write_all(&header)?;
            self.out.write_all(&page)?;
            let (at, size) = (self.at as i64, (header.len() + page.len()) as i64);
            self.at += size as usize;
            let mut path = vec![name.as_str()];
            path.extend(column.list().map(|_| ["list", "element"]).into_iter().flatten());
            let path = path.into_iter().map(|part| {
                let mut bytes = Vec::new();
                binary(&mut bytes, part);
                bytes
            });
            let about = Thrift::default()
                .number(1, I32, column.kind())
                // Encodings: plain, runs.
                .list(2, I32, &[vec![0], vec![6]])
                .list(3, BINARY, &path.collect::<Vec<_>>())
                .number(4, I32, 0)
                .number(5, I64, values)
                .number(6, I64, size)
                .number(7, I64, size)
                .number(9, I64, at);
            chunks.push(Thrift::default().number(2, I64, at).inner(3, about).end());
            column.clear();
        }
        let size = (self.at - start) as i64;
        let group = Thrift::default().list(1, STRUCT, &chunks).number(2, I64, size).number(3, I64, rows as i64);
        self.groups.push(group.end());
        self.rows += rows;
        Ok(())
    }

    /// Writes the rest and the footer, with further metadata. Returns the number of rows.
    pub fn finish(mut self, metadata: &[(&str, String)]) -> io::Result<usize> {
        if self.waiting() > 0 {
            self.write_group()?;
        }
        // Repetition: required 0, repeated 2. Converted types: text 0, list 3.
        let group = |name: &str, children: i64| Thrift::default().text(4, name).number(5, I32, children);
        let mut schema = vec![group("schema", self.names.len() as i64).end()];
        for (name, column) in self.names.iter().zip(&self.columns) {
            let value = |name: &str| {
                let value = Thrift::default().number(1, I32, column.kind()).number(3, I32, 0).text(4, name);
                if column.kind() == 6 { value.number(6, I32, 0) } else { value }.end()
            };
            if column.list().is_some() {
                let of = |repetition, name: &str| {
                    Thrift::default().number(3, I32, repetition).text(4, name).number(5, I32, 1)
                };
                schema.extend([of(0, name).number(6, I32, 3).end(), of(2, "list").end(), value("element")]);
            } else {
                schema.push(value(name));
            }
        }
        let pairs: Vec<_> = metadata.iter().map(|(k, v)| Thrift::default().text(1, k).text(2, v).end()).collect();
        let footer = Thrift::default()
            .number(1, I32, 1)
            .list(2, STRUCT, &schema)
            .number(3, I64, self.rows as i64)
            .list(4, STRUCT, &self.groups);
        let footer = if pairs.is_empty() { footer } else { footer.list(5, STRUCT, &pairs) };
        let footer = footer.text(6, concat!("dimos version ", env!("CARGO_PKG_VERSION"))).end();
        self.out.write_all(&footer)?;
        self.out.write_all(&(footer.len() as u32).to_le_bytes())?;
        self.out.write_all(MAGIC)?;
        self.out.flush()?;
        Ok(self.rows)
    }
}
