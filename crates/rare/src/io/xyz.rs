//! Points as text, one per line: XYZ, TXT, CSV, ASC and PTS files.
//!
//! There is no standard, so the layout is found out: the delimiter from the first line of numbers, the columns from a
//! line of names if there is one (otherwise the first three), and the leading count of a PTS file from its standing
//! alone. Blank lines and comments (`#`, `//`, `%`) are passed over.

use std::io::{self, Write};

use nalgebra::Point3;

use super::text::{Line, lines, parse_number, quoted};
use crate::error::{Error, Result};

/// The points of a text file.
///
/// # Errors
/// `InvalidInput` with line and column of the first word that should be a number and is none.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<Point3<f64>>> {
    let text = as_text(bytes)?;
    let layout = Layout::of(text)?;
    let points = read_lines(text, &layout)?;
    match layout.count {
        Some(count) if count != points.len() => Err(Error::invalid(format!(
            "the first line promises {count} points, {} follow: the file is cut off or damaged",
            points.len()
        ))),
        _ => Ok(points),
    }
}

/// The bytes after a UTF-8 byte order mark, if they can be text at all.
fn as_text(bytes: &[u8]) -> Result<&[u8]> {
    if matches!(bytes, [0xff, 0xfe, ..] | [0xfe, 0xff, ..]) {
        return Err(Error::invalid("the text is in UTF-16: save it as UTF-8"));
    }
    if bytes.contains(&0) {
        return Err(Error::invalid(
            "this is no text, it has zero bytes: check the file's format and name",
        ));
    }
    Ok(bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes))
}

/// How the file is laid out.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Layout {
    delimiter: Option<u8>,
    /// The words that are x, y and z.
    columns: [usize; 3],
    /// The number of points that a PTS file begins with.
    count: Option<usize>,
    /// The number of the first line that holds a point.
    first: usize,
}

impl Layout {
    fn of(text: &[u8]) -> Result<Layout> {
        let (mut names, mut count) = (None, None);
        for line in lines(text).filter(|line| !line.is_blank()) {
            let delimiter = delimiter_of(line);
            if let Some(comment) = comment(line) {
                names = Some(comment);
            } else if names_columns(line, delimiter) {
                names = Some(line);
            } else if let (None, Some(alone)) = (count, lone_count(line, delimiter)) {
                count = Some(alone);
            } else {
                let columns = names.and_then(|names| named_columns(names, line, delimiter));
                let columns = columns.unwrap_or([0, 1, 2]);
                return Ok(Layout { delimiter, columns, count, first: line.number });
            }
        }
        Err(Error::invalid("there is no line of numbers in the file: a line needs x, y and z"))
    }
}

/// What a comment says, `None` for a line that is none.
fn comment(line: Line<'_>) -> Option<Line<'_>> {
    let text = line.bytes.trim_ascii_start();
    let said = [&b"#"[..], b"//", b"%"].into_iter().find_map(|mark| text.strip_prefix(mark))?;
    Some(Line { number: line.number, bytes: said })
}

fn delimiter_of(line: Line<'_>) -> Option<u8> {
    [b';', b','].into_iter().find(|delimiter| line.bytes.contains(delimiter))
}

/// Whether a line holds names: several words, none a number (as `nan` is) or the like of one (as `1,5` is).
fn names_columns(line: Line<'_>, delimiter: Option<u8>) -> bool {
    let is_name = |word: &[u8]| {
        !word.first().is_some_and(|byte| b"+-.,0123456789".contains(byte))
            && parse_number(word).is_none()
    };
    line.words(delimiter).count() >= 3 && line.words(delimiter).all(|word| is_name(word.bytes))
}

fn lone_count(line: Line<'_>, delimiter: Option<u8>) -> Option<usize> {
    let mut words = line.words(delimiter);
    let word = words.next()?;
    if words.next().is_some() {
        return None;
    }
    std::str::from_utf8(word.bytes).ok()?.parse().ok()
}

/// The columns that `names` calls x, y and z, if it has a name for each word of `line`.
fn named_columns(names: Line<'_>, line: Line<'_>, delimiter: Option<u8>) -> Option<[usize; 3]> {
    let own = delimiter_of(names).or(delimiter);
    let named: Vec<String> = names.words(own).map(|word| column_name(word.bytes)).collect();
    if named.len() != line.words(delimiter).count() {
        return None;
    }
    let find = |name: &str| named.iter().position(|given| given == name);
    Some([find("x")?, find("y")?, find("z")?])
}

/// A column's name in lower case, without quotes or a unit: `"X"`, `x[m]` and `X` are all `x`.
fn column_name(word: &[u8]) -> String {
    let name = String::from_utf8_lossy(word).to_ascii_lowercase();
    let name = name.trim_matches(['"', '\'']);
    name.split(['[', '(']).next().unwrap_or(name).to_owned()
}

fn read_lines(text: &[u8], layout: &Layout) -> Result<Vec<Point3<f64>>> {
    let mut points = Vec::new();
    for line in lines(text).skip(layout.first - 1) {
        if line.is_blank() || comment(line).is_some() {
            continue;
        }
        let point = line
            .point(layout.delimiter, &layout.columns)
            .map_err(|error| explain_decimal_comma(error, line, layout.delimiter))?;
        if points.is_empty() {
            // As if all lines were as long as the first, but never more than a line of "0 0 0" would give.
            points.reserve(text.len() / (line.bytes.len() + 1).max(6) + 1);
        }
        points.push(point);
    }
    Ok(points)
}

/// `1,5;2,5;3,5` is how some spreadsheets write numbers: say so instead of calling them wrong.
fn explain_decimal_comma(error: Error, line: Line<'_>, delimiter: Option<u8>) -> Error {
    if delimiter == Some(b';') && line.bytes.contains(&b',') {
        return Error::invalid(format!(
            "{error} (decimal commas in {}? write points instead)",
            quoted(line.bytes)
        ));
    }
    error
}

/// Writes one point per line, its coordinates with as many digits as reading them back exactly needs.
pub(super) fn write(writer: &mut dyn Write, points: &[Point3<f64>]) -> io::Result<()> {
    points.iter().try_for_each(|point| writeln!(writer, "{} {} {}", point.x, point.y, point.z))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(text: &str) -> Vec<[f64; 3]> {
        read(text.as_bytes()).unwrap().into_iter().map(|point| point.coords.into()).collect()
    }

    fn message(text: &str) -> String {
        read(text.as_bytes()).unwrap_err().to_string()
    }

    #[test]
    fn delimiters_comments_and_names_are_found_out() {
        let expected = [[1.0, 2.5, -3.0], [4.0, 5.0, 6e-1]];
        for text in [
            "1 2.5 -3\n4 5 6e-1\n",
            "1\t2.5\t-3\r\n4\t5\t6e-1",
            "1,2.5,-3\n4, 5, 6e-1,\n",
            "1;2.5;-3\n4 ; 5 ; 6e-1\n",
            "# made by hand\n\n1 2.5 -3 255 0 0\n// a remark\n4 5 6e-1 0 0 0\n",
            "x,y,z\n1,2.5,-3\n4,5,6e-1\n",
            "Intensity;\"Z\";X[m];Y[m]\n9;-3;1;2.5\n9;6e-1;4;5\n",
            "# time x y z\n0.1 1 2.5 -3\n0.2 4 5 6e-1\n",
            "//X Y Z R G B\n1 2.5 -3 1 2 3\n4 5 6e-1 1 2 3\n",
            "2\n1 2.5 -3 0 1 2 3\n4 5 6e-1 0 1 2 3\n",
            "\u{feff}1 2.5 -3\n4 5 6e-1\n",
        ] {
            assert_eq!(points(text), expected, "{text:?}");
        }
    }

    #[test]
    fn what_is_wrong_is_named_with_its_place() {
        for (text, part) in [
            ("1 2 3\n4 five 6\n", "line 2, column 3: \"five\" is not a number"),
            ("1,2,3\n4,,6\n", "line 2, column 3: \"\" is not a number"),
            ("1 2 3\n4 5\n", "line 2 has 2 columns, the coordinates need 3"),
            ("1,5;2,5;3,5\n", "decimal commas"),
            ("3\n1 2 3\n4 5 6\n", "promises 3 points, 2 follow"),
            ("# nothing\n\n", "no line of numbers"),
            ("1 2 3\0\n", "zero bytes"),
            ("lorem ipsum dolor\nsit amet\n", "\"sit\" is not a number"),
        ] {
            let message = message(text);
            assert!(message.contains(part), "{text:?}: {message}");
        }
        assert!(read(b"\xff\xfe1\0").unwrap_err().to_string().contains("UTF-16"));
    }
}
