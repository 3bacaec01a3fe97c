#!/usr/bin/env python3
"""Fit the model of the confidence to results of `rare eval folder`, and say how good it is on data it has not seen.

    rare eval folder DATA --pairs pairs.json --init init_NAME.json --methods refine --out RESULTS/DATA.pairs.NAME
    fit.py RESULTS... [--success 'objects*=15,0.025'] [--hold-out] [--plot reliability.svg]
    fit.py --as-reported RESULTS... HARNESS.json...

A folder of results is read with all folders below it. The model is `confidence = 1 / (1 + exp(-(intercept + sum
coefficient * signal)))`, fitted by ridge logistic regression; every pair of clouds has the same total weight, however
many starts it has, and those of different places have a fixed share of the whole; coefficients whose sign contradicts
their signal are left out. It is printed as a constant of Rust. Then every folder of --leave-out is predicted by a model that was
fitted without it, and the predictions of all of them are scored together; other folders (simulated ones) are always in
the training set. A result without a pose or a confidence counts as confidence 0 and is not fitted.

With --as-reported nothing is fitted: the confidences in the files are scored, also those in JSON files of the accuracy
harness. Needs numpy.
"""
import argparse
import json
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

import logistic
import reliability
from records import Row, read_all, scoring

LEAVE_OUT = "frag50,frag20,scan1,lidar-dev"
# How often clouds are taken to have nothing in common, which no benchmark tells: the share of the weight of such pairs.
SHARE_OF_DIFFERENT_PLACES = 0.15
UNSEEN, HELD_OUT, FITTED = "all left out", "held out", "fitted on it"


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", help="folders of results (and JSON files with --as-reported)")
    parser.add_argument("--method", help="whose results (refine; rare in JSON files)")
    parser.add_argument("--success", action="append", default=[], metavar="NAME=DEG,M", help=scoring.SUCCESS_HELP)
    parser.add_argument("--penalty", type=float, default=1.0, help="of the squared coefficients of standardised signals")
    parser.add_argument("--threshold", type=float, default=0.5, help="confidence from which a result is accepted")
    parser.add_argument("--leave-out", default=LEAVE_OUT, help=f"folders that are predicted unseen ({LEAVE_OUT})")
    parser.add_argument("--hold-out", action="store_true",
                        help="leave a third of scan1 and two thirds of different* out of all fits, score them apart")
    parser.add_argument("--as-reported", action="store_true", help="score the confidences in the files, fit nothing")
    parser.add_argument("--plot", type=Path, help="write a reliability plot of the unseen results (SVG)")
    parser.add_argument("--self-check", action="store_true", help="check this program and end")
    return parser.parse_args()


def is_of_different_places(row):
    return row.folder.startswith("different")


def is_held_out(row):
    """A third of scan1; and two thirds of the pairs of different places, which are easily made and must not outweigh what
    belongs together."""
    if is_of_different_places(row):
        return row.position % 3 != 0
    return row.folder == "scan1" and row.position % 3 == 2


def has_signals(row):
    return row.confidence is not None and bool(row.signals)


def names_of_signals(rows):
    """The names, which all rows must have."""
    silent = next((row for row in rows if row.confidence is not None and not row.signals), None)
    if silent:
        raise SystemExit(f"{silent.folder}, pair {silent.pair}: no signals to fit: evaluate again, or use --as-reported")
    found = {name for row in rows if has_signals(row) for name in row.signals}
    known = list(logistic.SIGNS)
    names = sorted(found, key=lambda name: (known.index(name) if name in known else len(known), name))
    for row in filter(has_signals, rows):
        lacking = [name for name in names if row.signals.get(name) is None]
        if lacking:
            raise SystemExit(f"{row.folder}, pair {row.pair}: no signal {lacking[0]}: results of different versions?")
    return names


def values_of(rows, names):
    return np.array([[row.signals[name] for name in names] for row in rows], float).reshape(len(rows), len(names))


def weights_of(rows):
    """Every pair weighs 1, however many starts it has; but those of different places have their share of the whole."""
    count = Counter(row.key for row in rows)
    weights = np.array([1 / count[row.key] for row in rows])
    apart = np.array([is_of_different_places(row) for row in rows])
    if apart.any() and not apart.all():
        weights[apart] *= SHARE_OF_DIFFERENT_PLACES / (1 - SHARE_OF_DIFFERENT_PLACES) * weights[~apart].sum() / weights[apart].sum()
    return weights


def fit(rows, names, penalty):
    """A model of the rows that have signals."""
    rows = [row for row in rows if has_signals(row)]
    if not rows:
        raise SystemExit("nothing is left to fit when a folder is left out: add results of other folders")
    right = np.array([row.right for row in rows])
    if right.all() or not right.any():
        raise SystemExit(f"all {len(rows)} results to be fitted are {'right' if right.all() else 'wrong'}: add others")
    signs = [logistic.SIGNS.get(name, 0) for name in names]
    return logistic.fit_signed(values_of(rows, names), right, weights_of(rows), penalty, signs)


def predict(model, rows, names):
    confidence = np.zeros(len(rows))
    known = np.array([has_signals(row) for row in rows], bool)
    confidence[known] = model.probability(values_of([row for row in rows if has_signals(row)], names))
    return confidence


def reported(rows):
    return np.array([row.confidence or 0.0 for row in rows])


def refitted(rows, held, folders, arguments):
    """(name, rows, confidences) of everything to be scored, by models that did not see it unless the name says so."""
    names = names_of_signals(rows + held)
    model = fit(rows, names, arguments.penalty)
    print(f"fitted on {len({row.key for row in rows})} pairs, {sum(map(has_signals, rows))} results, "
          f"penalty {arguments.penalty:g}\n\n{model.rust('CONFIDENCE')}\n// {', '.join(names)}\n")
    parts = []
    for folder in folders:
        unseen = [row for row in rows if row.folder == folder]
        without = fit([row for row in rows if row.folder != folder], names, arguments.penalty)
        parts.append((folder, unseen, predict(without, unseen, names)))
    parts += [(f"{folder} ({HELD_OUT})", own, predict(model, own, names)) for folder, own in by_folder(held)]
    seen = [row for row in rows if row.folder not in folders]
    return parts + [(f"{folder} ({FITTED})", own, predict(model, own, names)) for folder, own in by_folder(seen)]


def by_folder(rows):
    return [(folder, [row for row in rows if row.folder == folder]) for folder in sorted({row.folder for row in rows})]


def as_reported(rows, held):
    parts = [(folder, own, reported(own)) for folder, own in by_folder(rows)]
    return parts + [(f"{folder} ({HELD_OUT})", own, reported(own)) for folder, own in by_folder(held)]


def score(parts, folders, arguments):
    """Prints the table and writes the plot."""
    print("| folder | " + " | ".join(reliability.HEADINGS) + " |\n|---" + "|---" * len(reliability.HEADINGS) + "|")
    pooled = [(rows, confidence) for name, rows, confidence in parts if name in folders]
    right = np.array([row.right for rows, _ in pooled for row in rows], bool)
    confidence = np.concatenate([confidence for _, confidence in pooled]) if pooled else np.zeros(0)
    if len(right):
        print_line(UNSEEN if not arguments.as_reported else "all of these", confidence, right, arguments.threshold)
    for name, rows, own in parts:
        print_line(name, own, np.array([row.right for row in rows], bool), arguments.threshold)
    if arguments.plot:
        if not len(right):
            raise SystemExit(f"nothing to plot: there are no results of {', '.join(folders) or arguments.leave_out}")
        arguments.plot.write_text(reliability.plot(confidence, right, f"{len(right)} results: {', '.join(folders)}"))


def print_line(name, confidence, right, threshold):
    cells = reliability.Figures.of(confidence, right, threshold).cells()
    print("| " + " | ".join([name, *cells]) + " |")


def main():
    arguments = parse_arguments()
    if arguments.self_check:
        return self_check()
    rows = read_all(arguments.paths, arguments.method, scoring.Success(arguments.success))
    held = [row for row in rows if is_held_out(row)] if arguments.hold_out else []
    rows = [row for row in rows if not (arguments.hold_out and is_held_out(row))]
    present = {row.folder for row in rows}
    folders = [folder for folder in arguments.leave_out.split(",") if folder in present]
    if arguments.as_reported:
        folders = folders or sorted(present)
        parts = as_reported(rows, held)
    else:
        parts = refitted(rows, held, folders, arguments)
    score(parts, folders, arguments)


# ------------------------------------------------------------------------------------------------------- self-check


def simulated(seed, count, folders):
    """Rows that follow a known model, three starts a pair."""
    random = np.random.default_rng(seed)
    rows = []
    for number in range(count):
        first, second = random.normal(size=2)
        odds = 0.5 + 2.0 * first - 30.0 * 0.1 * second
        right = bool(random.uniform() < logistic.logistic(odds))
        rows.append(Row(folders[number // 3 % len(folders)], (number // 3, 0), number // 3, right, 0.5,
                        {"first": first, "second": 0.1 * second + 7.0, "still": 1.0}))
    return rows


def check_fit():
    rows = simulated(1, 60_000, ["a", "b"])
    names = names_of_signals(rows)
    model = fit(rows, names, 1.0)
    expected = [2.0, -30.0, 0.0]
    assert np.allclose(model.coefficients, expected, rtol=0.05), model
    assert abs(model.intercept - 210.5) < 0.05 * 210.5, model
    odds = values_of(rows[:5], names) @ model.coefficients + model.intercept
    truth = values_of(rows[:5], names) @ np.array(expected) + 210.5
    assert np.allclose(odds, truth, atol=0.25), (odds, truth)
    # The gradient of the penalised loss vanishes: one signal, by hand on standardised values.
    signals, right = np.array([[-1.0], [1.0], [-1.0], [1.0]]), np.array([False, True, True, True])
    small = logistic.fit(signals, right, np.ones(4), 2.0)
    share = small.probability(signals)
    assert abs(signals[:, 0] @ (right - share) - 2.0 * small.coefficients[0]) < 1e-8
    # A pair weighs the same with one start as with many.
    few, many = simulated(2, 300, ["a"]), simulated(2, 300, ["a"])
    first = [row for row in many if row.pair == (0, 0)]
    assert np.allclose(fit(few, names, 1.0).coefficients, fit(many + first, names, 1.0).coefficients)
    # A sign that contradicts the signal is not believed, and the others are fitted without it.
    signs = [1, 1, 0]
    signed = logistic.fit_signed(values_of(rows, names), *target_of(rows), 1.0, signs)
    assert signed.coefficients[1] == 0.0 and 0.5 < signed.coefficients[0] < 2.0, signed
    assert logistic.Model(-1.0, np.array([-0.001, 2.0])).rust("X").endswith(
        "Model { intercept: -1.00, coefficients: [0.00, 2.00] };")
    # What separates perfectly still has a finite fit, and errors are left alone.
    clear = [Row("a", (n, 0), n, n > 5, 0.5, {"x": float(n)}) for n in range(12)]
    failed = Row("a", (99, 0), 99, False, None, None)
    assert np.isfinite(fit(clear + [failed], ["x"], 1.0).coefficients).all()
    assert predict(fit(clear, ["x"], 1.0), [failed, clear[-1]], ["x"])[0] == 0.0


def target_of(rows):
    return np.array([row.right for row in rows]), np.ones(len(rows))


def check_figures():
    confidence, right = np.array([0.95, 0.85, 0.4, 0.4, 0.1]), np.array([True, False, True, False, False])
    # Of the 6 comparisons 0.95 wins 3; 0.4 wins 1 and ties 1.
    assert abs(reliability.auc(confidence, right) - 4.5 / 6) < 1e-12
    assert reliability.auc(confidence, np.ones(5, bool)) is None
    # |0.95 - 1| + |0.85 - 0| + 2 |0.4 - 0.5| + |0.1 - 0|, over 5.
    assert abs(reliability.calibration_error(confidence, right) - (0.05 + 0.85 + 0.2 + 0.1) / 5) < 1e-12
    figures = reliability.Figures.of(confidence, right, 0.5)
    assert (figures.accepted, figures.failures) == (2, 1)
    assert reliability.Figures.of(confidence, right, 0.9).failures == 0
    low, high = scoring.wilson(1, 10)
    assert abs(low - 0.0179) < 1e-4 and abs(high - 0.4042) < 1e-4, (low, high)
    assert scoring.wilson(0, 0) == (0.0, 1.0) and scoring.wilson(0, 10)[0] == 0.0
    turned = np.array([[0.75**0.5, -0.5, 0, 3], [0.5, 0.75**0.5, 0, 4], [0, 0, 1, 0], [0, 0, 0, 1]])
    degrees, metres = scoring.errors(turned, np.eye(4))
    assert abs(degrees - 30) < 1e-9 and abs(metres - 5) < 1e-12
    assert scoring.errors(2 * turned, np.eye(4)) == (180.0, float("inf"))
    success = scoring.Success(["objects*=3,0.02"])
    assert success.limits("objects-a") == (3.0, 0.02) and success.limits("lidar-dev") == (5.0, 0.6)
    assert success.holds("frag50", 14.9, 0.29) and not success.holds("frag50", 14.9, 0.3)


def check_split():
    """The figures of a folder come from a fit without it, those of the others do not."""
    rows = simulated(3, 600, ["frag50", "frag20", "scan1", "rooms"])
    held = [row for row in rows if is_held_out(row)]
    assert held and all(row.folder == "scan1" for row in held)
    options = argparse.Namespace(penalty=1.0)
    parts = {name: own for name, _, own in refitted(rows, [], ["frag50", "scan1"], options)}
    assert list(parts) == ["frag50", "scan1", f"frag20 ({FITTED})", f"rooms ({FITTED})"]
    names = names_of_signals(rows)
    unseen = [row for row in rows if row.folder == "frag50"]
    other = fit([row for row in rows if row.folder != "frag50"], names, 1.0)
    assert np.array_equal(parts["frag50"], predict(other, unseen, names))
    assert not np.allclose(parts["frag50"], predict(fit(rows, names, 1.0), unseen, names), atol=1e-6)


def check_reading():
    """Results of every kind: right, wrong, without a pose, of another method, half a line; and a file of the harness."""
    pose = lambda metres: [[1, 0, 0, metres], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]  # noqa: E731
    pairs = [{"source": number, "reference": 0, "target_from_source": pose(1.0)} for number in (5, 6, 7)]
    found = [{"pair": 2, "method": "refine", "target_from_source": pose(1.4), "confidence": 0.7, "signals": {"x": 1}},
             {"pair": 0, "method": "refine", "target_from_source": None, "confidence": None},
             {"pair": 1, "method": "gicp", "target_from_source": pose(1.0), "confidence": None}]
    with tempfile.TemporaryDirectory() as name:
        results, harness = Path(name) / "a" / "results.jsonl", Path(name) / "harness.json"
        results.parent.mkdir()
        (results.parent / "benchmark.json").write_text(json.dumps({"name": "street-1", "pairs": pairs}))
        results.write_text("".join(json.dumps(line) + "\n" for line in found) + '{"pair": 1, "me')
        rows = [{"src": 6, "ref": 0, "re": 1.0, "te": 0.4, "confidence": 0.9}, {"src": 7, "ref": 0, "re": 1.0, "te": None}]
        harness.write_text(json.dumps({"bench": "some/frag50", "detail": {"rare": rows, "p2l": []}}))
        read = read_all([name, harness], None, scoring.Success())
    # 0.4 m is right outdoors and wrong indoors.
    assert [(row.key, row.position, row.right, row.confidence) for row in read] == [
        (("street-1", 7, 0), 2, True, 0.7), (("street-1", 5, 0), 0, False, None),
        (("frag50", 6, 0), 0, False, 0.9), (("frag50", 7, 0), 1, False, None)], read
    assert [row.signals for row in read] == [{"x": 1}, None, None, None]


def self_check():
    check_reading()
    check_fit()
    check_figures()
    check_split()
    print("self-check passed", file=sys.stderr)


if __name__ == "__main__":
    main()
