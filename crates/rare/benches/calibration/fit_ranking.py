#!/usr/bin/env python3
"""Fit the models of screening and ranking to poses that the refiner compared.

    compared_poses.sh DATA POSES
    fit_ranking.py POSES... [--success 'objects*=15,0.025']

Each line of a .jsonl file is a pose of a pair with its errors and signals. Screening is fitted to poses without support,
ranking to those with support, both by ridge logistic regression in which every pair of clouds weighs the same, however
many poses it has; coefficients whose sign contradicts their signal are left out. Poses that are neither right nor clearly
wrong (up to 20 degrees and twice the distance at which a pose is right) are not fitted. Every folder is predicted by a
model that was fitted without it. Needs numpy.
"""
import argparse
import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np

import logistic
import reliability
from records import scoring

NAMES = list(logistic.SIGNS)
# What one pair weighs: its poses are many, and differ.
WEIGHT_OF_PAIR = 10.0
# A pose is clearly wrong if it is further off than the limits for right ones times these.
CLEARLY_DEGREES, CLEARLY_METRES = 4 / 3, 2.0


def read(paths):
    files = [file for path in map(Path, paths) for file in ([path] if path.is_file() else sorted(path.rglob("*.jsonl")))]
    poses = [json.loads(line) for file in files for line in file.read_text().splitlines()]
    if not poses:
        raise SystemExit("there is no pose in these files: dump them with compared_poses.sh")
    return poses


def judged(poses, success):
    """(poses, whether they are right) without those that are neither right nor clearly wrong."""
    kept, right = [], []
    for pose in poses:
        degrees, metres = pose["rotation_error_degrees"], pose["translation_error_metres"]
        most_degrees, most_metres = success.limits(pose["folder"])
        holds = success.holds(pose["folder"], degrees, metres)
        if holds or degrees >= CLEARLY_DEGREES * most_degrees or metres >= CLEARLY_METRES * most_metres:
            kept.append(pose)
            right.append(holds)
    return kept, np.array(right, bool)


def values_of(poses):
    return np.array([[pose["signals"][name] for name in NAMES] for pose in poses], float).reshape(len(poses), len(NAMES))


def weights_of(poses):
    keys = [(pose["folder"], pose["source"], pose["reference"]) for pose in poses]
    count = Counter(keys)
    return np.array([WEIGHT_OF_PAIR / count[key] for key in keys])


def fit(poses, right, penalty):
    return logistic.fit_signed(values_of(poses), right, weights_of(poses), penalty, list(logistic.SIGNS.values()))


def unseen(poses, right, penalty):
    """The probability of each pose, by a model that was fitted without its folder; NaN if nothing else is there."""
    probability = np.full(len(poses), np.nan)
    folders = np.array([pose["folder"] for pose in poses])
    for folder in sorted(set(folders)):
        own = folders == folder
        others = [pose for pose in poses if pose["folder"] != folder]
        if others:
            model = fit(others, right[~own], penalty)
            probability[own] = model.probability(values_of([pose for pose in poses if pose["folder"] == folder]))
    return probability


def report(name, poses, right, penalty):
    if right.all() or not right.any():
        raise SystemExit(f"all {len(right)} poses for {name} are alike: add others")
    print(f"{fit(poses, right, penalty).rust(name)}\n// {', '.join(NAMES)}")
    probability = unseen(poses, right, penalty)
    known = np.isfinite(probability)
    area = reliability.auc(probability[known], right[known])
    print(f"// {len(poses)} poses, {right.sum()} right; area under the curve on folders that the fit has not seen: "
          f"{'-' if area is None else f'{area:.4f}'}\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", help="files of poses, or folders of them")
    parser.add_argument("--success", action="append", default=[], metavar="NAME=DEG,M", help=scoring.SUCCESS_HELP)
    parser.add_argument("--penalty", type=float, default=1.0, help="of the squared coefficients of standardised signals")
    parser.add_argument("--self-check", action="store_true", help="check this program and end")
    arguments = parser.parse_args()
    if arguments.self_check:
        return self_check()
    poses = read(arguments.paths)
    success = scoring.Success(arguments.success)
    for name, supported in (("SCREENING", False), ("RANKING", True)):
        report(name, *judged([pose for pose in poses if pose["supported"] == supported], success), arguments.penalty)


def self_check():
    """Poses that follow a known model: more of the first signal, less of the second."""
    random = np.random.default_rng(1)
    poses = []
    for number in range(20_000):
        signals = {name: float(random.normal()) for name in NAMES}
        is_right = random.uniform() < logistic.logistic(1.0 + 2.0 * signals["agreement"] - signals["occlusion"])
        poses.append({"folder": "ab"[number % 2], "source": number // 4, "reference": 0, "supported": True,
                      "rotation_error_degrees": 1.0 if is_right else 90.0, "translation_error_metres": 0.1,
                      "signals": signals})
    kept, right = judged(poses, scoring.Success())
    model = fit(kept, right, 1.0)
    assert len(kept) == len(poses) and np.allclose(model.coefficients[:2], [2.0, -1.0], atol=0.1), model
    assert (np.array(list(logistic.SIGNS.values())) * model.coefficients >= 0).all(), model
    # Far from both limits, between them, and right.
    near = [dict(poses[0], rotation_error_degrees=degrees) for degrees in (20.0, 19.9, 14.9)]
    assert judged(near, scoring.Success())[1].tolist() == [False, True]
    # A pair with many poses weighs as much as one with few.
    pairs = {(pose["folder"], pose["source"]) for pose in kept}
    assert abs(weights_of(kept).sum() - WEIGHT_OF_PAIR * len(pairs)) < 1e-6
    # The probabilities of a folder come from the other.
    own = np.array([pose["folder"] == "a" for pose in kept])
    other = fit([pose for pose in kept if pose["folder"] == "b"], right[~own], 1.0)
    expected = other.probability(values_of([pose for pose in kept if pose["folder"] == "a"]))
    assert np.array_equal(unseen(kept, right, 1.0)[own], expected)
    print("self-check passed", file=sys.stderr)


if __name__ == "__main__":
    main()
