//! What a weight file holds against what it should hold.

use std::collections::BTreeMap;
use std::fmt::{self, Display, Formatter};

use rare::{Error, Result};

use super::Parameters;

/// The shape of every tensor of a network, by name.
pub type Layout = BTreeMap<String, Vec<usize>>;

/// How many tensors of each kind a message names.
const NAMED: usize = 3;

/// A buffer of the text encoder that old files hold beside its weights: the numbers 0, 1, 2, ...
const IGNORED: &str = ".position_ids";

/// Where tensors differ from a layout, sorted by name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Differences {
    /// Tensors of the layout that are not there.
    pub missing: Vec<String>,
    /// Tensors that the layout does not have.
    pub surplus: Vec<String>,
    /// Tensors of another shape.
    pub misshapen: Vec<Misshapen>,
}

/// A tensor of another shape than its layout says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Misshapen {
    /// Its name.
    pub name: String,
    /// The shape in the layout.
    pub expected: Vec<usize>,
    /// The shape in the file.
    pub found: Vec<usize>,
}

/// Compares the tensors of weight files with a layout, by their names and shapes alone: no value is read.
#[must_use]
pub fn compare(layout: &Layout, parameters: &Parameters) -> Differences {
    let mut differences = Differences::default();
    for (name, expected) in layout {
        match parameters.shape(name) {
            None => differences.missing.push(name.clone()),
            Some(found) if found != expected => differences.misshapen.push(Misshapen {
                name: name.clone(),
                expected: expected.clone(),
                found: found.to_vec(),
            }),
            Some(_) => {}
        }
    }
    differences.surplus = parameters
        .names()
        .filter(|name| !layout.contains_key(*name) && !name.ends_with(IGNORED))
        .map(str::to_owned)
        .collect();
    differences
}

/// Makes sure that weight files hold the tensors of `layout` and no others. `network` is its name for the message, which
/// ends with the advice what to do.
///
/// # Errors
/// `InvalidInput` with the file and the first differences.
pub(crate) fn require(
    layout: &Layout,
    parameters: &Parameters,
    network: &str,
    advice: &str,
) -> Result<()> {
    let differences = compare(layout, parameters);
    if differences.is_empty() {
        return Ok(());
    }
    let what = format!("not the weights of {network}: {differences}; {advice}");
    match parameters.files().first() {
        Some(file) => Err(Error::in_file(file, what)),
        None => Err(Error::invalid(what)),
    }
}

impl Differences {
    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.missing.is_empty() && self.surplus.is_empty() && self.misshapen.is_empty()
    }
}

impl Display for Differences {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        let kinds = [
            listed("missing", &self.missing),
            listed("unknown", &self.surplus),
            listed("of another shape", &self.misshapen),
        ];
        let kinds: Vec<String> = kinds.into_iter().flatten().collect();
        formatter.write_str(&kinds.join("; "))
    }
}

impl Display for Misshapen {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} {:?}, expected {:?}", self.name, self.found, self.expected)
    }
}

/// How many tensors there are of one kind and the first of them; nothing if there are none.
fn listed(kind: &str, tensors: &[impl Display]) -> Option<String> {
    if tensors.is_empty() {
        return None;
    }
    let mut names: Vec<String> = tensors.iter().take(NAMED).map(ToString::to_string).collect();
    if tensors.len() > NAMED {
        names.push("...".to_owned());
    }
    let noun = if tensors.len() == 1 { "tensor" } else { "tensors" };
    Some(format!("{} {noun} {kind} ({})", tensors.len(), names.join(", ")))
}
