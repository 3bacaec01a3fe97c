//! `rare info`: what is in cloud files, and what the program makes of it.

use std::path::Path;

use anyhow::{Context, Result};
use rare::data::resolution;
use rare::nalgebra::Vector3;
use rare::scale::{Profile, Scale};
use rare::{PointCloud, io as files};

use crate::SUCCESS;
use crate::args::InfoArgs;
use crate::run::print;
use crate::summary::{kind_in_words, row, short_length};

pub(super) fn run(args: &InfoArgs) -> Result<u8> {
    let texts = args.clouds.iter().map(|file| describe(file)).collect::<Result<Vec<String>>>()?;
    print(&texts.concat())?;
    Ok(SUCCESS)
}

fn describe(file: &Path) -> Result<String> {
    let cloud = files::read_cloud(file)?;
    let mut text = format!("{}\n", file.display());
    row(&mut text, "format", files::cloud_format(file)?);
    row(&mut text, "points", &cloud.len().to_string());
    row(&mut text, "dropped", &format!("{} (not finite)", cloud.dropped()));
    describe_place(&mut text, &cloud);
    row(&mut text, "spacing", &format!("{:.4} m (median)", resolution(cloud.points())));
    // A cloud without extent has no scale, but everything above.
    let scale = Scale::new(Profile::Auto, None, &cloud, &cloud)
        .with_context(|| file.display().to_string())?;
    row(&mut text, "scene", &kind_in_words(scale.kind));
    row(&mut text, "voxel", &format!("{} (automatic)", short_length(scale.voxel)));
    Ok(text)
}

/// Where the cloud lies, in the file's own coordinates.
fn describe_place(text: &mut String, cloud: &PointCloud) {
    let (low, high) = cloud.bounds();
    let triple = |v: Vector3<f64>, between: &str| {
        format!("{:.3}{between}{:.3}{between}{:.3}", v.x, v.y, v.z)
    };
    let (least, most) = (low.coords + cloud.shift(), high.coords + cloud.shift());
    row(text, "lowest", &format!("{} m", triple(least, " ")));
    row(text, "highest", &format!("{} m", triple(most, " ")));
    row(text, "extent", &format!("{} m", triple(high - low, " x ")));
    row(text, "recentred by", &format!("{} m", triple(*cloud.shift(), " ")));
}
