//! Prompts to tokens, against the tokenizer that the networks were trained with.

use std::fs;
use std::path::Path;

use rare_nets::diffusion::{
    INDOOR_PROMPT, NEGATIVE_PROMPT, PROMPT_LENGTH, STREET_PROMPT, Tokenizer, known_tokens,
};

use crate::shared::{self, Golden};

fn tokenizer() -> Option<Tokenizer> {
    let folder = shared::path("golden/rare/tiny-pipeline/tokenizer")?;
    Some(Tokenizer::open(&folder.join("vocab.json"), &folder.join("merges.txt")).unwrap())
}

#[test]
fn prompts_have_the_golden_tokens() {
    let Some(tokenizer) = tokenizer() else { return };
    let text = fs::read(shared::path("golden/rare/s5_prompts.json").unwrap()).unwrap();
    let prompts: Vec<String> = serde_json::from_slice(&text).unwrap();
    let golden = Golden::open("rare/s5_text.npz").unwrap().array("input_ids");
    assert_eq!(golden.shape, [12, PROMPT_LENGTH]);
    for (prompt, expected) in prompts.iter().zip(golden.values.chunks(PROMPT_LENGTH)) {
        let tokens = tokenizer.encode(prompt).unwrap();
        let ids: Vec<f64> = tokens.ids.iter().map(|&id| f64::from(id)).collect();
        assert_eq!(ids, expected, "{prompt}");
        assert_eq!(tokens.truncated(), prompt.starts_with("word word"), "{prompt}");
    }
    assert_eq!(tokenizer.vocabulary(), 49408);
}

#[test]
fn default_prompts_need_no_vocabulary() {
    let Some(tokenizer) = tokenizer() else { return };
    for prompt in [INDOOR_PROMPT, STREET_PROMPT, NEGATIVE_PROMPT, ""] {
        assert_eq!(known_tokens(prompt), Some(tokenizer.encode(prompt).unwrap()), "{prompt}");
    }
    assert_eq!(known_tokens("a photo"), None);
}

#[test]
fn prompts_that_are_too_long_or_decomposed_are_refused() {
    let Some(tokenizer) = tokenizer() else { return };
    assert!(tokenizer.encode(&"word ".repeat(75)).unwrap().complete().is_ok());
    let message = tokenizer.encode(&"word ".repeat(76)).unwrap().complete().unwrap_err();
    assert!(message.to_string().contains("78 tokens"), "{message}");
    let message = tokenizer.encode(&"x".repeat(5000)).unwrap_err().to_string();
    assert!(message.contains("5000 bytes"), "{message}");
    let message = tokenizer.encode("cafe\u{301}").unwrap_err().to_string();
    assert!(message.contains("\\u{301}"), "{message}");
    // One word of the longest length has an end too.
    assert!(tokenizer.encode(&"x".repeat(4096)).unwrap().truncated());
}

/// Writes a vocabulary and merges and tries to open them.
fn open(vocabulary: &str, merges: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        fs::write(&path, text).unwrap();
        path
    };
    let result =
        Tokenizer::open(&write("vocab.json", vocabulary), &write("merges.txt", merges)).map(drop);
    result.unwrap_err().to_string()
}

#[test]
fn damaged_files_are_named() {
    for (vocabulary, merges, words) in [
        ("", "", ["vocab.json", "not a vocabulary"]),
        ("[1]", "", ["vocab.json", "not a vocabulary"]),
        (r#"{"a": -1}"#, "", ["vocab.json", "not a vocabulary"]),
        (r#"{"a": 1}"#, "", ["vocab.json", "no token"]),
    ] {
        let message = open(vocabulary, merges);
        assert!(words.iter().all(|word| message.contains(word)), "{message}");
    }
    let missing = Tokenizer::open(Path::new("nowhere.json"), Path::new("nowhere.txt"));
    assert!(missing.unwrap_err().to_string().contains("nowhere.json"));
    let Some(folder) = shared::path("golden/rare/tiny-pipeline/tokenizer") else { return };
    let vocabulary = fs::read_to_string(folder.join("vocab.json")).unwrap();
    for (merges, words) in [
        ("#version: 0.2\nin\n", ["merges.txt", "line 2"]),
        ("#version: 0.2\ni n\nqx zz\n", ["vocab.json", "qxzz"]),
    ] {
        let message = open(&vocabulary, merges);
        assert!(words.iter().all(|word| message.contains(word)), "{message}");
    }
}
