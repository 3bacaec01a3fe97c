//! `rare convert`: a cloud in another format.

use anyhow::Result;
use rare::io as files;

use crate::args::ConvertArgs;
use crate::outputs::{self, Output};
use crate::{SUCCESS, summary};

pub(super) fn run(args: &ConvertArgs) -> Result<u8> {
    outputs::check(&[&args.input], &[Output { option: "OUT", path: &args.output }])?;
    files::check_writable_format(&args.output)?;
    let cloud = files::read_cloud(&args.input)?;
    files::write_cloud(&args.output, &cloud.world_points())?;
    if cloud.dropped() > 0 {
        summary::say(&format!(
            "warning: {}: {} points are not finite and were dropped",
            args.input.display(),
            cloud.dropped()
        ));
    }
    summary::say(&format!("wrote {} points to {}", cloud.len(), args.output.display()));
    Ok(SUCCESS)
}
