#!/usr/bin/env python3
"""Compare the ICP methods with those of Open3D and small_gicp: errors and CPU time from the same starts, one thread.

Usage: python icp.py [--voxel 0.05] [--distance 0.15] [--degrees 5] [--metres 0.1] [--rounds 3] PAIR.npz ...

Build first: cargo build --release --example icp_methods
A pair holds `src` and `ref` (N x 3, metres) and `gt` (4 x 4, moves src onto ref). Every library starts from gt disturbed
about the centroid of src, pairs points up to --distance apart and makes at most 50 rounds. The libraries take turns,
--rounds times over; the figures are medians of CPU seconds. Needs numpy, open3d and small_gicp.
"""
import argparse
import json
import os
import statistics
import subprocess
import time
from collections import defaultdict
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "TBB_NUM_THREADS"):
    os.environ[name] = "1"
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import numpy as np  # noqa: E402
import open3d as o3d  # noqa: E402
import small_gicp  # noqa: E402

REGISTRATION = o3d.pipelines.registration
TURN = np.array([0.003033931306655539, 0.736797110260639, -0.676107102146101])
SHIFT = np.array([-0.6323984977372046, -0.32285622772920797, -0.7041562300201517])
BINARY = Path(__file__).resolve().parents[4] / "target/release/examples/icp_methods"


def start_pose(pair, options):
    turn, centre = np.eye(4), np.eye(4)
    turn[:3, :3] = o3d.geometry.get_rotation_matrix_from_axis_angle(TURN * np.radians(options.degrees))
    turn[:3, 3] = SHIFT * options.metres
    centre[:3, 3] = pair["src"].astype(np.float64).mean(0)
    return pair["gt"] @ centre @ turn @ np.linalg.inv(centre)


def errors(pose, truth):
    rotation = pose[:3, :3].T @ truth[:3, :3]
    cosine = np.clip((np.trace(rotation) - 1) / 2, -1, 1)
    return float(np.degrees(np.arccos(cosine))), float(np.linalg.norm(pose[:3, 3] - truth[:3, 3]))


def timed(run, repeats=5):
    started = time.process_time()
    for _ in range(repeats):
        result = run()
    return result, (time.process_time() - started) / repeats


def open3d_methods(pair, start, options):
    clouds = []
    for name in ("src", "ref"):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(pair[name].astype(np.float64)))
        clouds.append(cloud.voxel_down_sample(options.voxel))
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=2 * options.voxel, max_nn=30)
    clouds[1].estimate_normals(search)
    criteria = REGISTRATION.ICPConvergenceCriteria(1e-6, 1e-6, 50)

    def icp(estimation):
        return REGISTRATION.registration_icp(*clouds, options.distance, start, estimation, criteria).transformation

    def generalised():
        # A copy without normals: Open3D estimates covariances from 20 neighbours, or from normals where there are any.
        bare = [o3d.geometry.PointCloud(cloud.points) for cloud in clouds]
        estimation = REGISTRATION.TransformationEstimationForGeneralizedICP()
        return REGISTRATION.registration_generalized_icp(*bare, options.distance, start, estimation, criteria).transformation

    tukey = REGISTRATION.TukeyLoss(k=options.voxel)
    return {
        "o3d point-to-point": lambda: icp(REGISTRATION.TransformationEstimationPointToPoint()),
        "o3d point-to-plane": lambda: icp(REGISTRATION.TransformationEstimationPointToPlane()),
        "o3d tukey": lambda: icp(REGISTRATION.TransformationEstimationPointToPlane(tukey)),
        "o3d generalised": generalised,
    }


def small_gicp_methods(pair, start, options):
    def preprocess():
        return [
            small_gicp.preprocess_points(
                pair[name].astype(np.float64), downsampling_resolution=options.voxel, num_neighbors=20, num_threads=1
            )
            for name in ("src", "ref")
        ]

    (source, _), (target, tree) = preprocess()
    voxels = small_gicp.GaussianVoxelMap(4 * options.voxel)
    voxels.insert(target)
    settings = dict(max_correspondence_distance=options.distance, num_threads=1, max_iterations=50)

    def align(kind):
        return small_gicp.align(target, source, tree, start, registration_type=kind, **settings).T_target_source

    def voxelised():
        return small_gicp.align(voxels, source, start, **settings).T_target_source

    def voxel_map():
        made = small_gicp.GaussianVoxelMap(4 * options.voxel)
        made.insert(target)

    return {
        "small_gicp preprocess": lambda: (preprocess(), None)[1],
        "small_gicp voxels": voxel_map,
        "small_gicp ICP": lambda: align("ICP"),
        "small_gicp PLANE_ICP": lambda: align("PLANE_ICP"),
        "small_gicp GICP": lambda: align("GICP"),
        "small_gicp VGICP": voxelised,
    }


def ours(path, options):
    command = [BINARY, options.voxel, options.distance, options.degrees, options.metres, 20, path]
    output = subprocess.run([str(part) for part in command], check=True, capture_output=True, text=True).stdout
    return [json.loads(line) for line in output.splitlines()]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+")
    parser.add_argument("--voxel", type=float, default=0.05)
    parser.add_argument("--distance", type=float, default=0.15)
    parser.add_argument("--degrees", type=float, default=5.0)
    parser.add_argument("--metres", type=float, default=0.1)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    print("| pair | method | RE deg | TE cm | CPU ms |\n| --- | --- | --- | --- | --- |")
    for path in options.pairs:
        pair = np.load(path)
        start = start_pose(pair, options)
        methods = open3d_methods(pair, start, options) | small_gicp_methods(pair, start, options)
        seconds, found = defaultdict(list), {}
        for _ in range(options.rounds):
            for name, run in methods.items():
                pose, spent = timed(run)
                seconds[name].append(spent)
                found[name] = None if pose is None else errors(np.asarray(pose), pair["gt"])
            for record in ours(path, options):
                name = f"rare {record['method']}"
                seconds[name].append(record["cpu_s"])
                found[name] = (record["re_deg"], record["te_m"]) if "re_deg" in record else None
        for name, spent in seconds.items():
            error = f"{found[name][0]:.3f} | {100 * found[name][1]:.2f}" if found[name] else " | "
            print(f"| {Path(path).stem} | {name} | {error} | {1000 * statistics.median(spent):.2f} |", flush=True)


if __name__ == "__main__":
    main()
