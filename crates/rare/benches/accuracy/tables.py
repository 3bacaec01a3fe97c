#!/usr/bin/env python3
"""Markdown tables of the refiner beside its peers, from JSON files of the accuracy harness.

    tables.py FOLDER_OR_JSON... [--data ROOT] [--success NAME=DEG,M]

Files of one folder, list of pairs and set of starts are put together, so that peers need to run once. `rare` is ours,
`init` the start, everything else a peer. With --data, errors are also taken against the refined ground truth
(`gt_refined`) where the lists of pairs below ROOT have it. Needs numpy.
"""
import argparse
import math
import sys
from pathlib import Path

import numpy as np

from runs import OURS, START, Group, Result, against, read_groups, read_truths, result_of, scoring

REFINED = "gt_refined"
RMSE = 0.2  # metres; 3DMatch


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", help="JSON files, or folders of nothing else")
    parser.add_argument("--data", help="root of the benchmark folders, for the refined ground truth")
    parser.add_argument("--success", action="append", default=[], metavar="NAME=DEG,M", help=scoring.SUCCESS_HELP)
    parser.add_argument("--self-check", action="store_true", help="check this program and end")
    return parser.parse_args()


def table(headings, rows):
    lines = ["| " + " | ".join(headings) + " |", "|" + "---|" * len(headings)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def mean_errors(scores):
    """`degrees / centimetres`, means over what is right among (degrees, metres, right)."""
    good = [(degrees, metres) for degrees, metres, right in scores if right]
    if not good:
        return "-"
    degrees, metres = np.mean(good, axis=0)
    return f"{degrees:.2f} / {100 * metres:.2f}"


def scores_of(results):
    return [(result.degrees, result.metres, result.right) for result in results]


def solved(results):
    return sum(result.right for result in results)


# ------------------------------------------------------------------------------------------------------- the tables


def overview(groups):
    headings = ["folder", "pairs", "start", "n", "start solved", "best peer solved", "ours solved",
                "ours RE deg / TE cm", "lost", "lost by RMSE", "median cpu s", "p95 cpu s"]
    return table(headings, [overview_row(group) for group in groups])


def overview_row(group):
    results = group.results
    start, ours = results.get(START), results.get(OURS)
    cells = [str(len(next(iter(results.values())))), "-" if start is None else str(solved(start)), best_peer(group)]
    if ours is None:
        return [group.name, *cells, *["-"] * 6]
    lost, lost_rmse = ("-", "-") if start is None else (
        str(sum(a.right and not b.right for a, b in zip(start, ours))),
        str(sum(a.rmse < RMSE <= b.rmse for a, b in zip(start, ours))))
    cpu = [result.cpu for result in ours]
    return [group.name, *cells, str(solved(ours)), mean_errors(scores_of(ours)), lost, lost_rmse,
            f"{np.median(cpu):.2f}", f"{np.percentile(cpu, 95):.2f}"]


def pooled(groups):
    """Ours over all starts: a row for each list of pairs, and one for everything."""
    lists = list(dict.fromkeys((group.folder, group.pairs) for group in groups))
    own = lambda one: [group for group in groups if (group.folder, group.pairs) == one]  # noqa: E731
    rows = [pooled_row(f"{folder} | {Path(pairs).stem}", own((folder, pairs))) for folder, pairs in lists]
    headings = ["folder", "pairs", "starts", "results", "solved", "%", "RE deg / TE cm", "lost", "lost by RMSE",
                "median cpu s", "p95 cpu s"]
    return table(headings, [*rows, pooled_row("all | all", groups)])


def pooled_row(name, groups):
    ours = [result for group in groups for result in group.results[OURS]]
    pairs = [(start, own) for group in groups if START in group.results
             for start, own in zip(group.results[START], group.results[OURS])]
    cpu = [result.cpu for result in ours]
    return [name, str(len(groups)), str(len(ours)), str(solved(ours)), f"{100 * solved(ours) / len(ours):.1f}",
            mean_errors(scores_of(ours)), str(sum(start.right and not own.right for start, own in pairs)),
            str(sum(start.rmse < RMSE <= own.rmse for start, own in pairs)),
            f"{np.median(cpu):.2f}", f"{np.percentile(cpu, 95):.2f}"]


def best_peer(group):
    peers = group.peers()
    if not peers:
        return "-"
    most = max(solved(group.results[name]) for name in peers)
    return f"{most} ({', '.join(name for name in peers if solved(group.results[name]) == most)})"


def ratios(ours, peer):
    """Mean degrees and metres of ours over those of the peer, and the number of pairs: those that both solve."""
    both = [(a[:2], b[:2]) for a, b in zip(ours, peer) if a[2] and b[2]]
    if not both:
        return None
    of_ours, of_peer = np.mean(both, axis=0)
    divide = lambda a, b: a / b if b > 0 else math.inf  # noqa: E731
    return divide(of_ours[0], of_peer[0]), divide(of_ours[1], of_peer[1]), len(both)


def ratio_table(compared):
    """`compared`: (name of a group, {method: scores}) with ours in each. The worst of all ratios are bold."""
    peers = list(dict.fromkeys(name for _, scores in compared for name in scores if name not in (OURS, START)))
    cells = {(group, peer): ratios(scores[OURS], scores[peer]) if peer in scores else None
             for group, scores in compared for peer in peers}
    found = [cell for cell in cells.values() if cell]
    if not found:
        return "No pair is solved by ours and by a peer.\n"
    worst = [max(cell[at] for cell in found) for at in (0, 1)]
    mark = lambda value, most: f"**{value:.2f}**" if value == most else f"{value:.2f}"  # noqa: E731
    show = lambda cell: "-" if cell is None else \
        f"{mark(cell[0], worst[0])} / {mark(cell[1], worst[1])} ({cell[2]})"  # noqa: E731
    rows = [[group, *(show(cells[group, peer]) for peer in peers)] for group, _ in compared]
    above = [sum(cell[at] > 1 for cell in found) for at in (0, 1)]
    summary = (f"Worst: RE x {worst[0]:.3f}, TE x {worst[1]:.3f}; above 1: RE {above[0]}, TE {above[1]} "
               f"of {len(found)}.\n")
    return table(["folder", "pairs", "start", *peers], rows) + "\n" + summary


def mean_table(compared):
    """Solved pairs and mean errors over them, of every method."""
    methods = list(dict.fromkeys(name for _, scores in compared for name in scores))
    show = lambda scores: f"{sum(right for *_, right in scores)}: {mean_errors(scores)}"  # noqa: E731
    rows = [[group, *(show(scores[name]) if name in scores else "-" for name in methods)] for group, scores in compared]
    return table(["folder", "pairs", "start", *methods], rows)


def failures(groups):
    rows = []
    for group in groups:
        for result in group.results.get(OURS, []):
            if not result.right:
                confidence = "-" if result.confidence is None else f"{result.confidence:.3f}"
                rows.append([group.name, f"{result.source} -> {result.reference}", f"{result.degrees:.2f}",
                             f"{result.metres:.3f}", confidence, result.verdict or "-"])
    return table(["folder", "pairs", "start", "pair", "RE deg", "TE m", "confidence", "verdict"], rows)


def compared_by_file(groups):
    return [(group.name, {name: scores_of(results) for name, results in group.results.items()}) for group in groups]


def compared_by_refined(groups, data, success):
    """Those groups whose pairs have a refined truth, scored against it."""
    found = []
    for group in groups:
        truths = read_truths(data, group, REFINED)
        if truths is not None:
            found.append((group.name, {name: against(group, results, truths, success)
                                       for name, results in group.results.items()}))
    return found


def report(groups, data, success):
    ours = [group for group in groups if OURS in group.results]
    high, low = ([group for group in ours if group.is_low_overlap == is_low] for is_low in (False, True))
    parts = [("All starts", overview(groups))]
    parts += [("Over all starts", pooled(ours))] if ours else []
    refined = lambda some: compared_by_refined(some, data, success) if data else []  # noqa: E731
    by_truth = [("gt", compared_by_file(high)), (REFINED, refined(high))]
    parts += [(f"More than 30 % overlap: RE and TE of ours over those of each peer, pairs that both solve, against "
               f"`{truth}`", ratio_table(compared)) for truth, compared in by_truth if compared]
    with_refined = refined(low)
    names = {name for name, _ in with_refined}
    both = [("gt", [one for one in compared_by_file(low) if one[0] in names]), (REFINED, with_refined)]
    parts += [(f"Low overlap: solved, and mean RE deg / TE cm over them, against `{truth}`", mean_table(compared))
              for truth, compared in both if compared]
    parts.append(("Failures of ours", failures(groups)))
    return "\n".join(f"**{title}**\n\n{text}" for title, text in parts)


def main():
    arguments = parse_arguments()
    if arguments.self_check:
        return self_check()
    success = scoring.Success(arguments.success)
    print(report(read_groups(arguments.paths, success), arguments.data, success))


# ------------------------------------------------------------------------------------------------------- self-check


def made_up(method_errors, pairs="pairs.json"):
    """A group whose methods have these (degrees, metres)."""
    group = Group("frag50", pairs, "init_kiss.json")
    success = scoring.Success()
    for name, wrong_by in method_errors.items():
        rows = [dict(src=9 - at, ref=0, re=re, te=te, rmse=te, cpu=1.0 + at) for at, (re, te) in enumerate(wrong_by)]
        group.results[name] = [result_of("frag50", row, success) for row in rows]
    return group


def self_check():
    group = made_up({START: [(1, 0.1), (2, 0.1), (90, None), (90, 2)], "p2l": [(1, 0.1), (40, 0.1), (90, 2), (90, 2)],
                     "gicp": [(2, 0.2), (40, 0.1), (3, 0.1), (90, 2)],
                     OURS: [(2, 0.1), (20, 0.4), (1, 0.2), (1, 0.05)]})
    row = overview_row(group)
    assert row == ["frag50 | pairs | kiss", "4", "2", "2 (gicp)", "3", "1.33 / 11.67", "1", "1", "2.50", "3.85"], row
    assert pooled_row("a", [group, group]) == ["a", "2", "8", "6", "75.0", "1.33 / 11.67", "2", "2", "2.50", "4.00"]
    assert ratios(*(scores_of(group.results[name]) for name in (OURS, "p2l"))) == (2.0, 1.0, 1)
    degrees, metres, count = ratios(*(scores_of(group.results[name]) for name in (OURS, "gicp")))
    assert abs(degrees - 3 / 5) < 1e-12 and abs(metres - 1.0) < 1e-12 and count == 2
    text = ratio_table(compared_by_file([group]))
    assert "**2.00** / **1.00** (1) | 0.60 / **1.00** (2)" in text and "above 1: RE 1, TE 0 of 2" in text, text
    assert failures([group]).split("\n")[2:] == ["| frag50 | pairs | kiss | 8 -> 0 | 20.00 | 0.400 | - | - |", ""]
    assert "2: 2.50 / 15.00" in mean_table(compared_by_file([group]))
    # Against another truth a pose that was right may be wrong.
    turned = np.eye(4)
    turned[0, 3] = 0.25
    moved = Result(9, 0, turned, 0, 0.1, 0.1, 1, None, None, True)
    assert against(group, [moved], {(9, 0): np.eye(4)}, scoring.Success()) == [(0.0, 0.25, True)]
    turned[0, 3] = 0.35
    assert against(group, [moved], {(9, 0): np.eye(4)}, scoring.Success()) == [(0.0, 0.35, False)]
    assert made_up({}, "pairs_lo.json").is_low_overlap and not group.is_low_overlap
    assert "frag50 | pairs | kiss" in report([group], None, scoring.Success())
    print("self-check passed", file=sys.stderr)


if __name__ == "__main__":
    main()
