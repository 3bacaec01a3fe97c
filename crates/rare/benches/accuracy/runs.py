"""Reads JSON files of the accuracy harness: one group for a folder, a list of pairs and a set of starts."""
import json
import math
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import scoring  # noqa: E402

OURS = "rare"
START = "init"


@dataclass
class Result:
    """What a method made of a pair."""

    source: int
    reference: int
    pose: np.ndarray | None
    degrees: float
    metres: float
    rmse: float
    cpu: float
    confidence: float | None
    verdict: str | None
    right: bool

    @property
    def pair(self):
        return self.source, self.reference


@dataclass
class Group:
    """All methods on the pairs of one list from one set of starts."""

    folder: str
    pairs: str
    start: str
    results: dict = field(default_factory=dict)  # of a method: its results in the order of the list

    @property
    def is_low_overlap(self):
        # The lists follow 3DMatch (more than 30 % overlap) and 3DLoMatch (10 to 30 %).
        return "_lo" in self.pairs

    @property
    def name(self):
        return f"{self.folder} | {Path(self.pairs).stem} | {Path(self.start).stem.removeprefix('init_')}"

    def peers(self):
        return [name for name in self.results if name not in (OURS, START)]


def read_groups(paths, success):
    """The groups of all JSON files at or below the paths, in the order of their names."""
    groups = {}
    for path in map(Path, paths):
        files = [path] if path.is_file() else sorted(path.rglob("*.json"))
        for file in files:
            run = json.loads(file.read_text())
            if not isinstance(run, dict) or not {"bench", "pairs", "init", "detail"} <= run.keys():
                raise SystemExit(f"{file}: not a file of the accuracy harness")
            if run.get("gt", "gt") != "gt":
                raise SystemExit(f"{file}: scored against {run['gt']!r}: run it with the ground truth 'gt'")
            key = Path(run["bench"]).name, run["pairs"], run["init"]
            add(groups.setdefault(key, Group(*key)), run["detail"], file, success)
    if not groups:
        raise SystemExit("there are no files of the accuracy harness")
    return [groups[key] for key in sorted(groups)]


def add(group, detail, file, success):
    """Adds the methods of a file; a method that another file has already must have the same poses."""
    for name, rows in detail.items():
        results = [result_of(group.folder, row, success) for row in rows]
        for other, known in group.results.items():
            if [result.pair for result in known] != [result.pair for result in results]:
                raise SystemExit(f"{file}: {name} has other pairs than {other} on {group.name}")
        known = group.results.setdefault(name, results)
        if [result.degrees for result in known] != [result.degrees for result in results]:
            raise SystemExit(f"{file}: a second, different run of {name} on {group.name}")


def result_of(folder, row, success):
    # JSON has no infinity: the harness writes null.
    number = lambda name: math.inf if row[name] is None else float(row[name])  # noqa: E731
    pose = None if row.get("T") is None else np.array(row["T"], float)
    return Result(row["src"], row["ref"], pose, number("re"), number("te"), number("rmse"), number("cpu"),
                  row.get("confidence"), row.get("verdict"), success.holds(folder, number("re"), number("te")))


def against(group, results, truths, success):
    """(degrees, metres, right) of results against truths by pair: another truth than that of the file."""
    wrong_by = [scoring.errors(result.pose, truths[result.pair]) for result in results]
    return [(degrees, metres, success.holds(group.folder, degrees, metres)) for degrees, metres in wrong_by]


def read_truths(data, group, key):
    """The truths `key` of a group's pairs from its list below `data`; none if the list has no such truth."""
    lists = sorted(Path(data).rglob(f"{group.folder}/{group.pairs}"))
    if not lists:
        raise SystemExit(f"{data}: there is no {group.folder}/{group.pairs} below it")
    truths = {(pair["src"], pair["ref"]): pair.get(key) for pair in json.loads(lists[0].read_text())}
    known = {pair: np.array(truth, float) for pair, truth in truths.items() if truth is not None}
    needed = {result.pair for results in group.results.values() for result in results}
    return known if needed <= known.keys() else None
