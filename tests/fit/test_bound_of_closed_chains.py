"""Closed chains calibrated to the Cramer-Rao bound, which NumPy computes of the closed forms by finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from closed_forms import FORMS
from conftest import ROOT

from casacal import bind, ipopt, lm, load_problem


def moved(frame, change):
    """A transform (4x4) after a small turn and shift (6,)."""
    x, y, z = change[:3]
    away = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.linalg.solve(np.eye(3) - away / 2, np.eye(3) + away / 2) @ frame[:3, :3], frame[:3, 3] + change[3:]


class Case:
    """A problem bound to its samples, and its residuals in NumPy: of the arm's numbers, then of what stands around."""

    def __init__(self, name):
        self.source, self.form = load_problem(ROOT / "problems" / name), FORMS[name]
        self.problem = self.source.problem
        self.rows = self.problem.read(self.source.samples)
        self.bound = bind(self.problem, self.rows)
        self.fit = lm(self.bound)
        self.own = [n for key, each in self.problem.robot.parameters.items() for n in each.names(key)]
        self.at = [self.bound.names.index(n) for n in self.own]
        self.nominal = np.concatenate([np.asarray(e.nominal) for e in self.problem.robot.parameters.values()])
        self.arm = self.nominal + self.fit.x[self.at]
        self.prior = np.concatenate([e.prior_stds for e in self.problem.robot.parameters.values()])
        self.readings = np.column_stack([*self.rows.columns.values()]) if self.rows.columns else None
        self.around, self.width, self.stds = getattr(self, f"_{name}")()

    def _values(self):
        return {k: np.array(v, dtype=float) for k, v in self.bound.symbolic.values(self.fit.x).items()}

    def _five_bar(self):
        station, read = self._values()["station"], np.column_stack([self.rows.columns[k] for k in "xyz"])

        def residuals(arm, around):
            turn, place = moved(station, around)
            tips = np.array([self.form(arm, q) + np.array([0, 0, 20]) for q in self.rows.joints])
            return (tips @ turn.T + place - read) / 0.01

        return residuals, 6, np.full(6, np.inf)

    def _delta(self):
        values, read = self._values(), self.rows.columns["length"]
        which = [int(label) - 1 for label in self.rows.labels["anchor"]]
        anchors, zero = np.array([values[f"anchor.{k}"].ravel() for k in "123"]), float(values["zero"].item())

        def residuals(arm, around):
            ends = anchors + around[:9].reshape(3, 3)
            balls = np.array([self.form(arm, q) - np.array([0, 0, 50]) for q in self.rows.joints])
            return (np.linalg.norm(balls - ends[which], axis=1) - (read - zero - around[9]))[:, None] / 0.01

        return residuals, 10, np.array([np.inf] * 9 + [0.005])

    def _palletiser(self):
        values = self._values()
        station, tool = values["station"], values["tool"].ravel()
        holes = np.array([self.problem.instrument.points[label] for label in self.rows.labels["point"]])

        def residuals(arm, around):
            turn, place = moved(station, around[:6])
            tips = []
            for q in self.rows.joints:
                c, s = np.cos(q[0] + q[3]), np.sin(q[0] + q[3])
                tips.append(self.form(arm, q) + np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ (tool + around[6:]))
            return (np.array(tips) @ turn.T + place - holes) / 0.03

        return residuals, 9, np.array([np.inf] * 6 + [1.0] * 3)

    def covariance(self):
        """Of the arm's numbers, the rest unknown as well, by central differences (n, n)."""
        n = len(self.arm)
        steps = np.concatenate([1e-4 * self.prior / self.prior.max(), np.full(self.width, 1e-5)])
        columns = []
        for k, step in enumerate(steps):
            change = np.zeros(len(steps))
            change[k] = step
            ends = [self.around(self.arm + sign * change[:n], sign * change[n:]).ravel() for sign in (1, -1)]
            columns.append((ends[0] - ends[1]) / (2 * step))
        slopes = np.column_stack(columns)
        scale = np.concatenate([self.prior, np.minimum(self.stds, 1.0)])  # in units alike, or the inverse loses digits
        known = 1.0 / np.concatenate([self.prior, self.stds]) ** 2
        whole = (slopes.T @ slopes + np.diag(known)) * np.outer(scale, scale)
        return (np.linalg.pinv(whole, rcond=1e-13, hermitian=True) * np.outer(scale, scale))[:n, :n]


@pytest.fixture(scope="module", params=FORMS)
def case(request):
    return Case(request.param)


def test_residuals_are_those_of_the_closed_form(case):
    found = case.around(case.arm, np.zeros(case.width)).ravel()
    np.testing.assert_allclose(found, case.bound.residual(case.fit.x), atol=1e-6)


def test_covariance_is_the_bound(case):
    wanted, found = case.covariance(), case.fit.covariance[np.ix_(case.at, case.at)]
    scale = np.sqrt(np.diagonal(wanted))
    np.testing.assert_allclose(found / np.outer(scale, scale), wanted / np.outer(scale, scale), atol=2e-3)


def test_the_reference_agrees(case):
    reference = ipopt(case.bound)
    assert reference.converged
    assert reference.cost == pytest.approx(case.fit.cost, rel=1e-9)


@pytest.mark.parametrize("name", ["five_bar", "delta"])
def test_arms_that_the_closed_form_moves_are_calibrated_to_the_bound(name):
    """Errors of the arm's numbers over 60 arms and noises, in the metric of the bound, are one for each number."""
    case, rng, squares = Case(name), np.random.default_rng(5), []
    metric = np.outer(case.prior, case.prior)
    information = np.linalg.inv(case.covariance() / metric)
    for _ in range(60):
        truth = case.nominal + case.prior * rng.normal(size=len(case.prior))
        zero = rng.normal(size=case.width) * np.where(np.isfinite(case.stds), case.stds, 0.0)
        off = 0.01 * case.around(truth, zero) + 0.01 * rng.normal(size=case.readings.shape)
        columns = dict(zip(case.rows.columns, (case.readings + off).T, strict=True))
        found = lm(bind(case.problem, replace(case.rows, columns=columns))).x[case.at]
        error = (case.nominal + found - truth) / case.prior
        squares.append(error @ information @ error / len(error))
    assert 0.85 < np.mean(squares) < 1.15
