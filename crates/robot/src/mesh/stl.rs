//! STL, as binary or text. The length of a file decides which, not its first word: many binary files begin with `solid`
//! too.

use nalgebra::Point3;

use super::stored_as::text;

/// Length of the header of a binary file, with the number of triangles [bytes].
const HEADER: usize = 84;
/// Length of a triangle in a binary file: its normal, its corners, and two bytes that mean nothing [bytes].
const TRIANGLE: usize = 50;
/// Length of the start of a file in which text is recognized [bytes].
const START: usize = 512;

type Triangle = [Point3<f64>; 3];

/// Reads the triangles of a file.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<Triangle>, String> {
    let length = bytes.len() as u64;
    let declared = bytes.get(80..HEADER).and_then(|count| <[u8; 4]>::try_from(count).ok()).map(u32::from_le_bytes);
    let expected = declared.map(|count| HEADER as u64 + TRIANGLE as u64 * u64::from(count));
    let triangles = expected.and_then(|expected| bytes.split_at_checked(usize::try_from(expected).ok()?));
    // Some exporters end the file with a line break.
    if let Some((whole, b"" | b"\n" | b"\r\n")) = triangles {
        return Ok(whole[HEADER..].chunks_exact(TRIANGLE).map(binary).collect());
    }
    if let Some(text) = solid(bytes) {
        return facets(&text);
    }
    // A truncated or padded file would be read as another, smaller or larger mesh.
    let (Some(declared), Some(expected)) = (declared, expected) else {
        return Err(format!("the file is truncated: {length} bytes are less than the header of an STL file"));
    };
    let what = if length < expected { "truncated or not STL" } else { "damaged" };
    Err(format!(
        "the file is {what}: its header declares {declared} triangles ({expected} bytes), it has {length} bytes"
    ))
}

/// Returns the corners of a triangle in a binary file.
fn binary(triangle: &[u8]) -> Triangle {
    let float = |at: usize| {
        let bytes = triangle.get(at..).and_then(|rest| rest.first_chunk()).copied();
        f64::from(f32::from_le_bytes(bytes.unwrap_or_default()))
    };
    [12, 24, 36].map(|corner| Point3::new(float(corner), float(corner + 4), float(corner + 8)))
}

/// Returns a file as text if it begins with `solid`, and its start has no bytes that text does not have.
fn solid(bytes: &[u8]) -> Option<String> {
    let text = text(bytes);
    let begin = text.trim_start();
    let begins = begin.get(..5).is_some_and(|word| word.eq_ignore_ascii_case("solid"));
    let ends = begin.get(5..)?.chars().next().is_none_or(char::is_whitespace);
    let is_text = |byte: &u8| *byte >= b' ' || byte.is_ascii_whitespace();
    let start = &text.as_bytes()[..text.len().min(START)];
    (begins && ends && start.iter().all(is_text)).then(|| text.into_owned())
}

/// Reads the facets of a text: a sequence of words, however they are spread over lines. The rest of a line with `solid`
/// or `endsolid` is a name.
fn facets(text: &str) -> Result<Vec<Triangle>, String> {
    let (mut triangles, mut corners, mut open) = (Vec::new(), Vec::new(), false);
    for (number, line) in text.split('\n').enumerate().flat_map(|(n, line)| line.split('\r').map(move |l| (n + 1, l))) {
        let wrong = |what: String| Err(format!("line {number}: {what}"));
        let mut words = line.split_whitespace();
        while let Some(word) = words.next() {
            match word.to_ascii_lowercase().as_str() {
                "vertex" => {
                    let values: Vec<f32> = words.by_ref().take(3).map_while(|word| word.parse().ok()).collect();
                    let [x, y, z] = values[..] else { return wrong("a vertex takes three numbers".to_owned()) };
                    corners.push(Point3::new(x, y, z).map(f64::from));
                }
                "endfacet" => match <Triangle>::try_from(std::mem::take(&mut corners)) {
                    Ok(triangle) => triangles.push(triangle),
                    Err(corners) => return wrong(format!("a facet with {} vertices, not 3", corners.len())),
                },
                "facet" | "endsolid" if !corners.is_empty() => return wrong("a facet without `endfacet`".to_owned()),
                "solid" | "endsolid" => {
                    open = word.eq_ignore_ascii_case("solid");
                    break;
                }
                _ => {}
            }
        }
    }
    match open {
        true => Err("the file is truncated: it has no `endsolid`".to_owned()),
        false => Ok(triangles),
    }
}
