"""A study small enough to run many times: matrix problems that need no robot."""

import time

import numpy as np
from linear import Matrix, random_linear

from casacal import ekf, evolution, lm, sckf
from casacal.study import Method, Study
from casacal.uncertainty.figures import residual_figures

PAUSE = 0.0


class LinearTrial:
    def __init__(self, seed):
        a, y, nominal, prior, noise = random_linear(seed % 2**32)
        self.problem = Matrix(a / noise, y / noise, nominal, prior)

    def judge(self, result):
        time.sleep(PAUSE)
        return {"cost": result.cost, **residual_figures(self.problem.residual(result.x))}

    def detail(self, result):
        return {"x": result.x.tolist()}


class Linear:
    def __init__(self, fails_at=None):
        self.fails_at = fails_at

    def trial(self, seed):
        if self.fails_at == seed:
            raise RuntimeError("out of reach")
        return LinearTrial(seed)


def steepest(problem, *, steps=3):
    """A user's own estimator: x alone comes back."""
    x = problem.x0.copy()
    for _ in range(steps):
        normal = problem.normal(x)
        gradient = normal.gradient + problem.prior_information @ (x - problem.x0)
        scale = np.diag(normal.information + problem.prior_information)
        x = x - 0.5 * gradient / scale
    return x


def broken(problem):
    raise ZeroDivisionError("on purpose")


METHODS = {
    "lm": lm,
    "sckf": sckf,
    "ekf": ekf,
    "mine": Method(steepest, {"steps": 5}),
    "evolution": Method(evolution, {"budget": 20_000}, seeded=True, trials=4),
    "broken": broken,
}
study = Study("tiny", {"one": Linear(), "two": Linear()}, METHODS, trials=12, details=2)
quick = Study("tiny", {"one": Linear()}, METHODS, trials=2)


def report(run):
    lines = ["# Tiny", ""]
    for setting in run.study.settings:
        for method in run.study.methods:
            lines.append(f"{setting} {method} {run.values(setting, method, 'cost').tolist()}")
    return lines
