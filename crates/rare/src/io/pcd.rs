//! PCD, the format of the Point Cloud Library: a text header, then text, binary or LZF-compressed binary.
//!
//! Only the fields `x`, `y` and `z` are read, whatever their types and places. Organised clouds mark what the sensor
//! did not see with NaN. Format: <https://pointclouds.org/documentation/tutorials/pcd_file_format.html>.

use std::io::{self, Write};

use nalgebra::Point3;

use super::lzf;
use super::ply::write_point;
use super::scalar::{ByteOrder, Column, Scalar, fits_single, read_points};
use super::text::{Line, lines, quoted};
use crate::error::{Error, Result};

/// Whether a file with these bytes calls itself PCD: a `.PCD` comment or the first keywords of a header.
pub(super) fn is_pcd(bytes: &[u8]) -> bool {
    const LOOKED_AT: usize = 4096;
    let start = &bytes[..bytes.len().min(LOOKED_AT)];
    start.starts_with(b"# .PCD")
        || lines(start)
            .find(|line| !line.is_blank() && !line.bytes.starts_with(b"#"))
            .and_then(|line| line.words(None).next())
            .is_some_and(|word| matches!(word.bytes, b"VERSION" | b"FIELDS" | b"COLUMNS"))
}

/// The points of a PCD file, in its units.
///
/// # Errors
/// `InvalidInput` that says what is wrong with the header or the first bad record.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<Point3<f64>>> {
    let header = Header::parse(bytes)?;
    let body = bytes.get(header.length..).unwrap_or_default();
    match header.data {
        Data::Text => read_text(&header, body),
        Data::Binary => read_points(body, &header.interleaved()?, header.points, ByteOrder::Little)
            .ok_or_else(|| cut_off(&header, body.len())),
        Data::Compressed => read_compressed(&header, body),
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Data {
    Text,
    Binary,
    Compressed,
}

/// A field: `count` numbers of one type per point.
#[derive(Debug, Clone, Copy)]
struct Field {
    scalar: Scalar,
    count: usize,
}

#[derive(Debug)]
struct Header {
    fields: Vec<Field>,
    /// Which fields are x, y and z.
    wanted: [usize; 3],
    points: usize,
    data: Data,
    /// Bytes of the header, its last line end included.
    length: usize,
    /// Lines of the header.
    lines: usize,
}

/// The header's entries as they stand, before they are checked against each other.
#[derive(Debug, Default)]
struct Entries<'a> {
    names: Vec<&'a [u8]>,
    sizes: Vec<usize>,
    types: Vec<&'a [u8]>,
    counts: Vec<usize>,
    width: Option<usize>,
    height: Option<usize>,
    points: Option<usize>,
}

impl Header {
    fn parse(bytes: &[u8]) -> Result<Header> {
        let mut entries = Entries::default();
        let mut length = 0;
        for (index, raw) in bytes.split_inclusive(|&byte| byte == b'\n').enumerate() {
            let line = Line { number: index + 1, bytes: raw.trim_ascii() };
            length += raw.len();
            let words: Vec<&[u8]> = line.words(None).map(|word| word.bytes).collect();
            if let [b"DATA", kind, ..] = words.as_slice() {
                return entries.check(parse_data(kind)?, length, line.number);
            }
            entries.take(line, &words)?;
        }
        Err(Error::invalid("the PCD header has no DATA line: the file is cut off or no PCD file"))
    }

    /// Columns of records that hold every field of a point, one point after the other.
    fn interleaved(&self) -> Result<[Column; 3]> {
        let stride = self.record_size()?;
        let start = |field: usize| self.fields[..field].iter().map(Field::size).sum();
        Ok(self.wanted.map(|field| Column {
            offset: start(field),
            stride,
            scalar: self.fields[field].scalar,
        }))
    }

    /// Columns where each field stands for all points before the next field does.
    fn by_field(&self) -> [Column; 3] {
        let start = |field: usize| self.fields[..field].iter().map(Field::size).sum::<usize>();
        self.wanted.map(|field| Column {
            offset: start(field).saturating_mul(self.points),
            stride: self.fields[field].size(),
            scalar: self.fields[field].scalar,
        })
    }

    fn record_size(&self) -> Result<usize> {
        self.fields
            .iter()
            .try_fold(0usize, |sum, field| sum.checked_add(field.size()))
            .filter(|&size| size <= MAXIMUM_RECORD)
            .ok_or_else(|| Error::invalid("the PCD fields have an absurd COUNT: mend the header"))
    }
}

/// No real point takes more bytes; keeps the sums of field sizes far from overflow.
const MAXIMUM_RECORD: usize = 1 << 24;

impl Field {
    fn size(&self) -> usize {
        self.scalar.size().saturating_mul(self.count)
    }
}

impl<'a> Entries<'a> {
    fn take(&mut self, line: Line<'_>, words: &[&'a [u8]]) -> Result<()> {
        let number = |word: &&[u8]| {
            let parsed = std::str::from_utf8(word).ok().and_then(|word| word.parse::<usize>().ok());
            parsed.ok_or_else(|| unknown_line(line))
        };
        match words {
            [b"FIELDS" | b"COLUMNS", names @ ..] => self.names = names.to_vec(),
            [b"TYPE", types @ ..] => self.types = types.to_vec(),
            [b"SIZE", sizes @ ..] => {
                self.sizes = sizes.iter().map(number).collect::<Result<_>>()?;
            }
            [b"COUNT", counts @ ..] => {
                self.counts = counts.iter().map(number).collect::<Result<_>>()?;
            }
            [b"WIDTH", width, ..] => self.width = Some(number(width)?),
            [b"HEIGHT", height, ..] => self.height = Some(number(height)?),
            [b"POINTS", points, ..] => self.points = Some(number(points)?),
            [] | [b"VERSION" | b"VIEWPOINT", ..] | [[b'#', ..], ..] => {}
            _ => return Err(unknown_line(line)),
        }
        Ok(())
    }

    fn check(mut self, data: Data, length: usize, lines: usize) -> Result<Header> {
        if self.counts.is_empty() {
            self.counts = vec![1; self.names.len()];
        }
        let given = [self.names.len(), self.sizes.len(), self.types.len(), self.counts.len()];
        if given.iter().any(|&length| length != given[0]) {
            return Err(Error::invalid(format!(
                "the PCD header has {} FIELDS, {} SIZE, {} TYPE and {} COUNT entries: they must be as many",
                given[0], given[1], given[2], given[3]
            )));
        }
        let fields = self.fields()?;
        let header =
            Header { wanted: self.wanted()?, fields, points: self.points()?, data, length, lines };
        header.record_size()?;
        Ok(header)
    }

    fn fields(&self) -> Result<Vec<Field>> {
        let types = self.types.iter().zip(&self.sizes).zip(&self.counts);
        types
            .map(|((kind, &size), &count)| {
                let scalar = scalar_of(kind, size).ok_or_else(|| {
                    Error::invalid(format!(
                        "the PCD field type {} of {size} bytes is unknown: types are F, I and U",
                        quoted(kind)
                    ))
                })?;
                Ok(Field { scalar, count })
            })
            .collect()
    }

    fn wanted(&self) -> Result<[usize; 3]> {
        let find = |name: &[u8]| {
            let named = self.names.iter().zip(&self.counts);
            named.into_iter().position(|(given, &count)| *given == name && count > 0)
        };
        match (find(b"x"), find(b"y"), find(b"z")) {
            (Some(x), Some(y), Some(z)) => Ok([x, y, z]),
            _ => Err(Error::invalid(format!(
                "the PCD file has the fields {}, x, y and z are needed",
                quoted(&self.names.join(&b' '))
            ))),
        }
    }

    fn points(&self) -> Result<usize> {
        let grid = self.width.map(|width| width.checked_mul(self.height.unwrap_or(1)));
        match (self.points, grid) {
            (Some(points), None) => Ok(points),
            (None, Some(Some(product))) => Ok(product),
            (Some(points), Some(Some(product))) if points == product => Ok(points),
            (None, None) => {
                Err(Error::invalid("the PCD header has neither POINTS nor WIDTH: add one"))
            }
            _ => Err(Error::invalid(format!(
                "the PCD header says {} points, but WIDTH {} times HEIGHT {}: mend the header",
                self.points.unwrap_or_default(),
                self.width.unwrap_or_default(),
                self.height.unwrap_or(1)
            ))),
        }
    }
}

fn parse_data(kind: &[u8]) -> Result<Data> {
    match kind {
        b"ascii" => Ok(Data::Text),
        b"binary" => Ok(Data::Binary),
        b"binary_compressed" => Ok(Data::Compressed),
        _ => Err(Error::invalid(format!(
            "the PCD data are {}, they must be ascii, binary or binary_compressed",
            quoted(kind)
        ))),
    }
}

fn scalar_of(kind: &[u8], size: usize) -> Option<Scalar> {
    Some(match (kind, size) {
        (b"F", 4) => Scalar::F32,
        (b"F", 8) => Scalar::F64,
        (b"I", 1) => Scalar::I8,
        (b"I", 2) => Scalar::I16,
        (b"I", 4) => Scalar::I32,
        (b"I", 8) => Scalar::I64,
        (b"U", 1) => Scalar::U8,
        (b"U", 2) => Scalar::U16,
        (b"U", 4) => Scalar::U32,
        (b"U", 8) => Scalar::U64,
        _ => return None,
    })
}

fn unknown_line(line: Line<'_>) -> Error {
    Error::invalid(format!(
        "line {} of the PCD header is not understood: {}; write the file again",
        line.number,
        quoted(line.bytes)
    ))
}

fn cut_off(header: &Header, available: usize) -> Error {
    Error::invalid(format!(
        "the PCD header promises {} points, only {available} bytes follow it: the file is cut off, write it again",
        header.points
    ))
}

fn read_text(header: &Header, body: &[u8]) -> Result<Vec<Point3<f64>>> {
    let first = |field: usize| header.fields[..field].iter().map(|field| field.count).sum();
    let columns = header.wanted.map(first);
    // A record takes at least "0 0 0" and a line end.
    let mut points = Vec::with_capacity(header.points.min(body.len() / 6 + 1));
    for line in lines(body).filter(|line| !line.is_blank()).take(header.points) {
        let line = Line { number: line.number + header.lines, ..line };
        points.push(line.point(None, &columns)?);
    }
    if points.len() < header.points { Err(cut_off(header, body.len())) } else { Ok(points) }
}

fn read_compressed(header: &Header, body: &[u8]) -> Result<Vec<Point3<f64>>> {
    let cut_off = || cut_off(header, body.len());
    let (sizes, rest) = body.split_first_chunk::<8>().ok_or_else(cut_off)?;
    let [a, b, c, d, e, f, g, h] = *sizes;
    let compressed = u32::from_le_bytes([a, b, c, d]) as usize;
    let unpacked = u32::from_le_bytes([e, f, g, h]) as usize;
    let expected = header.record_size()?.checked_mul(header.points);
    if expected != Some(unpacked) {
        return Err(Error::invalid(format!(
            "the compressed PCD data unpack to {unpacked} bytes, {} points need another number: write the file again",
            header.points
        )));
    }
    let data = lzf::decompress(rest.get(..compressed).ok_or_else(cut_off)?, unpacked)?;
    read_points(&data, &header.by_field(), header.points, ByteOrder::Little).ok_or_else(cut_off)
}

/// Writes points as binary PCD, in single precision where that keeps 0.1 mm.
pub(super) fn write(writer: &mut dyn Write, points: &[Point3<f64>]) -> io::Result<()> {
    let (count, single) = (points.len(), fits_single(points));
    let size = if single { 4 } else { 8 };
    write!(
        writer,
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE {size} {size} {size}\n\
         TYPE F F F\nCOUNT 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )?;
    points.iter().try_for_each(|point| write_point(writer, point, single))
}
