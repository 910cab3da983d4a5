"""A user's file with types, as mypy --strict reads it; it is not run."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import casacal
from casacal import Instrument, Parameter, Problem, Robot, Samples
from casacal.calibration import Calibrated
from casacal.deployment import Prediction
from casacal.fit import Result, Status
from casacal.model.kinematics import chain, position, rotate_z, translate_x


def pose(p: Any, q: Any) -> Any:
    return chain(rotate_z(q[0] + p.zero), translate_x(p.length))


@dataclass(frozen=True, kw_only=True)
class Ruler(Instrument):
    noise: float
    mark: Parameter = Parameter(0.0, prior_std=1.0)

    @property
    def columns(self) -> Mapping[str, Any]:
        return {"x": "length"}

    @property
    def unknowns(self) -> Mapping[str, Parameter]:
        return {"mark": self.mark}

    @property
    def residual_std(self) -> float:
        return self.noise

    def residual(self, pose: Any, p: Any, row: Any) -> Any:
        return position(pose)[0] - p.mark - row.x


robot = Robot("one", 1, pose, {"zero": Parameter(0.0, unit="rad"), "length": Parameter(500.0)})
problem = Problem(robot, Ruler(noise=0.01))
samples: Samples = casacal.simulate(problem, samples=40, seed=1).samples
calibration: Calibrated = casacal.calibrate(problem, samples, method=casacal.lm, loss=casacal.huber())
result: Result = calibration.result
ended: Status = result.status
estimate: NDArray[np.float64] = calibration.x
paths: list[Path] = calibration.save("somewhere")
prediction: Prediction = casacal.load("somewhere").predict([0.1], std=True)
text: str = calibration.export("c")
where: NDArray[np.float64] = prediction.positions
unknown: int = casacal.bind(problem, samples).unknowns
