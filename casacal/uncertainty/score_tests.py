"""What arm and cell may do beside their geometry, tested one by one about a fit that knows of none of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import OTHERS, SHARED, of_repeats
from casacal.estimators import lm
from casacal.least_squares.result import Result
from casacal.problem.problem import Problem
from casacal.uncertainty.discrepancy import too_many
from casacal.uncertainty.joint_repeatability import pure_error, repeats_in
from casacal.uncertainty.noise import UNEQUAL, bartlett
from casacal.uncertainty.quadratic_forms import holm
from casacal.uncertainty.row_forms import RowForm
from casacal.uncertainty.score_rows import JOINTS, REPEATS, Columns, Form, columns_of, forms_of, noise_mm
from casacal.uncertainty.scores import CLEAR, Ground, Score, ScoreTest
from casacal.uncertainty.workspace import without_rigid, workspace_joints

MOST_ROWS = 4096  # rows, evenly over all, that tell of effects; more add time, not insight


def score_tests(bound: BoundProblem, problem: Problem) -> tuple[ScoreTest, ...]:
    """Tests of every effect of a problem, of the dial's own errors, and of rows that err together; the likeliest first.

    Args:
        bound: of the geometry alone, with the noise that is used; best as it was found beside the effects, so that an
            effect does not pass for noise, nor a rough face for an effect.
        problem: the same geometry with its effects, or those to expect of any arm.

    Returns:
        A test for each effect that the rows could show; none where nothing is unknown, where faces are many, and where
        the geometry cannot be fitted.

    """
    rows = _rows_of(bound, problem)
    if rows is None:
        return ()
    leading = {test.key for test in _leading(rows, CLEAR)}
    return tuple(replace(test, leads=test.key in leading) for test in rows.tests({}))


def leading_tests(bound: BoundProblem, problem: Problem, limit: float) -> tuple[ScoreTest, ...]:
    """The effects that explain the rows, one after the other: each the likeliest beside those before, while p < limit.

    An effect that is large shows in the tests of others; taken into account at its likeliest size it does not.
    What rows that err together have in common is looked at last, in what the effects leave.
    """
    rows = _rows_of(bound, problem)
    return () if rows is None else _leading(rows, limit)


def _rows_of(bound: BoundProblem, problem: Problem) -> _Rows | None:
    """The rows, with the noise that is used, or one for all faces where it is the joints by which they differ.

    A rough face and joints that see more of one face look alike until one asks whether faces, with what the joints do
    taken into account, still differ.
    """
    if not set(bound.scale) - {OTHERS, SHARED}:
        return _Rows.of(bound, problem)
    shared = of_repeats(bound.scale)
    factor = math.sqrt(float(((bound.noise / bound.with_noise(shared).noise) ** 2).mean()))
    rows = _Rows.of(bound.with_noise({**shared, OTHERS: factor}), problem)
    return rows if rows is not None and rows.alike_but_for_joints(1 / factor**2) else _Rows.of(bound, problem)


def _leading(rows: _Rows, limit: float) -> tuple[ScoreTest, ...]:
    found: list[ScoreTest] = []
    explained: dict[str, float] = {}
    while True:
        tests = [test for test in rows.tests(explained) if test.key not in explained]
        named = [test for test in tests if test.key in rows.columns]
        best = next((test for test in (*named, *tests) if test.p_holm < limit), None)
        if best is None:
            break
        found.append(replace(best, leads=True))
        if best.key not in rows.columns:
            break
        explained[best.key] = best.size / best.expected_size
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows about the geometry's estimate: J (N, n) and residual (N,), columns and forms of what may be beside it."""

    result: Result
    jacobian: Array
    residual: Array
    columns: Mapping[str, Columns]
    forms: tuple[Form, ...]
    tip: Array
    """Displacement (3 M, n) of workspace tips by the unknowns, apart from the position of the base."""

    @staticmethod
    def of(bound: BoundProblem, problem: Problem) -> _Rows | None:
        if not bound.unknowns or too_many(bound):
            return None
        bound = bound.thinned(MOST_ROWS)
        result = lm(bound)
        if not result.converged or not math.isfinite(result.cost):
            return None
        joints = workspace_joints(bound.problem.robot)
        tips = bound.tips(result.x, joints)
        columns = columns_of(bound, result.x, problem, joints)
        return _Rows(
            result,
            bound.jacobian(result.x),
            bound.residual(result.x),
            {key: replace(each, tip=without_rigid(each.tip, tips)) for key, each in columns.items()},
            tuple(forms_of(bound, columns)),
            without_rigid(bound.tip_jacobian(result.x, joints), tips),
        )

    @property
    def bound(self) -> BoundProblem:
        assert isinstance(self.result.problem, BoundProblem)
        return self.result.problem

    def alike_but_for_joints(self, least: float) -> bool:
        """Whether faces do not differ in noise, no less than a least variance, beside joints that do not repeat."""
        form = next((each for each in self.forms if each.key == JOINTS), None)
        ground = self.ground(self.jacobian, self.bound.prior_std)
        known = None if form is None else RowForm.of(ground, self.jacobian, self.residual, form.covariance)
        if form is None or known is None or known.chance > CLEAR:
            return False
        left = self.residual + self.jacobian @ ground.step
        squares = left**2 / (max(known.noise, least) + known.variance * form.covariance.diagonal())
        codes = self.bound.noise_labels.codes
        total, count = (np.bincount(codes, each).astype(np.float64) for each in (squares, np.ones(len(codes))))
        return bartlett(total[count > 0], count[count > 0] * ground.freedom / len(left)) > UNEQUAL

    def ground(self, jacobian: Array, prior_std: Array) -> Ground:
        """Of the geometry's unknowns, and of those that further columns of J (N, n + k) belong to."""
        away, r = np.zeros(jacobian.shape[1]), self.residual
        away[: self.bound.unknowns] = self.result.x - self.bound.x0
        return Ground.of(jacobian.T @ jacobian, jacobian.T @ r, float(r @ r), len(r), prior_std, away)

    def tests(self, explained: Mapping[str, float]) -> tuple[ScoreTest, ...]:
        """All tests beside some effects, taken for random ones of sizes that are times those expected."""
        beside = [self.columns[key] for key in explained]
        jacobian = np.hstack([self.jacobian, *(each.rows for each in beside)])
        stds = [np.full(each.rows.shape[1], explained[each.key]) for each in beside]
        ground = self.ground(jacobian, np.concatenate([self.bound.prior_std, *stds]))
        if ground.freedom < 2:
            return ()
        tip = np.hstack([self.tip, *(each.tip for each in beside)])
        found = [*self._scores(ground, jacobian, tip), *self._forms(ground, jacobian, tip)]
        if not explained and (repeats := self._repeats(ground)) is not None:
            found.append(repeats)
        adjusted = holm([test.p for test in found])
        tests = (replace(test, p_holm=p) for test, p in zip(found, adjusted, strict=True))
        return tuple(sorted(tests, key=lambda test: test.p))

    def _scores(self, ground: Ground, jacobian: Array, answers: Array) -> Iterator[ScoreTest]:
        for each in self.columns.values():
            cross = jacobian.T @ each.rows
            score = Score.of(ground, each.rows.T @ each.rows, cross, each.rows.T @ self.residual)
            if not score.seen:
                continue
            moved = each.tip - answers @ (ground.covariance @ cross)
            tip, size = score.size * math.sqrt(3 * float((moved**2).sum()) / len(moved)), score.size * each.expected
            yield ScoreTest(each.key, each.words, score.chance, math.nan, size, each.expected, each.unit, tip)

    def _forms(self, ground: Ground, jacobian: Array, tip: Array) -> Iterator[ScoreTest]:
        for each in self.forms:
            found = None if each.tested is None else RowForm.of(ground, jacobian, self.residual, each.tested)
            if found is not None:
                yield self._of_rows(each, found.chance, found.size, ground, jacobian, tip)

    def _of_rows(
        self, form: Form, chance: float, size: float, ground: Ground, jacobian: Array, tip: Array
    ) -> ScoreTest:
        """Tip motion of errors of covariance t^2 W: what the estimate makes of them, and their own."""
        answer = tip @ ground.covariance
        spread = float(((answer @ (jacobian.T @ (form.covariance @ jacobian))) * answer).sum())
        rms = math.sqrt(max(3 * spread / len(tip), 0.0) + form.own**2)
        return ScoreTest(form.key, form.words, chance, math.nan, size, math.nan, form.unit, size * rms)

    def _repeats(self, ground: Ground) -> ScoreTest | None:
        """Pure error against lack of fit; size is of what the touches of one place share."""
        again = repeats_in(self.bound)
        form = next((each for each in self.forms if each.key == REPEATS), None)
        known = None if form is None else pure_error(self.result, again)
        if known is None or form is None:
            return None
        rows = len(again.codes)
        together = (rows - float((again.sizes**2).sum()) / rows) / max(len(again.sizes) - 1, 1)
        size = known.ratio * noise_mm(self.bound) * math.sqrt(max(known.f - 1, 0.0) / together)
        return self._of_rows(form, known.chance, size, ground, self.jacobian, self.tip)
