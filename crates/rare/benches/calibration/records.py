"""Reads what evaluations left: results of `rare eval folder`, and the JSON files of the accuracy harness."""
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import scoring  # noqa: E402


@dataclass
class Row:
    """A result: of which pair, whether it is right, and what the refiner said about it."""

    folder: str
    pair: tuple
    position: int  # of the pair in its list
    right: bool
    confidence: float | None  # none after an error
    signals: dict | None

    @property
    def key(self):
        return self.folder, *self.pair


def read_all(paths, method, success):
    """The rows of files and of all folders of results at or below the paths, in a fixed order."""
    rows = []
    for path in map(Path, paths):
        files = [path] if path.is_file() else sorted(path.rglob("results.jsonl")) or sorted(path.rglob("*.json"))
        if not files:
            raise SystemExit(f"{path}: no results.jsonl and no file of the accuracy harness here or below")
        for file in files:
            read = read_results if file.name == "results.jsonl" else read_harness
            rows += read(file, method, success)
    if not rows:
        raise SystemExit("no row of the method was found: name another with --method")
    return rows


def read_results(file, method, success):
    """A `results.jsonl` with the `benchmark.json` beside it."""
    benchmark = json.loads((file.parent / "benchmark.json").read_text())
    folder, pairs, rows = benchmark["name"], benchmark["pairs"], []
    # What follows the last end of line was being written when its process died.
    for line in file.read_text().split("\n")[:-1]:
        found = json.loads(line)
        if found["method"] != (method or "refine"):
            continue
        pair = pairs[found["pair"]]
        pose = found.get("target_from_source")
        truth = np.array(pair["target_from_source"], float)
        wrong_by = scoring.errors(None if pose is None else np.array(pose, float), truth)
        rows.append(Row(folder, (pair["source"], pair["reference"]), found["pair"],
                        success.holds(folder, *wrong_by), found.get("confidence"), found.get("signals")))
    return rows


def read_harness(file, method, success):
    """A JSON file of the accuracy harness, which keeps confidences but no signals."""
    run = json.loads(file.read_text())
    if not isinstance(run, dict) or not {"bench", "detail"} <= run.keys():
        raise SystemExit(f"{file}: neither a results.jsonl nor a file of the accuracy harness")
    folder, rows = Path(run["bench"]).name, []
    for position, found in enumerate(run["detail"].get(method or "rare", [])):
        metres = math.inf if found["te"] is None else found["te"]
        rows.append(Row(folder, (found["src"], found["ref"]), position,
                        success.holds(folder, found["re"], metres), found.get("confidence"), None))
    return rows
