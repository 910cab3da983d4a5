"""Models that would end in a wrong number or a traceback are refused where they are made."""

import math

import casadi as ca
import numpy as np
import pytest

from casacal import Joint, Parameter, Robot
from casacal.errors import ProblemError
from casacal.model.kinematics import chain, rotate_z, translate


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


def _solved():
    x, a = ca.SX.sym("x"), ca.SX.sym("a")
    return ca.rootfinder("half", "newton", ca.Function("g", [x, a], [x**3 + x - a]))


def _looked_up():
    table = ca.interpolant("table", "bspline", [np.linspace(-4, 4, 9)], np.linspace(-4, 4, 9) ** 2)
    return lambda _, angle: table(angle)


@pytest.mark.parametrize("make", [_solved, _looked_up])
def test_a_pose_that_calls_a_solver_or_a_table_is_refused_where_the_robot_is_made(make):
    function = make()

    def pose(p, q):
        return chain(rotate_z(function(0.0, q[0])), translate(p.length, 0, 0))

    robot = Robot("linkage", [Joint()], pose, {"length": Parameter(400.0)})
    with pytest.raises(ProblemError, match="calls another function, such as a rootfinder"):
        _ = robot.traced
