//! Every figure of a simulated pair and of pairs that nobody should have.

use rare::data::{FeatureMap, Intrinsics};
use rare::nalgebra::{Point3, Vector3};
use rare::refine::{IllustratedCloud, IllustratedMap, IllustrationRequest, PixelMatch};
use rare::synthetic::demo_pair;
use rare::verify::{Visibility, VisibilityMask};
use rare::{DepthMap, Refiner, RefinerConfig, Scan, SetName};

use super::*;
use crate::figures::layout::WIDTH;

const NAMES: [&str; 7] =
    ["alignment", "depth_maps", "features", "matches", "masks", "residuals", "overlap"];

/// Width, height and the number of colours of an image.
fn read(path: &Path) -> (usize, usize, usize) {
    let file = std::io::BufReader::new(fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    let mut colours: Vec<[u8; 3]> = bytes.as_chunks().0.to_vec();
    colours.dedup();
    colours.sort_unstable();
    colours.dedup();
    (info.width as usize, info.height as usize, colours.len())
}

/// Writes the figures into `folder` and looks at each.
fn write_and_check(folder: &Path, subject: &Subject<'_>) {
    let files = subject.write(folder).unwrap();
    assert!(files.iter().map(|file| file.file_stem().unwrap()).eq(NAMES));
    for file in files {
        let (width, height, colours) = read(&file);
        assert_eq!(width, WIDTH, "{}", file.display());
        assert!((200..4 * WIDTH).contains(&height) && colours > 10, "{}", file.display());
    }
}

fn subject<'a>(
    source: &'a PointCloud,
    reference: &'a PointCloud,
    pose: &RigidTransform,
    illustration: &'a Illustration,
) -> Subject<'a> {
    let poses = poses(source, reference, Some(pose), pose);
    Subject { source, reference, kind: SceneKind::Indoor, poses, illustration }
}

#[test]
fn figures_of_a_simulated_pair_show_something_and_do_not_depend_on_threads() {
    let pair = demo_pair(0).unwrap();
    let source = Scan::from(PointCloud::new(pair.source.world_points()).unwrap());
    let reference = Scan::from(pair.target);
    let result = pair.target_from_source;
    let given = RigidTransform::identity();
    let poses = vec![given, pair.initial, result];
    let request = IllustrationRequest { seen_from: pair.initial, poses, most_points: 20_000 };
    let refiner = Refiner::new(RefinerConfig::default());
    let illustration = refiner.illustrate(&source, &reference, &request).unwrap();
    let poses = super::poses(&source.cloud, &reference.cloud, Some(&pair.initial), &result);
    let (source, reference) = (&source.cloud, &reference.cloud);
    let kind = SceneKind::Indoor;
    let subject = Subject { source, reference, kind, poses, illustration: &illustration };
    let folder = tempfile::tempdir().unwrap();
    let [all, one] = ["all", "one"].map(|name| folder.path().join("made").join(name));
    write_and_check(&all, &subject);
    let single = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    single.install(|| subject.write(&one)).unwrap();
    for name in NAMES.map(|name| format!("{name}.png")) {
        let [all, one] = [&all, &one].map(|folder| fs::read(folder.join(&name)).unwrap());
        assert_eq!(all, one, "{name}");
    }
}

/// As many points as that, all in one place.
fn cloud(points: usize, place: f64) -> PointCloud {
    PointCloud::new(vec![Point3::from([place; 3]); points]).unwrap()
}

fn judged(points: usize, residual: f32) -> IllustratedCloud {
    IllustratedCloud {
        // One that the cloud does not have.
        indices: (0..=points).collect(),
        residuals: vec![vec![residual; points + 1]; 3],
        visibility: vec![vec![Visibility::Violation; points]; 3],
    }
}

fn map(channels: usize, depth: f32) -> IllustratedMap {
    let intrinsics = Intrinsics { width: 3, height: 2, ..Intrinsics::indoor() };
    let depth = DepthMap::new(intrinsics, vec![depth; 6]).unwrap();
    let features = FeatureMap::new(channels, 2, 3, vec![1.0; 6 * channels]).unwrap();
    IllustratedMap { sparse: depth.clone(), dense: depth, features }
}

fn view(depth: f32) -> IllustratedView {
    let frame = Frame::Source;
    let far = PixelMatch {
        set: SetName::CommonSource,
        source: (usize::MAX, 0),
        reference: (2, 99),
        inlier: true,
    };
    IllustratedView {
        frame,
        reference: map(1, depth),
        source: map(2, 0.0),
        matches: vec![far],
        masks: vec![VisibilityMask { frame, width: 2, height: 2, pixels: Vec::new() }],
    }
}

#[test]
fn hostile_inputs_are_drawn_without_a_panic() {
    let folder = tempfile::tempdir().unwrap();
    let far = RigidTransform::from_translation(Vector3::from([1e30, -1e200, 1e9]));
    let turned = RigidTransform::identity();
    for (points, place) in [(1, 0.0), (3, 0.5), (3, 6e6), (2, 1e300)] {
        let clouds = [cloud(points, place), cloud(points, -place)];
        for (radius, residual) in [(0.1, f32::INFINITY), (0.0, 0.0), (f64::NAN, f32::NAN)] {
            let (source, reference) = (judged(points, residual), judged(0, residual));
            let views = vec![view(1.0), view(0.0), view(f32::MAX)];
            let with_views = Illustration { views, source, reference, acceptance_radius: radius };
            for pose in [&far, &turned] {
                write_and_check(folder.path(), &subject(&clouds[0], &clouds[1], pose, &with_views));
            }
        }
    }
}

#[test]
fn what_is_missing_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let clouds = [cloud(3, 0.5), cloud(3, 0.1)];
    let nothing = || IllustratedCloud { indices: vec![], residuals: vec![], visibility: vec![] };
    let illustration = Illustration {
        views: Vec::new(),
        source: nothing(),
        reference: nothing(),
        acceptance_radius: 0.1,
    };
    let pose = RigidTransform::identity();
    let subject = subject(&clouds[0], &clouds[1], &pose, &illustration);
    write_and_check(folder.path(), &subject);
    write_and_check(folder.path(), &Subject { poses: Vec::new(), ..subject });
}

#[test]
fn poses_stand_where_the_illustration_has_them() {
    let clouds = [cloud(3, 6e6), cloud(3, 5e6)];
    let pose = RigidTransform::from_translation(Vector3::x());
    let names =
        |poses: &[Pose]| poses.iter().map(|pose| (pose.name, pose.index)).collect::<Vec<_>>();
    let all = poses(&clouds[0], &clouds[1], Some(&pose), &pose);
    assert_eq!(names(&all), [("as given", 0), ("initial", 1), ("result", 2)]);
    assert_eq!(
        names(&poses(&clouds[0], &clouds[1], None, &pose)),
        [("as given", 0), ("result", 1)]
    );
    // Both clouds are kept around the origin, and so are the poses.
    assert!((all[2].local.translation() - Vector3::from([1e6 + 1.0, 1e6, 1e6])).norm() < 1e-6);
}

#[test]
fn of_every_frame_the_view_with_most_matches_is_shown() {
    let none = IllustratedView { matches: Vec::new(), ..view(1.0) };
    let of_reference = IllustratedView { frame: Frame::Reference, ..none.clone() };
    let views = vec![none, view(2.0), view(3.0), of_reference];
    let illustration = Illustration {
        views,
        source: judged(0, 0.0),
        reference: judged(0, 0.0),
        acceptance_radius: 0.1,
    };
    let clouds = [cloud(3, 0.5), cloud(3, 0.1)];
    let subject = subject(&clouds[0], &clouds[1], &RigidTransform::identity(), &illustration);
    let shown = subject.views();
    assert_eq!(
        shown.iter().map(|(name, _)| *name).collect::<Vec<_>>(),
        ["reference view", "source view"]
    );
    assert_eq!(*shown[1].1, view(2.0));
}
