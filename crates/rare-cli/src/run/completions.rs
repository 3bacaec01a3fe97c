//! `rare completions`: the completion script of a shell.

use anyhow::Result;

use crate::SUCCESS;
use crate::args::{CompletionsArgs, command};
use crate::run::print;

pub(super) fn run(args: &CompletionsArgs) -> Result<u8> {
    // By way of memory: the generator does not survive a closed pipe.
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command(), "rare", &mut script);
    print(&String::from_utf8_lossy(&script))?;
    Ok(SUCCESS)
}
