"""Instruments as a user writes them first: a residual, columns, unknowns, a noise, and nothing more."""

WIRE = '''"""A draw wire from a post to the flange of a small arm."""
import casadi as ca
from anchors import POST

from casacal import Instrument, Parameter, Problem, Robot, deg
from casacal.model.kinematics import position


class DrawWire(Instrument):
    columns = {"wire": "length"}
    column_stds = {"wire": 0.05}
    unknowns = {"post": Parameter(POST, prior_std=5.0)}

    def residual(self, pose, p, row):
        return ca.norm_2(position(pose) - p.post) - row.wire


ARM = {"alpha": deg(-90, 0, 90), "a": (100.0, 400.0, 50.0), "d": (300.0, 0.0, 350.0), "theta": deg(0, -90, 0)}
problem = Problem(Robot.from_dh("small", **ARM), DrawWire())
'''

STYLUS = '''"""A stylus that touches faces, each labelled, without a dial."""
from casacal import Cell, Instrument, Plane, Problem, Robot, corner, deg
from casacal.model.kinematics import position


class Stylus(Instrument):
    residual_std = 0.02
    unknowns = {"face": Plane((0, 0, 1), (0, 0, 300), per="face")}

    def residual(self, pose, p, row):
        return p.face.distance(position(pose))


robot = Robot.from_dh(
    "small",
    alpha=deg(-90, 0, 90, -90, 90, 0),
    a=(100.0, 400.0, 50.0, 0, 0, 0),
    d=(300.0, 0.0, 0, 350.0, 0, 80),
    theta=deg(0, -90, 180, 0, 90, 0),
)
problem = Problem(robot, Stylus())
'''

HELD = WIRE.replace(
    'problem = Problem(Robot.from_dh("small", **ARM), DrawWire())',
    'problem = Problem(Robot.from_dh("small", **ARM), DrawWire()).fix("alpha", "a", "d", "theta")',
).replace("Parameter(POST, prior_std=5.0)", "Parameter(POST, free=False)")

SOURCES = {"wire": WIRE, "stylus": STYLUS, "held": HELD}


def written(folder, name):
    """A problem folder with one of these instruments; the wire's also imports a module beside it."""
    place = folder / name
    place.mkdir(parents=True)
    (place / "problem.py").write_text(SOURCES[name], encoding="utf-8")
    (place / "anchors.py").write_text("POST = (1500.0, 0.0, 200.0)\n", encoding="utf-8")
    return place
