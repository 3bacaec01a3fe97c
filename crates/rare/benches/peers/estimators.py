#!/usr/bin/env python3
"""CPU time of peers of the correspondence estimators on one set of correspondences.

usage: estimators.py CORRESPONDENCES.npz [--sc2-pcr FOLDER] [--threads N] [--repeat N]

CORRESPONDENCES.npz holds `src` and `ref` (N x 3, metres) and `gt` (4 x 4, ref = gt src). Open3D's RANSAC runs 50 000
iterations with edge and distance checks on the points of the correspondences. FOLDER is a checkout of the released
SC2-PCR (github.com/ZhiChen902/SC2-PCR), run on the CPU. The same of this library: `cargo bench --bench stages`.
"""
import argparse
import os
import sys
import time

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("correspondences")
parser.add_argument("--sc2-pcr")
parser.add_argument("--threads", type=int, default=1)
parser.add_argument("--repeat", type=int, default=7)
arguments = parser.parse_args()
for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = str(arguments.threads)  # before the libraries load

import numpy as np  # noqa: E402

data = np.load(arguments.correspondences)
source, target, truth = (data[name].astype(np.float64) for name in ("src", "ref", "gt"))


def report(name, estimate):
    seconds = []
    for _ in range(arguments.repeat):
        start = time.process_time()
        pose = np.asarray(estimate(), dtype=np.float64)
        seconds.append(time.process_time() - start)
    rotation = pose[:3, :3].T @ truth[:3, :3]
    degrees = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
    metres = np.linalg.norm(pose[:3, 3] - truth[:3, 3])
    low, middle = min(seconds) * 1e3, np.median(seconds) * 1e3
    print(f"{name}: {low:.1f} ms CPU at least, {middle:.1f} median; {degrees:.2f} degrees, {metres:.3f} m")


def open3d_ransac():
    import open3d as o3d

    registration = o3d.pipelines.registration
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (source, target)]
    indices = np.arange(len(source), dtype=np.int32)
    pairs = o3d.utility.Vector2iVector(np.stack([indices, indices], axis=1))
    checkers = [
        registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        registration.CorrespondenceCheckerBasedOnDistance(0.1),
    ]
    fit = registration.TransformationEstimationPointToPoint(False)
    stop = registration.RANSACConvergenceCriteria(50000, 1.0)
    return lambda: registration.registration_ransac_based_on_correspondence(
        *clouds, pairs, 0.1, fit, 3, checkers, stop
    ).transformation


def released_sc2_pcr(folder):
    sys.path.insert(0, folder)
    import torch

    torch.set_num_threads(arguments.threads)
    torch.Tensor.cuda = lambda self, *_, **__: self
    from SC2_PCR import Matcher

    matcher = Matcher(inlier_threshold=0.10, use_mutual=False, d_thre=0.1, ratio=0.2, nms_radius=0.1, k1=30, k2=20)
    points = [torch.from_numpy(points).float()[None] for points in (source, target)]
    return lambda: matcher.SC2_PCR(*points)[0].numpy()


report("Open3D RANSAC, 50 000 iterations", open3d_ransac())
if arguments.sc2_pcr:
    report("SC2-PCR as released", released_sc2_pcr(arguments.sc2_pcr))
