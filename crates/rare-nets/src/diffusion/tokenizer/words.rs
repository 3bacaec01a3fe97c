//! How CLIP cuts a text into words: the endings of English contractions, runs of letters, single digits, and runs of
//! anything else that is not white space.

/// Endings that are words of their own wherever a word may begin.
const CONTRACTIONS: [&str; 7] = ["'s", "'t", "'re", "'ve", "'m", "'ll", "'d"];

/// What a character can be part of.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Space,
    Letter,
    Number,
    Other,
}

impl Kind {
    fn of(character: char) -> Kind {
        if character.is_whitespace() {
            Kind::Space
        } else if character.is_numeric() {
            // First, because numerals like Ⅷ count as alphabetic too.
            Kind::Number
        } else if character.is_alphabetic() {
            Kind::Letter
        } else {
            Kind::Other
        }
    }
}

/// The words of a text in lower case, in order.
pub(super) fn words(text: &str) -> impl Iterator<Item = &str> {
    let mut rest = text;
    std::iter::from_fn(move || {
        rest = rest.trim_start();
        let (word, after) = rest.split_at_checked(word_length(rest))?;
        rest = after;
        (!word.is_empty()).then_some(word)
    })
}

/// Bytes of the word that `text` begins with; 0 at the end.
fn word_length(text: &str) -> usize {
    if let Some(ending) = CONTRACTIONS.iter().find(|ending| text.starts_with(**ending)) {
        return ending.len();
    }
    let Some(first) = text.chars().next() else { return 0 };
    let kind = Kind::of(first);
    if kind == Kind::Number {
        return first.len_utf8();
    }
    text.find(|character| Kind::of(character) != kind).unwrap_or(text.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_cut_as_clip_cuts_them() {
        for (text, expected) in [
            ("", &[][..]),
            (" \t\n", &[]),
            ("a photo", &["a", "photo"]),
            ("don't they'll 's", &["don", "'t", "they", "'ll", "'s"]),
            ("640x480!", &["6", "4", "0", "x", "4", "8", "0", "!"]),
            // A run of signs takes the apostrophe with it.
            ("wow!'s", &["wow", "!'", "s"]),
            ("café_déjà", &["café", "_", "déjà"]),
            ("ⅷ²½", &["ⅷ", "²", "½"]),
            ("a\u{3000}b", &["a", "b"]),
        ] {
            assert_eq!(words(text).collect::<Vec<_>>(), expected, "{text:?}");
        }
    }
}
