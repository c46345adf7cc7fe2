//! OBJ: vertices and faces. Normals, textures, materials, groups and curves do not count.

use nalgebra::Point3;

use super::stored_as::text;

/// Reads the triangles of a file. Faces are assumed convex.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<[Point3<f64>; 3]>, String> {
    let text = joined(&text(bytes));
    let (mut points, mut faces) = (Vec::new(), Vec::new());
    for line in text.split(['\n', '\r']) {
        let wrong = || format!("unusable line {:?}", line.trim().chars().take(80).collect::<String>());
        let mut words = line.split_whitespace();
        match words.next() {
            Some("v") => points.push(vertex(words).ok_or_else(wrong)?),
            Some("f") => {
                faces.push(words.map(|word| index(word, points.len())).collect::<Option<Vec<_>>>().ok_or_else(wrong)?)
            }
            _ => {}
        }
    }
    let corner = |number: i64| match usize::try_from(number).ok().and_then(|number| number.checked_sub(1)) {
        Some(index) if index < points.len() => Ok(points[index]),
        None if number == 0 => Err("a face refers to vertex 0: the vertices of an OBJ file count from 1".to_owned()),
        _ => Err(format!("a face refers to vertex {number} of {}", points.len())),
    };
    let mut triangles = Vec::new();
    for face in &faces {
        let corners = face.iter().map(|number| corner(*number)).collect::<Result<Vec<_>, _>>()?;
        let Some((first, rest)) = corners.split_first() else { continue };
        triangles.extend(rest.windows(2).map(|pair| [*first, pair[0], pair[1]]));
    }
    Ok(triangles)
}

/// Returns the lines without comments. A line continues after a backslash at its end, but a comment does not.
fn joined(text: &str) -> String {
    let text = text.replace("\r\n", "\n");
    let lines = text.split(['\n', '\r']).map(|line| match line.split_once('#') {
        Some((before, _)) => format!("{before}\n"),
        None => line.strip_suffix('\\').map_or_else(|| format!("{line}\n"), |part| format!("{part} ")),
    });
    lines.collect()
}

/// Returns a vertex: x y z, homogeneous with a fourth number, with a colour after three or more.
fn vertex<'w>(words: impl Iterator<Item = &'w str>) -> Option<Point3<f64>> {
    let values: Vec<f32> = words.map(|word| word.parse().ok()).collect::<Option<_>>()?;
    let point = match values[..] {
        [x, y, z, w] if w != 0.0 => Point3::new(x / w, y / w, z / w),
        [_, _, _, _] => return None,
        [x, y, z, ..] => Point3::new(x, y, z),
        _ => return None,
    };
    Some(point.map(f64::from))
}

/// Returns the number of a face's vertex, from 1; a negative one counts from the last vertex so far. The vertex itself
/// may follow later.
fn index(word: &str, points: usize) -> Option<i64> {
    let number: i64 = word.split('/').next()?.parse().ok()?;
    if number >= 0 {
        return Some(number);
    }
    let from_end = points as i64 + 1 + number;
    // One before the first keeps the number that is written, for the message.
    Some(if from_end > 0 { from_end } else { number })
}
