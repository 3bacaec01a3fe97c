//! Text to tokens: the byte pair encoding of CLIP (Radford et al.: Learning Transferable Visual Models From Natural
//! Language Supervision, 2021; Sennrich, Haddow, Birch: Neural Machine Translation of Rare Words with Subword Units,
//! 2016).
//!
//! A text is put in lower case and cut into words ([`words`]); the bytes of a word are its first tokens; then the two
//! neighbours that come first in the list of merges become one token, again and again. Of a word's last token the name
//! ends in `</w>`.
//!
//! A folder of single checkpoint files holds no vocabulary. The prompts that nobody typed need none: [`known`] lists
//! their tokens.

mod known;
mod words;

use std::collections::HashMap;
use std::fs;
use std::path::Path;

use rare::{Error, Result};

/// Tokens of a prompt: its start, its text, its end, and repeated ends up to this number.
pub const PROMPT_LENGTH: usize = 77;

/// The token at the start of a prompt.
const START: &str = "<|startoftext|>";

/// The token at the end of a prompt, which also pads it.
const END: &str = "<|endoftext|>";

/// What the name of a word's last token ends in.
const END_OF_WORD: &str = "</w>";

/// Longest text, bytes: it bounds the time that one word of that length takes.
const LONGEST_TEXT: usize = 4096;

/// Largest file, bytes; the files of CLIP have 1 MB.
const LARGEST_FILE: u64 = 64 << 20;

/// The tokens of one prompt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tokens {
    /// [`PROMPT_LENGTH`] numbers of tokens.
    pub ids: Vec<u32>,
    /// The number of tokens that the text asked for, start and end included.
    pub count: usize,
}

impl Tokens {
    /// Puts start and end around the tokens of a text, then pads with ends, or cuts what is too much (CLIP's rule).
    fn new(text: &[u32], start: u32, end: u32) -> Tokens {
        let kept = text.iter().copied().take(PROMPT_LENGTH - 2);
        let mut ids: Vec<u32> = std::iter::once(start).chain(kept).collect();
        ids.resize(PROMPT_LENGTH, end);
        Tokens { ids, count: text.len() + 2 }
    }

    /// Whether the text was too long and lost its end.
    #[must_use]
    pub fn truncated(&self) -> bool {
        self.count > PROMPT_LENGTH
    }

    /// The tokens, if none is lost.
    ///
    /// # Errors
    /// `InvalidInput` with the number of tokens if the text was too long.
    pub fn complete(self) -> Result<Tokens> {
        if self.truncated() {
            return Err(Error::invalid(format!(
                "the prompt has {} tokens, its start and end included; the text encoder takes {PROMPT_LENGTH}: shorten it",
                self.count
            )));
        }
        Ok(self)
    }
}

/// The tokens of one of the default prompts, which need no vocabulary; `None` for any other text.
///
/// They are those of CLIP's vocabulary, which every Stable Diffusion 1.x shares.
#[must_use]
pub fn known_tokens(text: &str) -> Option<Tokens> {
    known::text_tokens(text).map(|tokens| Tokens::new(tokens, known::START, known::END))
}

/// CLIP's byte pair encoding with a vocabulary from files.
#[derive(Debug, Clone)]
pub struct Tokenizer {
    /// Tokens of every byte: within a word, and at its end.
    bytes: Vec<[u32; 2]>,
    merges: HashMap<[u32; 2], Merge>,
    start: u32,
    end: u32,
    vocabulary: usize,
}

/// What two neighbouring tokens become. The order is that of the list: what comes first is merged first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Merge {
    rank: usize,
    token: u32,
}

impl Tokenizer {
    /// Reads the vocabulary (`vocab.json`: names of tokens and their numbers) and the list of merges (`merges.txt`: two
    /// names per line).
    ///
    /// # Errors
    /// `Io` if a file cannot be read, `InvalidInput` if it is damaged or the two do not belong together.
    pub fn open(vocabulary: &Path, merges: &Path) -> Result<Tokenizer> {
        let names: HashMap<String, u32> = serde_json::from_str(&read_text(vocabulary)?)
            .map_err(|error| Error::in_file(vocabulary, format!("not a vocabulary: {error}")))?;
        let token = |name: &str| find(&names, name, vocabulary);
        let bytes = byte_names()
            .into_iter()
            .map(|name| Ok([token(&name.to_string())?, token(&format!("{name}{END_OF_WORD}"))?]))
            .collect::<Result<Vec<[u32; 2]>>>()?;
        let list = read_text(merges)?;
        Ok(Tokenizer {
            bytes,
            merges: parse_merges(&list, merges, token)?,
            start: token(START)?,
            end: token(END)?,
            vocabulary: names.values().max().map_or(0, |&largest| largest as usize + 1),
        })
    }

    /// One more than the largest number of a token.
    #[must_use]
    pub fn vocabulary(&self) -> usize {
        self.vocabulary
    }

    /// The tokens of a text, cut at [`PROMPT_LENGTH`]; [`Tokens::truncated`] tells. The names of the start and end
    /// tokens have no meaning in a text.
    ///
    /// Letters and their accents must be one character each, as keyboards write them. Of scripts whose vowels are marks
    /// of their own (Devanagari, Thai, ...), the words are not cut at the marks, other than CLIP's are; its vocabulary
    /// has no words of these.
    ///
    /// # Errors
    /// `InvalidInput` if the text is longer than 4096 bytes or has accents that are characters of their own.
    pub fn encode(&self, text: &str) -> Result<Tokens> {
        if text.len() > LONGEST_TEXT {
            return Err(Error::invalid(format!(
                "the prompt has {} bytes, the most is {LONGEST_TEXT}: shorten it",
                text.len()
            )));
        }
        if let Some(accent) = text.chars().find(|accent| ('\u{300}'..='\u{36f}').contains(accent)) {
            return Err(Error::invalid(format!(
                "the prompt has an accent that is a character of its own ({}): type letter and accent as one character",
                accent.escape_unicode()
            )));
        }
        let text: String = text.chars().flat_map(char::to_lowercase).collect();
        let tokens: Vec<u32> = words::words(&text).flat_map(|word| self.merge(word)).collect();
        Ok(Tokens::new(&tokens, self.start, self.end))
    }

    /// The tokens of one word.
    fn merge(&self, word: &str) -> Vec<u32> {
        let last = word.len().saturating_sub(1);
        let mut tokens: Vec<u32> = word
            .bytes()
            .enumerate()
            .filter_map(|(at, byte)| {
                self.bytes
                    .get(usize::from(byte))
                    .map(|&[within, end]| if at == last { end } else { within })
            })
            .collect();
        while let Some((merge, pair)) = self.first_merge(&tokens) {
            tokens = replaced(&tokens, pair, merge.token);
        }
        tokens
    }

    /// The merge that comes first in the list among those of neighbours.
    fn first_merge(&self, tokens: &[u32]) -> Option<(Merge, [u32; 2])> {
        let neighbours = tokens.iter().zip(tokens.iter().skip(1));
        neighbours
            .filter_map(|(&first, &second)| {
                self.merges.get(&[first, second]).map(|&merge| (merge, [first, second]))
            })
            .min()
    }
}

/// `tokens` with `token` in place of every `pair`.
fn replaced(tokens: &[u32], pair: [u32; 2], token: u32) -> Vec<u32> {
    let mut output = Vec::with_capacity(tokens.len());
    let mut rest = tokens;
    loop {
        rest = match rest {
            [first, second, after @ ..] if [*first, *second] == pair => {
                output.push(token);
                after
            }
            [first, after @ ..] => {
                output.push(*first);
                after
            }
            [] => return output,
        };
    }
}

/// The names of the 256 bytes: a printable character of Latin-1 stands for itself, the others are numbered from 256 on.
fn byte_names() -> Vec<char> {
    let mut unprintable = '\u{100}'..;
    (0..=u8::MAX)
        .filter_map(|byte| match byte {
            b'!'..=b'~' | 0xa1..=0xac | 0xae..=0xff => Some(char::from(byte)),
            _ => unprintable.next(),
        })
        .collect()
}

/// The number of the token `name`.
fn find(names: &HashMap<String, u32>, name: &str, file: &Path) -> Result<u32> {
    names.get(name).copied().ok_or_else(|| {
        Error::in_file(
            file,
            format!(
                "no token {name:?}: take vocab.json and merges.txt of the same Stable Diffusion 1.x"
            ),
        )
    })
}

/// The pairs of the list, without its version line, with their place in it.
fn parse_merges(
    list: &str,
    file: &Path,
    token: impl Fn(&str) -> Result<u32>,
) -> Result<HashMap<[u32; 2], Merge>> {
    let mut merges = HashMap::new();
    for (rank, line) in list.lines().enumerate() {
        if line.trim().is_empty() || (rank == 0 && line.starts_with("#version")) {
            continue;
        }
        let Some((first, second)) = line.split_once(' ') else {
            return Err(Error::in_file(
                file,
                format!("line {}: {line:?} is not two names of tokens", rank + 1),
            ));
        };
        let merge = Merge { rank, token: token(&format!("{first}{second}"))? };
        merges.entry([token(first)?, token(second)?]).or_insert(merge);
    }
    Ok(merges)
}

/// The text of a file of bounded size.
fn read_text(path: &Path) -> Result<String> {
    let size = fs::metadata(path).map_err(|cause| Error::io(path, cause))?.len();
    if size > LARGEST_FILE {
        return Err(Error::in_file(
            path,
            format!("{size} bytes are too many for a vocabulary (the most is {LARGEST_FILE})"),
        ));
    }
    fs::read_to_string(path).map_err(|cause| Error::io(path, cause))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_have_different_printable_names() {
        let names = byte_names();
        assert_eq!((names.len(), names[0], names[32], names[255]), (256, 'Ā', 'Ġ', 'ÿ'));
        let mut sorted = names.clone();
        sorted.sort_unstable();
        sorted.dedup();
        assert_eq!(sorted.len(), 256);
        assert!(names.iter().all(|name| !name.is_whitespace() && !name.is_control()));
    }

    #[test]
    fn pairs_are_replaced_from_the_left() {
        assert_eq!(replaced(&[1, 1, 1, 2, 1, 1], [1, 1], 9), [9, 1, 2, 9]);
        assert_eq!(replaced(&[], [1, 1], 9), [0; 0]);
    }

    #[test]
    fn long_texts_are_cut_and_tell_so() {
        let fits = Tokens::new(&[5; 75], 0, 1);
        assert!(!fits.truncated());
        assert_eq!((fits.ids.len(), fits.ids[75], fits.ids[76]), (77, 5, 1));
        let cut = Tokens::new(&[5; 76], 0, 1);
        assert_eq!(cut.ids, fits.ids);
        let message = cut.complete().unwrap_err().to_string();
        assert!(message.contains("78 tokens") && message.contains("77"), "{message}");
    }
}
