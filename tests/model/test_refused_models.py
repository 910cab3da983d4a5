"""Models that would end in a wrong number or a traceback are refused where they are made."""

import math

import pytest

from casacal import Parameter
from casacal.errors import ProblemError


@pytest.mark.parametrize(
    ("unit", "factor", "right"),
    [("m", 1000, "mm"), ("metres", 1000, "mm"), ("cm", 10, "mm"), ("inch", 25.4, "mm"), ("deg", math.pi / 180, "rad")],
)
def test_lengths_in_metres_and_angles_in_degrees_are_refused(unit, factor, right):
    with pytest.raises(ProblemError, match=f"is in '{unit}', and models are in mm and rad") as caught:
        Parameter(0.4, unit=unit, prior_std=0.001)
    assert f"times {factor:g}, with unit='{right}'" in str(caught.value)
    assert Parameter(0.4, unit="um", prior_std=1.0).unit == "um"
    assert Parameter(0.4, unit="V", prior_std=1.0).unit == "V"
