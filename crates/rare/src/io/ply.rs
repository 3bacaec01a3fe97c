//! PLY: a text header that declares elements and their properties, then their records as text or binary.
//!
//! Of everything a file may hold only `x`, `y` and `z` of the element `vertex` are read, whatever their types and
//! places, and whatever other elements and lists stand around them. Format: G. Turk, "The PLY Polygon File Format",
//! 1994.

use std::io::{self, Write};

use nalgebra::Point3;

use super::scalar::{ByteOrder, Column, Scalar, fits_single, read_points};
use super::text::{Line, lines, quoted};
use crate::error::{Error, Result};

/// Whether a file with these bytes calls itself PLY.
pub(super) fn is_ply(bytes: &[u8]) -> bool {
    matches!(bytes, [b'p', b'l', b'y', b'\n' | b'\r', ..])
}

/// The vertices of a PLY file, in its units.
///
/// # Errors
/// `InvalidInput` that says what is wrong with the header or the first bad record.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<Point3<f64>>> {
    let header = Header::parse(bytes)?;
    let body = bytes.get(header.length..).unwrap_or_default();
    match header.encoding {
        Encoding::Text => read_text(&header, body),
        Encoding::Binary(order) => read_binary(&header, body, order),
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Encoding {
    Text,
    Binary(ByteOrder),
}

#[derive(Debug)]
struct Header {
    encoding: Encoding,
    elements: Vec<Element>,
    /// Bytes of the header, its last line end included.
    length: usize,
    /// Lines of the header.
    lines: usize,
}

#[derive(Debug)]
struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

#[derive(Debug)]
struct Property {
    name: String,
    kind: Kind,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Scalar(Scalar),
    List { count: Scalar, item: Scalar },
}

impl Header {
    fn parse(bytes: &[u8]) -> Result<Header> {
        // A file that ends its first line with a lone carriage return does so everywhere.
        let end = if matches!(bytes, [_, _, _, b'\r', next, ..] if *next != b'\n') {
            b'\r'
        } else {
            b'\n'
        };
        let mut encoding = None;
        let mut elements = Vec::new();
        let mut length = 0;
        for (index, raw) in bytes.split_inclusive(|&byte| byte == end).enumerate() {
            let line = Line { number: index + 1, bytes: raw.trim_ascii() };
            length += raw.len();
            let words: Vec<&[u8]> = line.words(None).map(|word| word.bytes).collect();
            match words.as_slice() {
                [] | [b"ply" | b"comment" | b"obj_info", ..] => {}
                [b"format", name, ..] => encoding = Some(parse_encoding(name)?),
                [b"element", name, count, ..] => elements.push(parse_element(line, name, count)?),
                [b"property", declared @ ..] => add_property(&mut elements, line, declared)?,
                [b"end_header", ..] => {
                    let encoding = encoding.ok_or_else(|| {
                        Error::invalid("the PLY header has no format line: write the file again")
                    })?;
                    return Ok(Header { encoding, elements, length, lines: line.number });
                }
                _ => return Err(unknown_line(line)),
            }
        }
        Err(Error::invalid(
            "the PLY header has no end_header line: the file is cut off or no PLY file",
        ))
    }

    /// The index of the element `vertex`, and which of its properties are x, y and z.
    fn vertex(&self) -> Result<(usize, [usize; 3])> {
        let Some(index) = self.elements.iter().position(|element| element.name == "vertex") else {
            let names: Vec<_> = self.elements.iter().map(|element| element.name.as_str()).collect();
            return Err(Error::invalid(format!(
                "the PLY file has no element vertex, only [{}]: export points",
                names.join(", ")
            )));
        };
        let properties = &self.elements[index].properties;
        let find = |name: &str| {
            properties.iter().position(|property| {
                property.name == name && matches!(property.kind, Kind::Scalar(_))
            })
        };
        match (find("x"), find("y"), find("z")) {
            (Some(x), Some(y), Some(z)) => Ok((index, [x, y, z])),
            _ => {
                let names: Vec<_> =
                    properties.iter().map(|property| property.name.as_str()).collect();
                Err(Error::invalid(format!(
                    "the PLY vertices have the properties [{}], x, y and z are needed",
                    names.join(", ")
                )))
            }
        }
    }
}

fn parse_encoding(name: &[u8]) -> Result<Encoding> {
    match name {
        b"ascii" => Ok(Encoding::Text),
        b"binary_little_endian" => Ok(Encoding::Binary(ByteOrder::Little)),
        b"binary_big_endian" => Ok(Encoding::Binary(ByteOrder::Big)),
        _ => Err(Error::invalid(format!(
            "the PLY format {} is none of ascii, binary_little_endian, binary_big_endian",
            quoted(name)
        ))),
    }
}

fn parse_element(line: Line<'_>, name: &[u8], count: &[u8]) -> Result<Element> {
    let count = std::str::from_utf8(count).ok().and_then(|count| count.parse().ok());
    Ok(Element {
        name: String::from_utf8_lossy(name).into_owned(),
        count: count.ok_or_else(|| unknown_line(line))?,
        properties: Vec::new(),
    })
}

fn add_property(elements: &mut [Element], line: Line<'_>, declared: &[&[u8]]) -> Result<()> {
    let declaration = match declared {
        [b"list", count, item, name, ..] => scalar_named(count)
            .zip(scalar_named(item))
            .map(|(count, item)| (Kind::List { count, item }, name)),
        [scalar, name, ..] => scalar_named(scalar).map(|scalar| (Kind::Scalar(scalar), name)),
        _ => None,
    };
    match (declaration, elements.last_mut()) {
        (Some((kind, name)), Some(element)) => {
            let name = String::from_utf8_lossy(name).into_owned();
            element.properties.push(Property { name, kind });
            Ok(())
        }
        _ => Err(unknown_line(line)),
    }
}

fn scalar_named(name: &[u8]) -> Option<Scalar> {
    Some(match name {
        b"char" | b"int8" => Scalar::I8,
        b"uchar" | b"uint8" => Scalar::U8,
        b"short" | b"int16" => Scalar::I16,
        b"ushort" | b"uint16" => Scalar::U16,
        b"int" | b"int32" => Scalar::I32,
        b"uint" | b"uint32" => Scalar::U32,
        b"float" | b"float32" => Scalar::F32,
        b"double" | b"float64" => Scalar::F64,
        _ => return None,
    })
}

fn unknown_line(line: Line<'_>) -> Error {
    Error::invalid(format!(
        "line {} of the PLY header is not understood: {}; write the file again",
        line.number,
        quoted(line.bytes)
    ))
}

fn cut_off(element: &Element) -> Error {
    Error::invalid(format!(
        "the PLY header promises {} records of the element {}, the file ends before: it is cut off, write it again",
        element.count, element.name
    ))
}

fn read_binary(header: &Header, body: &[u8], order: ByteOrder) -> Result<Vec<Point3<f64>>> {
    let (vertex, wanted) = header.vertex()?;
    let mut rest = body;
    for element in &header.elements[..vertex] {
        rest = skip_binary(element, rest, order).ok_or_else(|| cut_off(element))?;
    }
    let element = &header.elements[vertex];
    let points = match record_size(&element.properties) {
        Some(size) => {
            let columns = wanted.map(|index| column(&element.properties, index, size));
            read_points(rest, &columns, element.count, order)
        }
        None => read_varying(element, rest, order, wanted),
    };
    points.ok_or_else(|| cut_off(element))
}

/// Bytes per record, `None` if a list makes them differ.
fn record_size(properties: &[Property]) -> Option<usize> {
    properties.iter().try_fold(0, |size, property| match property.kind {
        Kind::Scalar(scalar) => Some(size + scalar.size()),
        Kind::List { .. } => None,
    })
}

fn column(properties: &[Property], index: usize, stride: usize) -> Column {
    let size = |property: &Property| match property.kind {
        Kind::Scalar(scalar) => scalar.size(),
        Kind::List { .. } => 0,
    };
    let scalar = match properties[index].kind {
        Kind::Scalar(scalar) => scalar,
        Kind::List { item, .. } => item,
    };
    Column { offset: properties[..index].iter().map(size).sum(), stride, scalar }
}

/// What follows the records of `element`, `None` if the bytes are too few.
fn skip_binary<'a>(element: &Element, bytes: &'a [u8], order: ByteOrder) -> Option<&'a [u8]> {
    if let Some(size) = record_size(&element.properties) {
        return bytes.get(element.count.checked_mul(size)?..);
    }
    let mut rest = bytes;
    for _ in 0..element.count {
        rest = read_record(&element.properties, rest, order, None)?.1;
    }
    Some(rest)
}

fn read_varying(
    element: &Element,
    bytes: &[u8],
    order: ByteOrder,
    wanted: [usize; 3],
) -> Option<Vec<Point3<f64>>> {
    let mut points = Vec::with_capacity(element.count.min(bytes.len() / 4));
    let mut rest = bytes;
    for _ in 0..element.count {
        let (point, after) = read_record(&element.properties, rest, order, Some(wanted))?;
        points.push(point);
        rest = after;
    }
    Some(points)
}

/// The `wanted` properties of one record, and the bytes after it.
fn read_record<'a>(
    properties: &[Property],
    bytes: &'a [u8],
    order: ByteOrder,
    wanted: Option<[usize; 3]>,
) -> Option<(Point3<f64>, &'a [u8])> {
    let mut point = Point3::origin();
    let mut rest = bytes;
    for (index, property) in properties.iter().enumerate() {
        let length = match property.kind {
            Kind::Scalar(scalar) => {
                if let Some(axis) =
                    wanted.and_then(|wanted| wanted.iter().position(|&w| w == index))
                {
                    *point.coords.get_mut(axis)? = scalar.read(rest, order)?;
                }
                scalar.size()
            }
            Kind::List { count, item } => {
                let items = count.read(rest, order)? as usize;
                items.checked_mul(item.size())?.checked_add(count.size())?
            }
        };
        rest = rest.get(length..)?;
    }
    Some((point, rest))
}

fn read_text(header: &Header, body: &[u8]) -> Result<Vec<Point3<f64>>> {
    let (vertex, wanted) = header.vertex()?;
    let mut records = lines(body).filter(|line| !line.is_blank());
    for element in header.elements[..vertex].iter().filter(|element| !element.properties.is_empty())
    {
        if element.count > 0 && records.nth(element.count - 1).is_none() {
            return Err(cut_off(element));
        }
    }
    let element = &header.elements[vertex];
    // A record takes at least "0 0 0" and a line end.
    let mut points = Vec::with_capacity(element.count.min(body.len() / 6 + 1));
    for line in records.take(element.count) {
        let line = Line { number: line.number + header.lines, ..line };
        points.push(text_vertex(line, &element.properties, wanted)?);
    }
    if points.len() < element.count { Err(cut_off(element)) } else { Ok(points) }
}

fn text_vertex(line: Line<'_>, properties: &[Property], wanted: [usize; 3]) -> Result<Point3<f64>> {
    let last = wanted.iter().copied().max().unwrap_or(0);
    let mut point = Point3::origin();
    let mut words = line.words(None);
    for (index, property) in properties.iter().enumerate().take(last + 1) {
        let word = words.next().ok_or_else(|| short_record(line, properties.len()))?;
        if matches!(property.kind, Kind::List { .. }) {
            let items = line.parse(word)? as usize;
            if items > 0 && words.nth(items - 1).is_none() {
                return Err(short_record(line, properties.len()));
            }
        } else if let Some(axis) = wanted.iter().position(|&w| w == index) {
            point[axis] = line.parse(word)?;
        }
    }
    Ok(point)
}

fn short_record(line: Line<'_>, properties: usize) -> Error {
    Error::invalid(format!(
        "line {} is shorter than the {properties} properties of a vertex: {}; mend that line",
        line.number,
        quoted(line.bytes)
    ))
}

/// Writes points as binary little endian PLY, in single precision where that keeps 0.1 mm.
pub(super) fn write(writer: &mut dyn Write, points: &[Point3<f64>]) -> io::Result<()> {
    let single = fits_single(points);
    write_header(writer, points.len(), single, "")?;
    points.iter().try_for_each(|point| write_point(writer, point, single))
}

/// Writes clouds one after the other as binary little endian PLY with a colour (red, green, blue) for each cloud.
pub(super) fn write_coloured(
    writer: &mut dyn Write,
    clouds: &[(&[Point3<f64>], [u8; 3])],
) -> io::Result<()> {
    let single = clouds.iter().all(|(points, _)| fits_single(points));
    let count = clouds.iter().map(|(points, _)| points.len()).sum();
    let colours = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    write_header(writer, count, single, colours)?;
    for (points, colour) in clouds {
        for point in *points {
            write_point(writer, point, single)?;
            writer.write_all(colour)?;
        }
    }
    Ok(())
}

fn write_header(writer: &mut dyn Write, count: usize, single: bool, more: &str) -> io::Result<()> {
    let scalar = if single { "float" } else { "double" };
    write!(
        writer,
        "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n\
         property {scalar} x\nproperty {scalar} y\nproperty {scalar} z\n{more}end_header\n"
    )
}

/// The coordinates of a point as little-endian floats, 12 or 24 bytes.
pub(super) fn write_point(
    writer: &mut dyn Write,
    point: &Point3<f64>,
    single: bool,
) -> io::Result<()> {
    for &value in point.coords.iter() {
        if single {
            writer.write_all(&(value as f32).to_le_bytes())?;
        } else {
            writer.write_all(&value.to_le_bytes())?;
        }
    }
    Ok(())
}
