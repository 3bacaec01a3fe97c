"""Ridge logistic regression by Newton's method."""
from dataclasses import dataclass

import numpy as np

# The signals of `Evidence::signals`, in its order, and whether more of each speaks for a pose or against it. Where a fit
# says the opposite, it has learned an accident of its data.
SIGNS = {"agreement": 1, "occlusion": -1, "gross_violations": -1, "normal_agreement": 1, "correlation": 1, "support": 1,
         "log_weaker_support": 1}
ROUNDS = 200
TOLERANCE = 1e-10


@dataclass
class Model:
    """The logarithm of the odds of being right is `intercept + signals @ coefficients`, on raw signals."""

    intercept: float
    coefficients: np.ndarray

    def rust(self, name):
        """The model as a constant of `Model`."""
        coefficients = ", ".join(f"{value:.2f}".replace("-0.00", "0.00") for value in self.coefficients)
        return (f"pub const {name}: Model =\n"
                f"    Model {{ intercept: {self.intercept:.2f}, coefficients: [{coefficients}] }};")

    def probability(self, signals):
        return logistic(self.intercept + signals @ self.coefficients)


def logistic(odds):
    return 1 / (1 + np.exp(-np.clip(odds, -700, 700)))


def fit(signals, right, weights, penalty):
    """Minimises `sum(weights * log loss) + penalty / 2 * |coefficients of standardised signals|^2`; the intercept is free.

    `signals` is N x D, `right` and `weights` have N entries. A signal that never varies gets the coefficient 0.
    """
    mean = weights @ signals / weights.sum()
    spread = np.sqrt(weights @ (signals - mean) ** 2 / weights.sum())
    spread[spread <= 1e-12 * (1 + np.abs(mean))] = np.inf
    design = np.column_stack([np.ones(len(right)), (signals - mean) / spread])
    ridge = np.full(design.shape[1], float(penalty))
    # The intercept is free, but must not run away where all rows are right.
    ridge[0] = 1e-9
    ridge[1:][np.isinf(spread)] = 1.0
    standard = newton(design, right.astype(float), weights, ridge)
    coefficients = standard[1:] / spread
    return Model(float(standard[0] - coefficients @ mean), coefficients)


def fit_signed(signals, right, weights, penalty, signs):
    """The same with coefficients of the given signs (1, -1, or 0 for either): of those that come out with the other sign
    the weightiest is left out, until there is none."""
    free = np.ones(signals.shape[1], bool)
    while True:
        model = fit(np.where(free, signals, 0.0), right, weights, penalty)
        against = -np.asarray(signs) * model.coefficients * signals.std(axis=0)
        if against.max(initial=0.0) <= 0.0:
            return model
        free[against.argmax()] = False


def newton(design, right, weights, ridge):
    """The minimum of a strictly convex loss: steps are halved until they lower it."""
    beta = np.zeros(design.shape[1])
    current = loss(design, right, weights, ridge, beta)
    for _ in range(ROUNDS):
        share = logistic(design @ beta)
        gradient = design.T @ (weights * (share - right)) + ridge * beta
        curvature = (design.T * (weights * share * (1 - share))) @ design + np.diag(ridge)
        step = np.linalg.solve(curvature, gradient)
        if np.abs(step).max() <= TOLERANCE * (1 + np.abs(beta).max()):
            return beta - step
        size = 1.0
        while (lower := loss(design, right, weights, ridge, beta - size * step)) > current and size > 1e-6:
            size /= 2
        beta, current = beta - size * step, lower
    raise SystemExit("the fit does not converge: the signals separate right from wrong, raise --penalty")


def loss(design, right, weights, ridge, beta):
    odds = design @ beta
    return weights @ (np.logaddexp(0, odds) - right * odds) + ridge @ beta**2 / 2
