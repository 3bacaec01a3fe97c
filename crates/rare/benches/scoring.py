"""When a pose counts as right: errors of poses, thresholds by folder, intervals of shares. Needs numpy."""
import fnmatch
import math

import numpy as np

INDOOR = (15.0, 0.3)
OUTDOOR = (5.0, 0.6)
# The first pattern that fits the name of the folder decides.
CUSTOMARY = (("lidar*", OUTDOOR), ("street*", OUTDOOR), ("*", INDOOR))
SUCCESS_HELP = "RE in degrees and TE in metres below which a pose is right in folders of this name (may have * and ?); " \
    "may repeat; otherwise lidar*=5,0.6, street*=5,0.6, *=15,0.3"


class Success:
    """The errors below which a pose counts as right: degrees and metres, by the name of the folder."""

    def __init__(self, given=()):
        self.rules = [self.parse(rule) for rule in given] + list(CUSTOMARY)

    @staticmethod
    def parse(rule):
        name, _, numbers = rule.partition("=")
        try:
            degrees, metres = (float(number) for number in numbers.split(","))
        except ValueError:
            raise SystemExit(f"--success {rule}: expected NAME=DEGREES,METRES") from None
        return name, (degrees, metres)

    def limits(self, folder):
        return next(limits for pattern, limits in self.rules if fnmatch.fnmatchcase(folder, pattern))

    def holds(self, folder, degrees, metres):
        most = self.limits(folder)
        return degrees < most[0] and metres < most[1]


def errors(pose, truth):
    """The angle in degrees and the distance of the translations in metres; (180, inf) if `pose` is no rigid transform."""
    if pose is None or not is_rigid(pose):
        return 180.0, math.inf
    turn = pose[:3, :3].T @ truth[:3, :3]
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = math.atan2(np.linalg.norm(axis) / 2, (np.trace(turn) - 1) / 2)
    return math.degrees(angle), float(np.linalg.norm(pose[:3, 3] - truth[:3, 3]))


def is_rigid(pose):
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return False
    turn = pose[:3, :3]
    return np.abs(turn @ turn.T - np.eye(3)).max() < 1e-2 and np.linalg.det(turn) > 0


def wilson(count, total, z=1.959964):
    """The 95 % interval of a share (Wilson, 1927); (0, 1) without a sample."""
    if total == 0:
        return 0.0, 1.0
    share, widening = count / total, z * z / total
    centre = (share + widening / 2) / (1 + widening)
    half = z / (1 + widening) * math.sqrt(share * (1 - share) / total + widening / (4 * total))
    # At the ends the formula is exact, its rounding is not.
    return max(0.0, centre - half) if count else 0.0, min(1.0, centre + half) if count < total else 1.0
