#!/usr/bin/env python3
"""Write a benchmark of scans that have nothing in common, in the layout of `rare eval folder`.

    different_places.py OUT PLACE=CLOUD,CLOUD... PLACE=CLOUD,CLOUD... [...]

Clouds are .ply files (copied) and .npz files (`src` and `ref`, both become clouds); clouds of one place are never paired.
All pairs of clouds of different places are taken, either way round. Their truth is a kilometre away, where no pose is right.
"""
import json
import shutil
import sys
from pathlib import Path

import numpy as np

NOWHERE = [[1.0, 0.0, 0.0, 1000.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
IDENTITY = np.eye(4).tolist()


def write_ply(points, path):
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
              "property float x\nproperty float y\nproperty float z\nend_header\n")
    path.write_bytes(header.encode() + np.asarray(points, "<f4").tobytes())


def copy_clouds(file, out, number):
    """Writes the clouds of a file, beginning with a number; how many they were."""
    if file.suffix != ".npz":
        shutil.copy(file, out / f"cloud_bin_{number}.ply")
        return 1
    with np.load(file) as clouds:
        for offset, key in enumerate(("src", "ref")):
            write_ply(clouds[key], out / f"cloud_bin_{number + offset}.ply")
    return 2


def main():
    if len(sys.argv) < 4:
        raise SystemExit(__doc__)
    out = Path(sys.argv[1])
    out.mkdir(parents=True)
    place_of = []
    for place in sys.argv[2:]:
        name, _, files = place.partition("=")
        for file in files.split(","):
            place_of += [name] * copy_clouds(Path(file), out, len(place_of))
    numbers = range(len(place_of))
    apart = [(source, reference) for source in numbers for reference in numbers if place_of[source] != place_of[reference]]
    (out / "pairs.json").write_text(json.dumps([{"src": source, "ref": reference, "gt": NOWHERE} for source, reference in apart]))
    starts = [{"src": source, "ref": reference, "init": IDENTITY} for source, reference in apart]
    (out / "init_identity.json").write_text(json.dumps({"pairs": starts}))


if __name__ == "__main__":
    main()
