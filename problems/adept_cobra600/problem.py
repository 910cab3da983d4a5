"""Adept (Omron) Cobra 600, a SCARA: two turning links, a quill that slides and turns, all four axes parallel."""

import math

from casacal import Cell, DialOnBody, Face, Joint, Parameter, Problem, Robot, chain, deg
from casacal.model.kinematics import rotate_x, rotate_y, rotate_z, translate_x, translate_z


def pose(p, q):
    """Flange pose from joint values q = (rad, rad, mm, rad).

    Where all axes are parallel, DH names numbers that nothing can tell apart, so the pose is written as the arm is
    built, with what a touch can see and no more: two lengths, the elbow's zero, and the small tilts about x and y of
    each axis against the one before. The zeros of joint 1 and of the quill, and offsets along the axes, only move the
    base frame; the zero of joint 4 only turns the tool, whose own x and y hold it.
    """
    return chain(
        translate_z(387.0),
        rotate_z(q[0]),
        translate_x(p.link[0]),
        rotate_x(p.elbow[0]),
        rotate_y(p.elbow[1]),
        rotate_z(q[1] + p.zero),
        translate_x(p.link[1]),
        rotate_x(p.quill[0]),
        rotate_y(p.quill[1]),
        rotate_x(math.pi),  # from here on z points down, and the quill comes out with q3
        translate_z(q[2]),
        rotate_x(p.wrist[0]),
        rotate_y(p.wrist[1]),
        rotate_z(q[3]),
    )


robot = Robot(
    "Adept Cobra 600",
    joints=[
        Joint("revolute", *deg(-105, 105)),
        Joint("revolute", *deg(-157.5, 157.5)),
        Joint("prismatic", 0.0, 210.0),
        Joint("revolute", *deg(-360, 360)),
    ],
    pose=pose,
    parameters={
        "link": Parameter((325.0, 275.0), unit="mm", prior_std=0.3),
        "zero": Parameter(0.0, unit="rad", prior_std=1e-3),  # of joint 2
        "elbow": Parameter((0.0, 0.0), unit="rad", prior_std=0.5e-3, labels=("_x", "_y")),
        "quill": Parameter((0.0, 0.0), unit="rad", prior_std=0.5e-3, labels=("_x", "_y")),
        "wrist": Parameter((0.0, 0.0), unit="rad", prior_std=0.5e-3, labels=("_x", "_y")),
    },
)

# A SCARA cannot tilt its tool, and on a level plate it always touches at one height, where its lengths do not show. So
# three facets, each inclined by 15 degrees another way. Were their angles unknown, a wider arm on flatter facets would
# read the same; they are those of one body that was measured once, and only its place and its turn are unknown. As the
# quill's travel is measured in mm, certified angles make the lengths of the links known without any gauge block.
SLOPE = math.radians(15.0)
NORMALS = {
    label: (math.sin(SLOPE) * math.cos(azimuth), math.sin(SLOPE) * math.sin(azimuth), math.cos(SLOPE))
    for label, azimuth in zip(("near", "left", "right"), deg(180, 60, -60), strict=True)
}

# The dial hangs 60 mm beside axis 4, so that turning the quill tells where that axis stands. Its z is held: it would
# only move the base frame, as the zero of the quill would.
tool = Parameter((60.0, 0.0, 80.0), unit="mm", prior_std=0.5, free=(True, True, False), labels=("_x", "_y", "_z"))
problem = Problem(robot, DialOnBody(noise_std=0.01, tool=tool, normals=NORMALS))

# The facets lie around (400, 0) in the middle of the quill's stroke. The tool meets each of them at 15 degrees, always.
CENTRES = {"near": (300.0, 0.0, 180.0), "left": (400.0, 150.0, 180.0), "right": (400.0, -150.0, 180.0)}
cell = Cell(
    faces=tuple(Face(label, CENTRES[label], normal, size=(150.0, 150.0)) for label, normal in NORMALS.items()),
    tilt=deg(16.0),
)
