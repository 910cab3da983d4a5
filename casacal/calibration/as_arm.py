"""A calibration, fresh or read back, as the arm that it found: what it predicts, corrects and exports."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import casadi as ca

from casacal.values import Array

if TYPE_CHECKING:
    import pandas as pd

    from casacal.deployment.arm import CalibratedArm
    from casacal.deployment.compensate import Compensation
    from casacal.deployment.predict import Prediction


Frame: TypeAlias = Literal["flange", "tip"]


class AsArm(ABC):
    """A calibration, fresh or read back, as the arm that it found."""

    @property
    @abstractmethod
    def arm(self) -> CalibratedArm:
        """The problem and the estimate."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """All that result.json holds, in JSON's own types."""

    def predict(
        self, q: Any, *, frame: Frame = "flange", nominal: bool = False, std: bool = False, force: bool = False
    ) -> Prediction:
        """Where the calibrated arm is: positions (N, 3) in mm and unit quaternions (N, 4; w, x, y, z), base frame.

        q: joint values (n,) or (N, n) in rad and mm, or a frame, file or `Samples` with the columns of samples. frame,
        nominal, std, force, what is returned and raised: as for `casacal.deployment.predict.predict`.
        """
        from casacal.deployment.predict import predict

        return predict(self.arm, q, frame=frame, nominal=nominal, std=std, force=force)

    def compensate(
        self, targets: Any, *, frame: Frame = "flange", largest: float | None = None, force: bool = False
    ) -> Compensation:
        """Joint targets for which the calibrated arm takes the poses that the nominal one was meant to take.

        targets: joint values (N, n) in rad and mm, poses (N, 4, 4) in mm, or a frame or file with the columns that
        `casacal compensate` reads. frame, largest (by default as there), force, what is returned and raised: as for
        `casacal.deployment.compensate.compensate`.
        """
        return self._compensated(targets, frame, largest, force)

    def _compensated(
        self, targets: Any, frame: Frame, largest: float | None, force: bool, form: str = "csv"
    ) -> Compensation:
        from casacal.deployment.compensate import LARGEST, compensate
        from casacal.deployment.programs import rounding_of

        most, rounding = LARGEST if largest is None else largest, rounding_of(form, self.arm.source.problem.robot)
        return compensate(self.arm, targets, frame=frame, largest=most, rounding=rounding, force=force)

    def program(
        self,
        targets: Any,
        form: str,
        path: str | Path | None = None,
        *,
        frame: Frame = "flange",
        largest: float | None = None,
        force: bool = False,
    ) -> str:
        """Compensated targets as text, "csv", "rapid", "krl" or "urscript"; written to `path` where one is given.

        targets, frame, largest, force, errors: as for `compensate`. The proof is about joint values as written.
        """
        from casacal.deployment.programs import text_of
        from casacal.files import write_text

        text = text_of(self._compensated(targets, frame, largest, force, form), form, self.arm)
        if path is not None:
            write_text(path, text)
        return text

    def export(
        self,
        form: str,
        path: str | Path | None = None,
        *,
        source: str | Path | None = None,
        prefix: str | None = None,
        force: bool = False,
    ) -> str:
        """The arm as "dh", "urdf", "zeros", "ur", "c" or "casadi": the text, written to `path` where one is given.

        source, prefix, force, errors: as for `casacal.deployment.export.export`.
        """
        from casacal.deployment.export import export

        return export(self.arm, form, path, source=source, prefix=prefix, force=force)

    def pose_function(self, *, nominal: bool = False, free: bool = False, force: bool = False) -> ca.Function:
        """Function q (n; rad, mm) -> flange pose (4x4; mm) for SX, MX, `casadi.Opti` and code generation.

        nominal: the arm as drawn. free: the robot's parameters are inputs too, by name:
        `pose(**calibration.values(), q=q)["pose"]`. force: take a result whose verdict is not to use it; the function's
        name then says so. Derivatives are exact. Raises CasacalError for nominal and free together, RefusedResultError
        for a result that is not to be used, unless forced.
        """
        from casacal.deployment.functions import pose_function

        return pose_function(self.arm, nominal=nominal, free=free, force=force)

    def tip_function(self, *, nominal: bool = False, free: bool = False, force: bool = False) -> ca.Function:
        """Function q (n; rad, mm) -> tip (3; mm), where the instrument touches at reading zero.

        nominal, free, force, errors: as for `pose_function`; free also what the tip depends on of instrument and
        columns. Raises ProblemError where there are several instruments.
        """
        from casacal.deployment.functions import tip_function

        return tip_function(self.arm, nominal=nominal, free=free, force=force)

    def values(self, *, frame: Frame = "flange", nominal: bool = False, force: bool = False) -> dict[str, Array]:
        """Values of the parameters by name, mm and rad, as functions with free parameters take them.

        frame: "flange" for `pose_function`, "tip" for `tip_function`. nominal, force, errors: as for these.
        """
        from casacal.deployment.functions import values_of

        return values_of(self.arm, frame=frame, nominal=nominal, force=force)


def parameter_table(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Parameters of result.json as a frame, with the change of each."""
    import pandas as pd

    names = ["name", "unit", "nominal", "estimate", "std", "known_from"]
    table = pd.DataFrame(list(rows), columns=names).set_index("name")
    table.insert(3, "change", table["estimate"] - table["nominal"])
    return table
