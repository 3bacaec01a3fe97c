#!/usr/bin/env python3
"""Tables of what each part of the refiner brings, from the folders that ablation.sh wrote.

    ablation.py OUT [--success 'objects*=15,0.025']

A line is a variant on one list of pairs of one folder, over all its starts: solved results of all, results that were
solved by the start and are not any more, and mean errors over those that every variant solves. Needs numpy.
"""
import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from runs import scoring

FIRST = "everything"
METHOD, START = "refine", "init"


def read(folder, success):
    """{(start, pair): (solved, solved by the start, degrees, metres)} of one folder of results."""
    benchmark = json.loads((folder / "benchmark.json").read_text())
    found = {}
    for line in (folder / "results.jsonl").read_text().splitlines():
        result = json.loads(line)
        pose = result.get("target_from_source")
        truth = np.array(benchmark["pairs"][result["pair"]]["target_from_source"], float)
        errors = scoring.errors(None if pose is None else np.array(pose, float), truth)
        found[result["method"], result["pair"]] = (success.holds(benchmark["name"], *errors), *errors)
    start = folder.name.rsplit(".", 1)[1]
    of_start = lambda pair: found[START, pair][0]  # noqa: E731
    return {(start, pair): (solved, of_start(pair), *rest)
            for (method, pair), (solved, *rest) in found.items() if method == METHOD}


def read_variant(folder, success):
    """{FOLDER.PAIRS: results} of one variant."""
    groups = {}
    for path in sorted(folder.iterdir()):
        groups.setdefault(path.name.rsplit(".", 1)[0], {}).update(read(path, success))
    return groups


def rows(variants):
    """`variants`: {name: {group: results}}; cells of the table, group by group."""
    order = sorted(variants, key=lambda name: (name != FIRST, name))
    for group in sorted({group for groups in variants.values() for group in groups}):
        own = {name: variants[name][group] for name in order if group in variants[name]}
        common = [key for key in next(iter(own.values()))
                  if all(key in results and results[key][0] for results in own.values())]
        for name, results in own.items():
            solved = sum(result[0] for result in results.values())
            lost = sum(result[1] and not result[0] for result in results.values())
            degrees, metres = np.mean([results[key][2:4] for key in common], axis=0) if common else (np.nan, np.nan)
            folder, pairs = group.rsplit(".", 1)
            yield [folder, pairs, name, f"{solved} of {len(results)}", str(lost),
                   f"{degrees:.2f} / {100 * metres:.2f} ({len(common)})"]


def table(lines):
    head = ["folder", "pairs", "variant", "solved", "lost", "RE deg / TE cm (where all solve)"]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, ["---"] * len(head), *lines])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, help="what ablation.sh wrote")
    parser.add_argument("--success", action="append", default=[], metavar="NAME=DEG,M", help=scoring.SUCCESS_HELP)
    parser.add_argument("--self-check", action="store_true", help="check this program and end")
    arguments = parser.parse_args()
    if arguments.self_check:
        return self_check()
    if arguments.folder is None or not arguments.folder.is_dir():
        raise SystemExit("name the folder that ablation.sh wrote")
    success = scoring.Success(arguments.success)
    variants = {path.name: read_variant(path, success) for path in sorted(arguments.folder.iterdir())}
    print(table(rows(variants)))


def self_check():
    """Two pairs: one is lost by the second variant, the other solved by both."""
    pose = lambda metres: [[1, 0, 0, metres], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]  # noqa: E731
    pairs = [{"target_from_source": pose(1.0)}, {"target_from_source": pose(2.0)}]
    line = lambda pair, method, metres: json.dumps(  # noqa: E731
        {"pair": pair, "method": method, "target_from_source": pose(metres)}) + "\n"
    with tempfile.TemporaryDirectory() as name:
        for variant, first in (("everything", 1.1), ("no-polish", 1.4)):
            folder = Path(name) / variant / "frag50.pairs.init_a"
            folder.mkdir(parents=True)
            (folder / "benchmark.json").write_text(json.dumps({"name": "frag50", "pairs": pairs}))
            (folder / "results.jsonl").write_text(
                line(0, "init", 1.0) + line(0, "refine", first) + line(1, "init", 9.0) + line(1, "refine", 2.2))
        variants = {path.name: read_variant(path, scoring.Success()) for path in Path(name).iterdir()}
    found = list(rows(variants))
    assert found == [["frag50", "pairs", "everything", "2 of 2", "0", "0.00 / 20.00 (1)"],
                     ["frag50", "pairs", "no-polish", "1 of 2", "1", "0.00 / 20.00 (1)"]], found
    print("self-check passed", file=sys.stderr)


if __name__ == "__main__":
    main()
