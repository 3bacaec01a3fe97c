//! `rare icp`: the methods that people know, by themselves.

use std::path::Path;
use std::time::Instant;

use anyhow::Result;
use rare::pose::{Icp, IcpResult, MultiScaleIcp, OpenDirection, Trim};
use rare::scale::{Profile, Scale};
use rare::{PointCloud, RigidTransform, Scan, io as files};
use serde_json::json;

use crate::args::{IcpArgs, TrimChoice};
use crate::outputs::{self, Output};
use crate::progress::Progress;
use crate::run::{aligned, print, read_scan, refine, start_pool};
use crate::{NO_POSE, SUCCESS, summary};

pub(super) fn run(args: &IcpArgs) -> Result<u8> {
    check_files(args)?;
    start_pool(args.threads)?;
    let clock = Instant::now();
    let progress = Progress::start(args.quiet);
    progress.step("read");
    let initial = match &args.init {
        Some(file) => refine::read_initial(file, args.init_direction)?,
        None => RigidTransform::identity(),
    };
    let (source, reference) = (read_scan(&args.clouds.source)?, read_scan(&args.clouds.reference)?);
    progress.step("align");
    let settings = settings(args, &source, &reference)?;
    let result = align(&settings, &source.cloud, &reference.cloud, &initial)?;
    drop(progress);
    write(args, &settings, &source, &reference, &result)?;
    if !args.quiet {
        summary::say(&describe(&result, clock.elapsed().as_secs_f64()));
    }
    let is_trusted = result.converged && result.open_directions.is_empty();
    Ok(if is_trusted { SUCCESS } else { NO_POSE })
}

fn check_files(args: &IcpArgs) -> Result<()> {
    let named = [
        ("--output", &args.output),
        ("--json", &args.json),
        ("--save-aligned", &args.save_aligned),
    ];
    let output = |(option, path): (_, _)| Some(Output { option, path: Option::as_deref(path)? });
    let outputs: Vec<Output<'_>> = named.into_iter().filter_map(output).collect();
    let clouds = [args.clouds.source.as_path(), args.clouds.reference.as_path()];
    let read: Vec<&Path> = clouds.into_iter().chain(args.init.as_deref()).collect();
    outputs::check(&read, &outputs)?;
    Ok(args.save_aligned.as_ref().map_or(Ok(()), files::check_writable_format)?)
}

/// The schedule: scales of twice the sampling distance each, down to the finest.
fn settings(args: &IcpArgs, source: &Scan, reference: &Scan) -> Result<MultiScaleIcp> {
    let scale = Scale::new(Profile::Auto, args.voxel, &source.cloud, &reference.cloud)?;
    let default = MultiScaleIcp::for_voxel(args.method, scale.voxel);
    let voxels = (0..u32::from(args.scales)).rev().map(|level| scale.voxel * f64::from(1 << level));
    let per_voxel = Icp {
        kernel: args.kernel,
        trim: match args.trim {
            TrimChoice::Off => Trim::Off,
            TrimChoice::Auto => Trim::Automatic,
            TrimChoice::Share(share) => Trim::Overlap(share),
        },
        max_iterations: args.iterations,
        ..default.per_voxel
    };
    Ok(MultiScaleIcp { voxels: voxels.collect(), per_voxel, ..default })
}

/// Aligns near the origin, where the millimetres are kept; the result is in the frames of the files.
fn align(
    settings: &MultiScaleIcp,
    source: &PointCloud,
    reference: &PointCloud,
    initial: &RigidTransform,
) -> Result<IcpResult> {
    let local = PointCloud::to_local(reference, source, initial);
    let result = settings.align(source.points(), reference.points(), &local)?;
    let target_from_source = PointCloud::to_world(reference, source, &result.target_from_source);
    Ok(IcpResult { target_from_source, ..result })
}

fn write(
    args: &IcpArgs,
    settings: &MultiScaleIcp,
    source: &Scan,
    reference: &Scan,
    result: &IcpResult,
) -> Result<()> {
    let pose = &result.target_from_source;
    if let Some(file) = &args.output {
        files::write_pose(file, pose)?;
    }
    if let Some(file) = &args.json {
        let text = serde_json::to_string_pretty(&record(settings, result))? + "\n";
        files::write_whole(file, |writer| writer.write_all(text.as_bytes()))?;
    }
    if let Some(file) = &args.save_aligned {
        files::write_cloud(file, &aligned(source, reference, pose))?;
    }
    print(&files::format_pose(pose))
}

/// What programs read. Open directions and information are in the reference's frame, moved near the origin by a whole
/// number of metres where its coordinates are large.
fn record(settings: &MultiScaleIcp, result: &IcpResult) -> serde_json::Value {
    let open = |direction: &OpenDirection| {
        json!({
            "rotation": direction.rotation.as_slice(),
            "translation": direction.translation.as_slice(),
            "centre": direction.centre.coords.as_slice(),
        })
    };
    let information: Vec<Vec<f64>> =
        result.information.row_iter().map(|row| row.iter().copied().collect()).collect();
    json!({
        "target_from_source": rare::eval::results::rows_of(&result.target_from_source.to_matrix()),
        "fitness": result.fitness,
        "inlier_rmse": result.inlier_rmse,
        "residual_rmse": result.residual_rmse,
        "overlap": result.overlap,
        "iterations": result.iterations,
        "converged": result.converged,
        "open_directions": result.open_directions.iter().map(open).collect::<Vec<_>>(),
        "information": information,
        "config": settings,
        "version": env!("CARGO_PKG_VERSION"),
    })
}

/// What people read.
fn describe(result: &IcpResult, seconds: f64) -> String {
    let rounds: Vec<String> = result.iterations.iter().map(usize::to_string).collect();
    let mut lines = vec![
        if result.converged {
            "converged"
        } else {
            "not converged: the last round still moved the cloud (exit code 1)"
        }
        .to_owned(),
        format!(
            "fitness     {:.1} % of the source has a point of the reference nearby",
            100.0 * result.fitness
        ),
        format!(
            "residual    {:.4} m (points {:.4} m apart)",
            result.residual_rmse, result.inlier_rmse
        ),
        format!("rounds      {} by stage", rounds.join(" ")),
        format!("time        {seconds:.2} s"),
    ];
    lines.extend(result.open_directions.iter().map(|direction| {
        format!("warning: the surfaces leave a motion open (exit code 1): {}", in_words(direction))
    }));
    lines.join("\n")
}

fn in_words(direction: &OpenDirection) -> String {
    let axis = |vector: rare::nalgebra::Vector3<f64>| {
        let unit = vector.try_normalize(0.0).unwrap_or_default();
        format!("({:.2} {:.2} {:.2})", unit.x, unit.y, unit.z)
    };
    match direction.point_on_axis() {
        None => format!("a shift along {}", axis(direction.translation)),
        Some(point) => format!(
            "a turn about the axis {} through ({:.2} {:.2} {:.2})",
            axis(direction.rotation),
            point.x,
            point.y,
            point.z
        ),
    }
}
