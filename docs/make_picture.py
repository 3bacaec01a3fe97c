#!/usr/bin/env python3
"""Draws docs/demo.png from what `rare demo` wrote: the two scans before and after, seen from above and from the side.

    cargo run --release -- demo && python3 docs/make_picture.py rare-demo docs/demo.png

Needs numpy and matplotlib.
"""
import sys

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BLUE, ORANGE = "#0072b2", "#e69f00"  # told apart by colour-blind people, too


def read_points(path):
    """The x y z of a binary little-endian PLY whose vertices hold three floats."""
    with open(path, "rb") as file:
        data = file.read()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode("ascii").split("\n")
    count = next(int(line.split()[2]) for line in header if line.startswith("element vertex"))
    kind = "<f8" if any(line.startswith("property double x") for line in header) else "<f4"
    return np.frombuffer(data, kind, count * 3, end).reshape(count, 3).astype(float)


def moved(points, pose):
    return points @ pose[:3, :3].T + pose[:3, 3]


def main(folder, output):
    source, reference = (read_points(f"{folder}/{name}.ply") for name in ("source", "reference"))
    before, after = (np.loadtxt(f"{folder}/{name}.txt") for name in ("initial", "result"))
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.4), sharex=True, sharey=True)
    chosen = np.random.default_rng(0).permutation(len(source))[:60000]
    chosen_reference = np.random.default_rng(1).permutation(len(reference))[:60000]
    for axis, pose, title in ((axes[0], before, "initial transform"), (axes[1], after, "refined by rare")):
        for points, colour in ((reference[chosen_reference], BLUE), (moved(source[chosen], pose), ORANGE)):
            axis.scatter(points[:, 0], points[:, 2], s=0.15, c=colour, alpha=0.35, linewidths=0)
        axis.set_title(title)
        axis.set_aspect("equal")
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(output, dpi=90)


main(*sys.argv[1:3])
