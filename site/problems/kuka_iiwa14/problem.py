"""KUKA LBR iiwa 14 R820, seven axes, that touches three faces with a ball and feels the touch itself; no dial."""

from casacal import Cell, DialOnPlane, Joint, Problem, Robot, corner, deg, tool_point

LIMITS = [(-170, 170), (-120, 120), (-170, 170), (-120, 120), (-170, 170), (-120, 120), (-175, 175)]  # degrees

# Modified (Craig's) DH: a row's alpha and a come before its joint. All axes meet in three points (shoulder, elbow,
# wrist), so every a is zero, and the four lengths of the drawing stand in d.
robot = Robot.from_dh(
    "KUKA LBR iiwa 14 R820",
    convention="modified",
    alpha=deg(0, -90, 90, 90, -90, -90, 90),
    a=(0, 0, 0, 0, 0, 0, 0),
    d=(360, 0, 420, 0, 400, 0, 126),  # base to shoulder, to elbow, to wrist, to media flange
    theta=(0, 0, 0, 0, 0, 0, 0),
    length_std=0.7,
    angle_std=1e-3,
    joints=[Joint("revolute", *deg(*limits)) for limits in LIMITS],
)

# Torque sensors say when the ball touches, so there is no reading. The tool point is the centre of the ball: it lies on
# a plane parallel to the face at any tilt, and the radius goes into the plane. Such a touch is blunter than a dial.
ball = DialOnPlane(reading=False, noise_std=0.05, tool=tool_point(0, 0, 100, prior_std=1.0))
problem = Problem(robot, ball)

# Three faces of 400 mm in front of the arm, at the height of its elbow, within its reach of 820 mm about the shoulder.
cell = Cell(faces=corner((500.0, 0.0, 450.0), size=400.0))
