"""A true arm before true faces, which answers each planned posture as a dial on it would."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casacal import Problem, Samples, bind
from casacal.model.instrument import readings_within
from casacal.planning import Route
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints

Array = NDArray[np.float64]

STEP = 1e-4
"""Of readings, mm, by which slopes are found."""


class World:
    """An arm drawn from the prior; faces some mm and mrad from where the plan has them."""

    def __init__(
        self,
        problem: Problem,
        route: Route,
        *,
        seed: int = 0,
        noise: float = 1.0,
        faces: tuple[float, float] = (3.0, 3e-3),
    ) -> None:
        rng = np.random.default_rng(seed)
        self.bound = bind(problem, route.samples)
        self.problem, self.route = problem, route
        prior, units = self.bound.prior_std, np.array([faces[u == "rad"] for u in self.bound.units])
        self.x = rng.normal(size=prior.size) * np.where(np.isfinite(prior), prior, units)
        samples, self.column = route.samples, next(iter(route.samples.columns), None)
        self.joints = samples.joints.copy()
        low, high = readings_within(problem.instrument.probe.travel)
        scatter = rng.normal(size=len(samples)) * noise * problem.instrument.noise_std
        if self.column is None:  # a touch without a dial: the arm itself comes to the face, nearly
            for _ in range(8):
                self._jog(samples, scatter, np.ones(len(samples), dtype=bool), to=scatter)
            return
        expected = readings = samples.columns[self.column].copy()
        for _ in range(8):
            wanted = self._answered(samples, readings)
            far = np.abs(wanted - (low + high) / 2) > 0.48 * (high - low)
            readings = np.where(far, expected, wanted)
            if not far.any():
                break
            self._jog(samples, readings, far)
        self.joints = np.where(problem.robot.revolute, np.radians(np.round(np.degrees(self.joints), 4)), self.joints)
        for _ in range(3):
            readings = self._answered(samples, readings)
        self.readings = np.round(readings + scatter, 3)

    @property
    def samples(self) -> Samples:
        """All touches of the plan, made well."""
        columns = {} if self.column is None else {self.column: self.readings}
        return replace(self.route.samples, joints=self.joints, columns=columns)

    def residual(self, samples: Samples, joints: Array, readings: Array) -> Array:
        """Distances from the true faces, mm."""
        columns = {} if self.column is None else {self.column: readings}
        rows = replace(samples, joints=joints, columns=columns)
        return self.bound.on(rows).plain_residual(self.x)

    def _answered(self, samples: Samples, readings: Array) -> Array:
        here = self.residual(samples, self.joints, readings)
        return readings - here * STEP / (self.residual(samples, self.joints, readings + STEP) - here)

    def _jog(self, samples: Samples, readings: Array, far: NDArray[np.bool_], *, to: Array | float = 0.0) -> None:
        here = self.residual(samples, self.joints, readings) - to
        turns = np.eye(self.joints.shape[1]) * 1e-6
        slopes = np.stack(
            [(self.residual(samples, self.joints + t, readings) - to - here) / 1e-6 for t in turns], axis=1
        )
        self.joints[far] -= (here[:, None] * slopes / (slopes**2).sum(axis=1)[:, None])[far]

    def touch(self, number: int) -> tuple[Array, float, str]:
        """Joint values, reading and face of a touch of the plan, made well."""
        k = number - 1
        return self.joints[k].copy(), float(self.readings[k]), self.route.samples.labels["plane"][k]

    def tip_error(self, x: Array) -> float:
        """True tip error of an estimate x (n,), mm RMS over the workspace, apart from where the base stands."""
        joints, arm = workspace_joints(self.problem.robot), ~np.isinf(self.bound.prior_std)
        believed = np.where(arm, x, self.x)
        tips = self.bound.tips(self.x, joints)
        return tip_rms(without_rigid((self.bound.tips(believed, joints) - tips).ravel(), tips))

    def off(self, joints: Array, reading: float, face: str) -> float:
        """By how much one touch as it was typed is off its true face, mm."""
        one = replace(self.route.samples.take([0]), labels={"plane": [face]})
        return float(self.residual(one, joints[None], np.array([reading]))[0])
