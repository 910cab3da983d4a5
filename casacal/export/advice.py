"""Which forms an arm can be exported to, for those who asked for another."""

from __future__ import annotations

from casacal.robots.dh_table import DHTable
from casacal.robots.robot import Robot
from casacal.robots.urdf_chain import UrdfChain


def other_forms(robot: Robot) -> str:
    """Advice to export an arm in the forms that hold it."""
    own = {DHTable: "dh, ", UrdfChain: "urdf, "}
    return f"Export it as {own.get(type(robot.arm), '')}zeros or c"
