"""Universal Robots UR5 with a dial indicator on three faces and on a gauge block of known height."""

from casacal import Cell, DialOnPlane, Face, Joint, Problem, Robot, Step, corner, deg, tool_point

# Standard DH as the maker publishes it, in mm and rad: row i is joint i. Nothing is rounded or turned round: the base
# frame is then the controller's, and q = 0 is the arm stretched out along -x.
robot = Robot.from_dh(
    "UR5",
    alpha=deg(90, 0, 0, 90, -90, 0),
    a=(0, -425, -392.25, 0, 0, 0),
    d=(89.159, 0, 0, 109.15, 94.65, 82.3),
    theta=(0, 0, 0, 0, 0, 0),
    # What the drawing may be wrong by. These are casacal's defaults, written out because every result depends on them.
    length_std=0.7,
    angle_std=1e-3,
    joints=[Joint("revolute", *deg(-360, 360))] * 6,  # the data sheet gives every joint two whole turns
    # Axes 2, 3 and 4 are parallel: their common normals may stand anywhere along them, and the smallest tilt makes d
    # jump by metres. In rows 2 and 3 Hayati's turn beta takes the place of d, and d is held.
    parallel=(2, 3),
)

BLOCK = 100.0  # a gauge block that stands on the floor plate, mm

dial = DialOnPlane(
    noise_std=0.01,  # repeatability of one reading, mm
    sign=-1,  # a plunger that is pushed in reads more and makes the tool shorter; the paper's is +1, the other way
    # The tip at reading zero, in the flange frame. A rule says where it is to a millimetre; the samples say the rest.
    tool=tool_point(0, 0, 120, prior_std=1.0),
    # Faces contain no length. The block's top is parallel to the floor at a height that its certificate states, and
    # that alone makes the size of the arm known: label its touches "block".
    steps={"block": Step(on="floor", height=BLOCK)},
)
problem = Problem(robot, dial)

# The simulated cell stands where the arm reaches all faces in many postures. The floor is 100 mm above the base.
faces = corner((450.0, 0.0, 250.0), size=300.0)
cell = Cell(faces=(*faces, Face("block", (450.0, 0.0, 100.0 + BLOCK), (0, 0, 1), size=(35.0, 9.0))))
