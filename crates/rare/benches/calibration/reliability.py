"""How good confidences are: area under the ROC curve, calibration error, failures among what is accepted, a plot."""
import sys
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import scoring  # noqa: E402

BINS = 10


@dataclass
class Figures:
    """What is said of a set of results."""

    count: int
    right: int
    auc: float | None  # none if all or none are right
    ece: float
    accepted: int
    failures: int  # wrong results among the accepted ones

    @staticmethod
    def of(confidence, right, threshold):
        accepted = confidence >= threshold
        return Figures(len(right), int(right.sum()), auc(confidence, right), calibration_error(confidence, right),
                       int(accepted.sum()), int((accepted & ~right).sum()))

    def cells(self):
        low, high = scoring.wilson(self.failures, self.accepted)
        share = f"{100 * self.failures / self.accepted:.1f}" if self.accepted else "-"
        return [str(self.count), str(self.right), "-" if self.auc is None else f"{self.auc:.4f}", f"{self.ece:.4f}",
                str(self.accepted), str(self.failures), f"{share} ({100 * low:.1f} to {100 * high:.1f})"]


HEADINGS = ["results", "right", "AUC", "ECE", "accepted", "failures", "failures % (95 % interval)"]


def auc(confidence, right):
    """The chance that a right result has more confidence than a wrong one; ties count half."""
    if right.all() or not right.any():
        return None
    wrong = np.sort(confidence[~right])
    below = np.searchsorted(wrong, confidence[right], "left")
    not_above = np.searchsorted(wrong, confidence[right], "right")
    return float((below + not_above).mean() / 2 / len(wrong))


def bins(confidence, right):
    """(number, mean confidence, right results, results) of every bin of equal width that is not empty."""
    index = np.minimum((confidence * BINS).astype(int), BINS - 1)
    members = [(number, index == number) for number in range(BINS)]
    return [(number, float(confidence[m].mean()), int(right[m].sum()), int(m.sum())) for number, m in members if m.any()]


def calibration_error(confidence, right):
    """The mean over all results of how far the confidence of their bin is from its share of right results."""
    return sum(abs(mean * count - good) for _, mean, good, count in bins(confidence, right)) / len(right)


def plot(confidence, right, title):
    """An SVG: the share of right results over the mean confidence of each bin, with 95 % intervals and counts."""
    x = lambda value: 70 + 400 * value  # noqa: E731
    y = lambda value: 450 - 400 * value  # noqa: E731
    text = lambda u, v, words, more="": f'<text x="{u:.1f}" y="{v:.1f}" {more}>{words}</text>'  # noqa: E731
    middle, end = 'text-anchor="middle"', 'text-anchor="end"'
    lines = ['<svg xmlns="http://www.w3.org/2000/svg" width="500" height="510" viewBox="0 0 500 510" '
             'font-family="sans-serif" font-size="12" fill="#333">', '<rect width="500" height="510" fill="#fff"/>']
    for tenth in range(0, 11, 2):
        value = tenth / 10
        lines.append(f'<path d="M{x(value)} {y(0)}V{y(1)}M{x(0)} {y(value)}H{x(1)}" stroke="#e4e4e4"/>')
        lines += [text(x(value), 468, f"{value:.1f}", middle), text(62, y(value) + 4, f"{value:.1f}", end)]
    lines.append(f'<path d="M{x(0)} {y(0)}L{x(1)} {y(1)}" stroke="#999" stroke-dasharray="5 4"/>')
    found = bins(confidence, right)
    points = " ".join(f"{x(mean):.1f},{y(good / count):.1f}" for _, mean, good, count in found)
    lines.append(f'<polyline points="{points}" fill="none" stroke="#9bc0e6"/>')
    for number, mean, good, count in found:
        low, high = scoring.wilson(good, count)
        lines.append(f'<path d="M{x(mean):.1f} {y(low):.1f}V{y(high):.1f}" stroke="#1f6fb4"/>')
        lines.append(f'<circle cx="{x(mean):.1f}" cy="{y(good / count):.1f}" r="4" fill="#1f6fb4"/>')
        # Above the bin, where no line runs.
        lines.append(text(x((number + 0.5) / BINS), 44, count, middle))
    lines += [text(270, 22, escape(title), f'{middle} font-size="14"'), text(270, 495, "confidence", middle),
              text(62, 44, "results", end),
              text(20, 250, "share of right results", f'{middle} transform="rotate(-90 20 250)"'), "</svg>"]
    return "\n".join(lines) + "\n"
