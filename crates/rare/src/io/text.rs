//! Numbers in text: lines, words, and messages that say where a number is wrong.

use nalgebra::Point3;

use crate::error::{Error, Result};

/// A line without its line end, and its number from 1.
#[derive(Debug, Clone, Copy)]
pub(super) struct Line<'a> {
    pub(super) number: usize,
    pub(super) bytes: &'a [u8],
}

/// A word of a line, and the column from 1 where it begins.
#[derive(Debug, Clone, Copy)]
pub(super) struct Word<'a> {
    pub(super) column: usize,
    pub(super) bytes: &'a [u8],
}

/// The lines of a text: ended by line feeds, with or without carriage returns before them, or by carriage returns.
pub(super) fn lines(text: &[u8]) -> impl Iterator<Item = Line<'_>> {
    let end = if text.contains(&b'\n') { b'\n' } else { b'\r' };
    text.split(move |&byte| byte == end)
        .enumerate()
        .map(|(index, bytes)| Line { number: index + 1, bytes: bytes.trim_ascii_end() })
}

impl<'a> Line<'a> {
    /// The words between blanks and, if there is one, the `delimiter`. Two delimiters in a row have an empty word
    /// between them, so that a missing value does not shift the columns after it.
    pub(super) fn words(self, delimiter: Option<u8>) -> Words<'a> {
        Words { line: self.bytes, at: 0, delimiter, after_word: false }
    }

    pub(super) fn is_blank(&self) -> bool {
        self.bytes.trim_ascii().is_empty()
    }

    /// The number that `word` writes.
    ///
    /// # Errors
    /// `InvalidInput` with line and column if it is none.
    pub(super) fn parse(&self, word: Word<'_>) -> Result<f64> {
        parse_number(word.bytes).ok_or_else(|| {
            Error::invalid(format!(
                "line {}, column {}: {} is not a number: mend that line",
                self.number,
                word.column,
                quoted(word.bytes)
            ))
        })
    }

    /// The point whose coordinates are the words number `columns` (from 0).
    ///
    /// # Errors
    /// `InvalidInput` with the line if a word is missing or not a number.
    pub(super) fn point(&self, delimiter: Option<u8>, columns: &[usize; 3]) -> Result<Point3<f64>> {
        let last = columns.iter().copied().max().unwrap_or(0);
        let mut point = Point3::origin();
        let mut seen = 0;
        for (index, word) in self.words(delimiter).take(last + 1).enumerate() {
            for (coordinate, _) in
                point.iter_mut().zip(columns).filter(|(_, column)| **column == index)
            {
                *coordinate = self.parse(word)?;
            }
            seen = index + 1;
        }
        if seen <= last {
            return Err(Error::invalid(format!(
                "line {} has {seen} columns, the coordinates need {}: mend that line",
                self.number,
                last + 1
            )));
        }
        Ok(point)
    }
}

/// The iterator of [`Line::words`].
#[derive(Debug, Clone)]
pub(super) struct Words<'a> {
    line: &'a [u8],
    at: usize,
    delimiter: Option<u8>,
    after_word: bool,
}

impl<'a> Iterator for Words<'a> {
    type Item = Word<'a>;

    #[inline]
    fn next(&mut self) -> Option<Word<'a>> {
        let line = self.line;
        let is_delimiter = |byte: u8| Some(byte) == self.delimiter;
        loop {
            let start = self.at;
            match *line.get(start)? {
                b' ' | b'\t' => self.at += 1,
                byte if is_delimiter(byte) => {
                    self.at += 1;
                    if !std::mem::take(&mut self.after_word) {
                        return Some(Word { column: start + 1, bytes: &[] });
                    }
                }
                _ => {
                    let rest = line.get(start..)?;
                    let ends = |&byte: &u8| matches!(byte, b' ' | b'\t') || is_delimiter(byte);
                    let bytes = &rest[..rest.iter().position(ends).unwrap_or(rest.len())];
                    self.at += bytes.len();
                    self.after_word = true;
                    return Some(Word { column: start + 1, bytes });
                }
            }
        }
    }
}

/// The number that these bytes write, `nan` and `inf` included.
pub(super) fn parse_number(bytes: &[u8]) -> Option<f64> {
    std::str::from_utf8(bytes).ok()?.parse().ok()
}

/// At most 40 bytes of a file, fit to be shown in a message.
pub(super) fn quoted(bytes: &[u8]) -> String {
    const SHOWN: usize = 40;
    let shown = String::from_utf8_lossy(&bytes[..bytes.len().min(SHOWN)]);
    format!("\"{}{}\"", shown.escape_debug(), if bytes.len() > SHOWN { "..." } else { "" })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(line: &str, delimiter: Option<u8>) -> Vec<(usize, String)> {
        Line { number: 1, bytes: line.as_bytes() }
            .words(delimiter)
            .map(|word| (word.column, String::from_utf8(word.bytes.to_vec()).unwrap()))
            .collect()
    }

    fn texts(line: &str, delimiter: Option<u8>) -> Vec<String> {
        words(line, delimiter).into_iter().map(|(_, text)| text).collect()
    }

    #[test]
    fn words_are_found_with_their_columns() {
        assert_eq!(words(" 1\t 23 4", None), [(2, "1".into()), (5, "23".into()), (8, "4".into())]);
        assert_eq!(texts("1, 2 3,", Some(b',')), ["1", "2", "3"]);
        assert_eq!(texts("1,,3", Some(b',')), ["1", "", "3"]);
        assert_eq!(texts(",2 ;3", Some(b';')), [",2", "3"]);
        assert_eq!(texts(",,3", Some(b',')), ["", "", "3"]);
    }

    #[test]
    fn every_kind_of_line_end_is_known() {
        for text in ["a\nb\n", "a\r\nb\r\n", "a\rb\r"] {
            let found: Vec<_> = lines(text.as_bytes()).map(|line| line.bytes.to_vec()).collect();
            assert_eq!(found, [b"a".to_vec(), b"b".to_vec(), Vec::new()]);
        }
    }

    #[test]
    fn a_bad_number_is_named_with_its_place() {
        let line = Line { number: 7, bytes: b"1 2 x3" };
        let message = line.point(None, &[0, 1, 2]).unwrap_err().to_string();
        assert!(message.contains("line 7, column 5: \"x3\" is not a number"), "{message}");
        let message = line.point(None, &[0, 1, 3]).unwrap_err().to_string();
        assert!(message.contains("line 7 has 3 columns"), "{message}");
        assert_eq!(line.point(None, &[1, 0, 0]).unwrap(), Point3::new(2.0, 1.0, 1.0));
    }
}
