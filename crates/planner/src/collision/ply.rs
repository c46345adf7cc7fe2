//! Point clouds from PLY files: ASCII, and binary of either byte order; skips everything but vertices.

use glamx::DVec3;

/// Maximum number of points.
pub const MAX_POINTS: usize = 20_000_000;

/// Why a file is not a usable point cloud.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("not a PLY point cloud: {0}")]
pub struct PlyError(String);

fn bad<T>(why: impl Into<String>) -> Result<T, PlyError> {
    Err(PlyError(why.into()))
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Format {
    Ascii,
    Little,
    Big,
}

/// Reads the vertices of a PLY file [m]; drops those that are not finite.
pub fn read(data: &[u8]) -> Result<Vec<DVec3>, PlyError> {
    let (header, body) = header(data)?;
    let fields: Vec<(usize, char)> = header.properties.iter().map(|(_, kind)| *kind).collect();
    let index = |name: &str| {
        let at = header.properties.iter().position(|(n, _)| n == name);
        at.ok_or_else(|| PlyError(format!("vertices have no property {name:?}")))
    };
    let wanted = [index("x")?, index("y")?, index("z")?];
    let mut points = match header.format {
        Format::Ascii => ascii(body, header.count, fields.len(), wanted)?,
        format => binary(body, header.count, &fields, wanted, format == Format::Little)?,
    };
    points.retain(|p| p.is_finite());
    Ok(points)
}

struct Header {
    format: Format,
    count: usize,
    /// Name, and (size in bytes, 'f'loat, 'i'nteger or 'u'nsigned) of each property of a vertex.
    properties: Vec<(String, (usize, char))>,
}

fn header(data: &[u8]) -> Result<(Header, &[u8]), PlyError> {
    let mut rest = data;
    let mut header = Header { format: Format::Ascii, count: 0, properties: Vec::new() };
    let (mut element, mut elements, mut format) = (String::new(), 0, None);
    for number in 0..1000 {
        let Some(end) = rest.iter().position(|b| *b == b'\n') else { return bad("the header does not end") };
        let line = String::from_utf8_lossy(&rest[..end]);
        let words: Vec<&str> = line.split_whitespace().collect();
        rest = &rest[end + 1..];
        match words.as_slice() {
            ["ply"] if number == 0 => {}
            _ if number == 0 => return bad("does not begin with \"ply\""),
            ["format", name, _] => {
                format = Some(match *name {
                    "ascii" => Format::Ascii,
                    "binary_little_endian" => Format::Little,
                    "binary_big_endian" => Format::Big,
                    other => return bad(format!("format {other:?} is not supported")),
                });
            }
            ["element", name, count] => {
                elements += 1;
                if *name == "vertex" {
                    if elements > 1 {
                        return bad("the first element is not `vertex`");
                    }
                    header.count = count.parse().map_err(|_| PlyError(format!("{count:?} is not a count")))?;
                }
                element = (*name).to_owned();
            }
            ["property", "list", ..] if element == "vertex" => return bad("a vertex has a list property"),
            ["property", kind, name] if element == "vertex" => {
                let kind = match *kind {
                    "char" | "int8" => (1, 'i'),
                    "uchar" | "uint8" => (1, 'u'),
                    "short" | "int16" => (2, 'i'),
                    "ushort" | "uint16" => (2, 'u'),
                    "int" | "int32" => (4, 'i'),
                    "uint" | "uint32" => (4, 'u'),
                    "float" | "float32" => (4, 'f'),
                    "double" | "float64" => (8, 'f'),
                    other => return bad(format!("type {other:?} is not supported")),
                };
                header.properties.push(((*name).to_owned(), kind));
            }
            ["end_header"] => {
                let Some(format) = format else { return bad("no format line") };
                if header.count > MAX_POINTS {
                    return bad(format!("{} points (limit {MAX_POINTS})", header.count));
                }
                return Ok((Header { format, ..header }, rest));
            }
            _ => {}
        }
    }
    bad("the header is longer than 1000 lines")
}

fn ascii(body: &[u8], count: usize, fields: usize, wanted: [usize; 3]) -> Result<Vec<DVec3>, PlyError> {
    let text = String::from_utf8_lossy(body);
    let mut lines = text.lines().filter(|l| !l.trim().is_empty());
    let mut points = Vec::with_capacity(count.min(body.len()));
    for number in 0..count {
        let Some(line) = lines.next() else { return bad(format!("the file ends after {number} of {count} points")) };
        let words: Vec<&str> = line.split_whitespace().collect();
        let value = |i: usize| words.get(i).and_then(|w| w.parse::<f64>().ok());
        match (words.len() >= fields, value(wanted[0]), value(wanted[1]), value(wanted[2])) {
            (true, Some(x), Some(y), Some(z)) => points.push(DVec3::new(x, y, z)),
            _ => return bad(format!("point {number} is not a point: {:?}", line.chars().take(60).collect::<String>())),
        }
    }
    Ok(points)
}

fn binary(
    body: &[u8],
    count: usize,
    fields: &[(usize, char)],
    wanted: [usize; 3],
    little: bool,
) -> Result<Vec<DVec3>, PlyError> {
    let size: usize = fields.iter().map(|f| f.0).sum();
    if body.len() / size.max(1) < count {
        return bad(format!("the file ends after {} of {count} points", body.len() / size.max(1)));
    }
    let offset = |field: usize| fields[..field].iter().map(|f| f.0).sum::<usize>();
    let [x, y, z] = wanted.map(|field| (offset(field), fields[field]));
    let value = |record: &[u8], (at, kind): (usize, (usize, char))| {
        let from = &record[at..];
        match kind {
            (4, 'f') => f64::from(f32::from_le_bytes(bytes(from, little))),
            (_, 'f') => f64::from_le_bytes(bytes(from, little)),
            (1, 'i') => f64::from(i8::from_le_bytes(bytes(from, little))),
            (2, 'i') => f64::from(i16::from_le_bytes(bytes(from, little))),
            (_, 'i') => f64::from(i32::from_le_bytes(bytes(from, little))),
            (1, _) => f64::from(u8::from_le_bytes(bytes(from, little))),
            (2, _) => f64::from(u16::from_le_bytes(bytes(from, little))),
            _ => f64::from(u32::from_le_bytes(bytes(from, little))),
        }
    };
    let point = |record: &[u8]| DVec3::new(value(record, x), value(record, y), value(record, z));
    Ok(body.chunks_exact(size.max(1)).take(count).map(point).collect())
}

/// Returns the first bytes of a value, the lowest first.
fn bytes<const N: usize>(from: &[u8], little: bool) -> [u8; N] {
    let mut bytes = [0; N];
    bytes.copy_from_slice(&from[..N]);
    if !little {
        bytes.reverse();
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "comment made by hand\nelement vertex 2\nproperty float x\nproperty double y\nproperty uchar red\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n";
    const EXPECTED: [DVec3; 2] = [DVec3::new(0.5, -0.25, 4.0), DVec3::new(1.5, 2.0, -8.0)];

    #[test]
    fn all_three_formats_give_the_same_points() {
        let ascii = format!("ply\nformat ascii 1.0\n{HEADER}0.5 -0.25 200 4\n1.5 2 0 -8\n3 0 1 1\n");
        assert_eq!(read(ascii.as_bytes()).unwrap(), EXPECTED);
        for little in [true, false] {
            let name = if little { "binary_little_endian" } else { "binary_big_endian" };
            let mut data = format!("ply\nformat {name} 1.0\n{HEADER}").into_bytes();
            for p in EXPECTED {
                let parts = [(p.x as f32).to_le_bytes().to_vec(), p.y.to_le_bytes().to_vec(), vec![200]];
                for mut part in parts.into_iter().chain([(p.z as f32).to_le_bytes().to_vec()]) {
                    if !little {
                        part.reverse();
                    }
                    data.extend(part);
                }
            }
            assert_eq!(read(&data).unwrap(), EXPECTED, "{name}");
        }
    }

    #[test]
    fn every_type_is_read_in_either_byte_order() {
        let types: [(&str, &[u8], f64); 8] = [
            ("char", &(-3_i8).to_be_bytes(), -3.0),
            ("uchar", &[253], 253.0),
            ("short", &(-300_i16).to_be_bytes(), -300.0),
            ("ushort", &65_000_u16.to_be_bytes(), 65_000.0),
            ("int", &(-70_000_i32).to_be_bytes(), -70_000.0),
            ("uint", &4_000_000_000_u32.to_be_bytes(), 4e9),
            ("float", &(-0.5_f32).to_be_bytes(), -0.5),
            ("double", &0.1_f64.to_be_bytes(), 0.1),
        ];
        for (name, value, expected) in types {
            for order in ["little", "big"] {
                let mut value = value.to_vec();
                if order == "little" {
                    value.reverse();
                }
                let properties = ["x", "y", "z"].map(|axis| format!("property {name} {axis}\n")).concat();
                let header =
                    format!("ply\nformat binary_{order}_endian 1.0\nelement vertex 1\n{properties}end_header\n");
                let data = [header.into_bytes(), value.repeat(3)].concat();
                assert_eq!(read(&data).unwrap(), [DVec3::splat(expected)], "{name}, {order}");
            }
        }
    }

    #[test]
    fn a_damaged_file_gives_an_error() {
        let whole = format!("ply\nformat ascii 1.0\n{HEADER}0.5 -0.25 200 4\n1.5 2 0 -8\n");
        for end in 0..whole.len() - 8 {
            assert!(read(&whole.as_bytes()[..end]).is_err(), "{end}");
        }
        let many = "ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n";
        assert!(read(many.as_bytes()).unwrap_err().to_string().contains("limit"));
        assert!(read(b"solid cube\n").unwrap_err().to_string().contains("begin"));
    }
}
