"""Robot programs as cells hold them, in five languages, and the controller that runs them, in NumPy alone.

Nothing here reads with casacal: angles, configurations, inverse kinematics and the reading back are this file's own.
"""

import math
import re
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from oracles import dh_chain

from casacal import DialOnPlane, Joint, Problem, Robot, deg
from casacal.deployment.arm import CalibratedArm
from casacal.model.problem_file import ProblemFile

IRB = {
    "alpha": deg(-90, 0, -90, 90, -90, 0),
    "a": (150.0, 700.0, 110.0, 0.0, 0.0, 0.0),
    "d": (450.0, 0.0, 0.0, 800.0, 0.0, 85.0),
    "theta": deg(0, -90, 0, 0, 0, 180),
}
KR = {**IRB, "theta": deg(0, 0, -90, 0, 0, 180)}
UR = {
    "alpha": deg(90, 0, 0, 90, -90, 0),
    "a": (0.0, -425.0, -392.25, 0.0, 0.0, 0.0),
    "d": (89.159, 0.0, 0.0, 109.15, 94.65, 82.3),
    "theta": (0.0,) * 6,
}
LIMITS = {
    "rapid": (170, 100, 120, 300, 120, 400),
    "krl": (170, 190, 210, 300, 120, 400),
    "urscript": (360,) * 6,
    "fanuc": (170, 100, 120, 300, 120, 400),
    "yaskawa": (170, 100, 120, 300, 120, 360),
}
DRAWINGS = {"rapid": IRB, "krl": KR, "urscript": UR, "fanuc": IRB, "yaskawa": IRB}
ENDINGS = {"rapid": ".mod", "krl": ".src", "urscript": ".script", "fanuc": ".LS", "yaskawa": ".JBI"}
PULSES = (1435.5, 1435.5, 1300.25, -1000.0, 980.0, 620.0)


@cache
def problem_of(language):
    """A language's arm as drawn."""
    joints = [Joint("revolute", *deg(-limit, limit)) for limit in LIMITS[language]]
    return Problem(Robot.from_dh(language, **DRAWINGS[language], joints=joints), DialOnPlane(noise_std=0.01))


def arm_of(language, changes=None):
    """A result of a language's arm whose DH numbers differ from the drawing by (24,), known exactly."""
    problem = problem_of(language)
    robot = problem.robot
    names = [name for key, u in robot.parameters.items() for name in u.names(key)]
    nominal = np.concatenate([np.atleast_1d(u.nominal) for u in robot.parameters.values()])
    changes = np.zeros(len(names)) if changes is None else changes
    rows = [
        {"name": n, "unit": "", "nominal": float(v), "estimate": float(v + c), "std": 0.0, "known_from": "samples"}
        for n, v, c in zip(names, nominal, changes, strict=True)
    ]
    rows += [{"name": f"tool_{axis}", "nominal": 0.0, "estimate": 0.0, "known_from": "prior alone"} for axis in "xyz"]
    document = {
        "converged": True,
        "parameters": rows,
        "unknowns": [{"name": n, "value": float(c)} for n, c in zip(names, changes, strict=True)],
        "covariance": np.zeros((len(names), len(names))).tolist(),
    }
    return CalibratedArm("made.json", ProblemFile(language, "problem.py", "", problem, None), document)


def changes_of(seed):
    """How a true arm differs from its drawing: alpha, a, d, theta of six rows."""
    return np.random.default_rng(seed).normal(0, 1, 24) * np.repeat([1e-3, 0.7, 0.7, 1e-3], 6)


def flange(language, joints, changes=None):
    """Pose (4, 4) of an arm's flange, by hand-multiplied DH."""
    alpha, a, d, theta = (np.array(DRAWINGS[language][key]) for key in ("alpha", "a", "d", "theta"))
    alpha, a, d, theta = np.array([alpha, a, d, theta]) + (0 if changes is None else changes.reshape(4, 6))
    return dh_chain(alpha, a, d, theta + joints)


def elementary(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    turn = np.eye(3)
    turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
    return turn


def vector_turn(v):
    """Rodrigues' rotation formula."""
    angle = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    if angle == 0:
        return np.eye(3)
    x, y, z = np.array(v) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def vector_of(turn):
    w, *axis = quaternion_of(turn)
    size = math.sqrt(sum(v * v for v in axis))
    return np.array(axis) * (2 * math.atan2(size, w) / size if size > 1e-300 else 2.0)


def quaternion_turn(q):
    w, x, y, z = np.array(q) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(turn):
    """Shepperd's method: the largest of the four components is found first."""
    squares = np.array([1 + np.trace(turn), *(1 + 2 * turn[i, i] - np.trace(turn) for i in range(3))])
    first = int(np.argmax(squares))
    x, y, z = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    xy, yz, zx = turn[0, 1] + turn[1, 0], turn[1, 2] + turn[2, 1], turn[2, 0] + turn[0, 2]
    rows = [[squares[0], x, y, z], [x, squares[1], xy, zx], [y, xy, squares[2], yz], [z, zx, yz, squares[3]]]
    q = np.array(rows[first])
    return q / np.linalg.norm(q) * (1 if q[0] >= 0 else -1)


def zyx_of(turn):
    return np.degrees(
        [
            math.atan2(turn[1, 0], turn[0, 0]),
            math.atan2(-turn[2, 0], math.hypot(turn[0, 0], turn[1, 0])),
            math.atan2(turn[2, 1], turn[2, 2]),
        ]
    )


def numbers_of(language, pose):
    """A pose (4, 4; mm) as a language's numbers."""
    place, turn = pose[:3, 3], pose[:3, :3]
    if language == "rapid":
        return [*place, *quaternion_of(turn)]
    if language == "urscript":
        return [*(place / 1000), *vector_of(turn)]
    angles = zyx_of(turn)
    return [*place, *(angles if language == "krl" else angles[::-1])]


def pose_of(language, numbers):
    """Numbers as a pose (4, 4; mm)."""
    pose, rest = np.eye(4), numbers[3:]
    pose[:3, 3] = np.array(numbers[:3]) * (1000 if language == "urscript" else 1)
    if language == "rapid":
        pose[:3, :3] = quaternion_turn(rest)
    elif language == "urscript":
        pose[:3, :3] = vector_turn(rest)
    else:
        a, b, c = np.radians(rest if language == "krl" else rest[::-1])
        pose[:3, :3] = elementary("z", a) @ elementary("y", b) @ elementary("x", c)
    return pose


def taken(language, wanted, start):
    """Joint values of the nominal arm at a flange's pose, by Newton's steps from near."""
    joints = np.array(start, dtype=float)

    def miss(q):
        pose = flange(language, q)
        return np.concatenate([(pose - wanted)[:3, 3] / 1000, vector_of(pose[:3, :3] @ wanted[:3, :3].T)])

    for _ in range(8):
        error = miss(joints)
        if np.abs(error).max() < 1e-13:
            break
        slope = np.array([(miss(joints + step) - miss(joints - step)) / 2e-6 for step in 1e-6 * np.eye(6)]).T
        joints = joints - np.linalg.solve(slope, error)
    return joints


def sides(language, joints):
    """Whether the wrist is behind axis 1, and behind the lower arm, of an arm like IRB; the margins, mm and mm^2."""
    drawing = DRAWINGS[language]
    points = [np.zeros(3)]
    for k in range(1, 6):
        part = (np.array(drawing[key][:k]) for key in ("alpha", "a", "d"))
        points.append(dh_chain(*part, np.array(drawing["theta"][:k]) + joints[:k])[:3, 3])
    along = np.array([math.cos(joints[0]), math.sin(joints[0]), 0])
    shoulder, elbow, wrist = ([point @ along, point[2]] for point in (points[1], points[2], points[5]))
    u, v = np.subtract(elbow, shoulder), np.subtract(wrist, elbow)
    cross = u[0] * v[1] - u[1] * v[0]
    return wrist[0] < 0, cross > 0, abs(wrist[0]), abs(cross)


def configuration(language, joints):
    """What the controller writes as configuration."""
    behind, elbow = (int(each) for each in sides(language, joints)[:2])
    quadrant = [math.floor(math.degrees(joints[k]) / 90) for k in (0, 3, 5)]
    if language == "rapid":
        return [*quadrant, 4 * behind + 2 * elbow + int(joints[4] < 0)]
    if language == "krl":
        return [behind + 2 * (not elbow), sum(int(joints[k] < 0) << k for k in range(6))]
    if language == "fanuc":
        turns = [math.floor((math.degrees(joints[k]) + 180) / 360) for k in (0, 3, 5)]
        return ["N" if joints[4] < 0 else "F", "D" if elbow else "U", "B" if behind else "T", *turns]
    flip = math.cos(joints[3]) < 0
    return [int(flip), elbow, behind, *(int(abs(joints[k]) > math.pi) for k in (3, 5, 0))]


def postures(language, count, seed):
    """Joint values (count, 6) well inside the limits, away from singularities, in every configuration."""
    rng, found = np.random.default_rng(seed), []
    limits = np.radians(LIMITS[language]) * 0.9
    while len(found) < count:
        joints = rng.uniform(-limits, limits)
        if abs(math.sin(joints[4])) < 0.3 or (language == "urscript" and abs(math.sin(joints[2])) < 0.3):
            continue
        if language == "urscript":
            columns = flange(language, joints)
            away = math.hypot(columns[0, 3] - 82.3 * columns[0, 2], columns[1, 3] - 82.3 * columns[1, 2])
            joints[3:] = np.where(np.abs(joints[3:]) > 3.5, joints[3:] / 2, joints[3:])
            if away < 250 or abs(math.sin(joints[4])) < 0.3:
                continue
        else:
            _, _, front, elbow = sides(language, joints)
            if front < 150 or elbow < 1.5e5:
                continue
            border = np.degrees(joints[[0, 3, 5]])
            if language == "yaskawa" and (np.abs(np.abs(border) - 180).min() < 2 or abs(math.cos(joints[3])) < 0.05):
                continue  # its RCONF belongs to all that follow it
        found.append(joints)
    return np.array(found)


@dataclass
class Written:
    """A program: texts by ending, what its targets are by key, and how the controller reads them back."""

    language: str
    files: dict = field(default_factory=dict)
    goals: dict = field(default_factory=dict)  # key -> kind, joints, tool, base
    options: dict = field(default_factory=dict)


def frames(language, seed):
    """A tool and a base, rounded as the language writes them."""
    rng = np.random.default_rng(seed)
    made = []
    for scale in (150, 600):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = vector_turn(rng.uniform(-1.2, 1.2, 3)), rng.uniform(-scale, scale, 3)
        numbers = [round(float(v), 6) for v in numbers_of(language, pose)]
        made.append((numbers, pose_of(language, numbers)))
    return made


def written(language, moves=60, seed=0, digits=9, end="\n"):
    """A program of so many moves; digits: decimals of lengths in mm, and what goes with them."""
    made = Written(language)
    joints = postures(language, moves, seed)
    tools_bases = [frames(language, 7 * seed + k) for k in range(2)]
    writers = {"rapid": _rapid, "krl": _krl, "urscript": _urscript, "fanuc": _fanuc, "yaskawa": _yaskawa}
    writers[language](made, joints, tools_bases, digits)
    made.files = {ending: text.replace("\n", end) for ending, text in made.files.items()}
    return made


def _listed(values, digits):
    return ",".join(f"{value:.{digits}f}" for value in values)


def _goal(made, key, kind, q, tool=None, base=None):
    made.goals[key] = (kind, q, np.eye(4) if tool is None else tool, np.eye(4) if base is None else base)
    return (
        np.linalg.inv(np.eye(4) if base is None else base)
        @ flange(made.language, q)
        @ (np.eye(4) if tool is None else tool)
    )


def _rapid(made, joints, pairs, digits):
    data, code = [], []
    for k, ((tool, _), (base, _)) in enumerate(pairs):
        data.append(
            f"  PERS tooldata tGrip{k}:=[TRUE,[[{_listed(tool[:3], 6)}],[{_listed(tool[3:], 6)}]],"
            "[4.5,[0,0,80],[1,0,0,0],0,0,0]];"
        )
        user, work = ("[[0,0,0],[1,0,0,0]]", f"[[{_listed(base[:3], 6)}],[{_listed(base[3:], 6)}]]")
        user, work = (user, work) if k else (work, user)
        data.append(f'  TASK PERS wobjdata wTable{k}:=[FALSE,TRUE,"",{user},{work}];')
    circle = False
    for i, q in enumerate(joints):
        k, name, end = i // 10 % 2, f"p{10 * i}", f"tGrip{i // 10 % 2}\\WObj:=wTable{i // 10 % 2}"
        (_, tool), (_, base) = pairs[k]
        if i % 9 == 0:
            _goal(made, f"j{i}", "joints", q)
            data.append(
                f"  CONST jointtarget j{i}:=[[{_listed(np.degrees(q), digits)}],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];"
            )
            code.append(f"    MoveAbsJ j{i}\\NoEOffs, v1000, z50, {end};")
            continue
        numbers = numbers_of("rapid", _goal(made, name, "pose", q, tool, base))
        config = ",".join(map(str, configuration("rapid", q)))
        place, turn = _listed(numbers[:3], digits), _listed(numbers[3:], digits + 2)
        literal = f"[[{place}],[{turn}],[{config}],[9E9,9E9,9E9,9E9,9E9,9E9]]"
        data.append(f"  {'LOCAL ' * (i % 4 == 1)}CONST robtarget {name} := {literal}; ! taught {name}:=[[1,2,3]]")
        if circle:
            code.append(f"    MoveC p{10 * (i - 1)}, {name}, v200, fine, {end};")
            circle = False
        elif i % 9 == 4 and (i + 1) // 10 % 2 == k and (i + 1) % 9 and i + 1 < len(joints):
            circle = True
        else:
            code.append(
                f"    {('MoveL', 'MoveJ', 'MoveLDO')[i % 3]} {name},v500,z10,{end}{',doGun,1' if i % 3 == 2 else ''};"
            )
        if i % 5 == 0:
            code += [
                f'    TPWrite "next MoveL {name}, v5, fine, tool0; [[1,2,3]]";',
                "    WaitTime 0.5;",
                "    IF diPart=1 THEN",
                "      Set doGrip;",
                "    ENDIF",
            ]
    made.files[".mod"] = "\n".join(
        [
            "%%%",
            "  VERSION:1",
            "%%%",
            "MODULE Cell",
            *data,
            "  PROC main()",
            "    ConfL\\On;",
            *code,
            "  ENDPROC",
            "ENDMODULE",
            "",
        ]
    )


def _krl(made, joints, pairs, digits):
    data, code = (
        ["DEFDAT cell PUBLIC"],
        ["&ACCESS RVP", "DEF cell ( )", ";FOLD INI", "  BAS (#INITMOV,0 )", ";ENDFOLD (INI)"],
    )
    rows = [
        f"{{X {t[0]:.6f},Y {t[1]:.6f},Z {t[2]:.6f},A {t[3]:.6f},B {t[4]:.6f},C {t[5]:.6f}}}"
        for pair in pairs
        for t, _ in pair
    ]
    code += [f"TOOL_DATA[1]={rows[0]}", f"BASE_DATA[1]={rows[1]}", "DECL FRAME fWork", f"fWork={rows[3]}"]
    made.options["tools"] = {"TOOL_DATA[2]": pairs[1][0][0]}
    circle = ""
    for i, q in enumerate(joints):
        k = i // 10 % 2
        (_, tool), (_, base) = pairs[k]
        if i % 10 == 0:
            code += ["", f"$TOOL=TOOL_DATA[{k + 1}]", "$BASE=BASE_DATA[1]" if k == 0 else "$BASE = fWork ; the table"]
        if i % 9 == 0:
            _goal(made, f"XJ{i}", "joints", q)
            axes = ",".join(f"A{j} {v:.{digits}f}" for j, v in enumerate(np.degrees(q), 1))
            data.append(f"DECL E6AXIS XJ{i}={{{axes},E1 0.0,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0}}")
            code.append(f"PTP XJ{i} C_PTP")
            continue
        numbers = numbers_of("krl", _goal(made, f"XP{i}", "pose", q, tool, base))
        status, turn = configuration("krl", q)
        shown = ",".join(f"{n} {v:.{digits}f}" for n, v in zip("XYZABC", numbers, strict=True))
        body = f"{{{shown},S {status},T {turn},E1 0.0,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0}}"
        if i % 4 == 3:
            data.append(f'DECL FDAT FP{i}={{TOOL_NO {k + 1},BASE_NO 1,IPO_FRAME #BASE,POINT2[] " ",TQ_STATE FALSE}}')
        if i % 7 == 3 and not circle:  # inline
            made.goals[f"inline {i}"] = made.goals.pop(f"XP{i}")
            code.append(f"{'SPTP' if i % 2 else 'PTP'} {body[:1]}E6POS: {body[1:]} C_PTP ;inline {i}")
            continue
        data.append(f"DECL {'GLOBAL ' * (i % 3 == 0)}E6POS XP{i}={body}")
        if circle:
            code.append(f"CIRC {circle}, XP{i}, CA 180.0 C_DIS")
            circle = ""
        elif i % 9 == 4 and (i + 1) % 10 and (i + 1) % 9 and (i + 1) % 7 != 3 and i + 1 < len(joints):
            circle = f"XP{i}"
        elif i % 4 == 3 and k == 0:
            code += [
                f";FOLD LIN P{i} Vel=2 m/s CPDAT1 Tool[1]:grip Base[1]:table;%{{PE}}%R 8.3,%P 1:LIN, 2:P{i}",
                "$BWDSTART=FALSE",
                "LDAT_ACT=LCPDAT1",
                f"FDAT_ACT=FP{i}",
                "BAS(#CP_PARAMS,2)",
                f"LIN XP{i}",
                ";ENDFOLD",
            ]
        else:
            code.append(f"{('LIN', 'PTP', 'SLIN')[i % 3]} XP{i}{' C_DIS' if i % 3 == 0 else ''}")
        if i % 6 == 0:
            code += [
                "WAIT SEC 0.2",
                f'MSG_TXT[]="PTP XP{i} {{X 1,Y 2}}"',
                "$OUT[17]=TRUE ; then LIN XP1",
                "IF $IN[3]==TRUE THEN",
                "  counter=counter+1",
                "ENDIF",
            ]
    made.files[".src"] = "\n".join([*code, "END", ""])
    made.files[".dat"] = "\n".join([*data, "ENDDAT", ""])


def _urscript(made, joints, pairs, digits):
    digits = digits + 3  # metres
    base_numbers, base_pose = pairs[0][1]
    code = ["def cell():", f"  table=p[{_listed(base_numbers, 6)}]", '  popup("movel(p[1,2,3,4,5,6])", blocking=False)']
    nearby = joints[0]
    for i, q in enumerate(joints):
        tool_numbers, tool = pairs[i // 10 % 2][0]
        if i % 10 == 0:
            code.append(f"  set_tcp(p[{_listed(tool_numbers, 6)}])")
        if i % 3 == 0:
            _goal(made, f"q{i}", "joints", q)
            values = _listed(q, digits) if i % 2 else ", ".join(f"d2r({v:.{digits}f})" for v in np.degrees(q))
            code.append(f"  global q{i}=[{values}]")
            code.append(f"  movej(q{i}, a=1.4, v=1.05, r=0.02) # q{i}=[1,2,3,4,5,6]")
            nearby = q
            continue
        rng = np.random.default_rng(i)
        q = nearby + rng.uniform(-0.2, 0.2, 6) * [1, 1, 0.3, 1, 0.3, 1]  # poses name no posture
        framed = i % 5 == 1
        pose = _goal(made, f"w{i}", "pose", q, tool, base_pose if framed else None)
        literal = f"p[{_listed(numbers_of('urscript', pose), digits)}]"
        code.append(f"  w{i} = {literal}")
        if framed:
            code.append(f"  movel(pose_trans(table, w{i}), a=1.2, v=0.25)")
        elif i % 5 == 2:
            code.append(f"  movej(get_inverse_kin(w{i}, qnear=[{_listed(q + 0.01, 4)}]), a=1.4, v=1.05)")
        else:
            code.append(f"  move{'lp'[i % 2]}(w{i}, a=1.2, v=0.25, r=0)")
        if i % 4 == 0:
            code += [
                "  set_digital_out(2, True)",
                "  sleep(0.3)",
                "  if get_digital_in(1) == True:",
                f'    textmsg("at ", w{i})',
                "  end",
            ]
        nearby = q
    made.files[".script"] = "\n".join([*code, "end", ""])


def _fanuc(made, joints, pairs, digits):
    code, data = [], []
    made.options = {
        "tools": {f"UT{k + 1}": pairs[k][0][0] for k in range(2)},
        "bases": {f"UF{k + 1}": pairs[k][1][0] for k in range(2)},
    }
    circle = False

    def say(text):
        code.append(f"{len(code) + 1:4d}:{text} ;")

    for i, q in enumerate(joints, 1):
        k = i // 10 % 2
        if i % 10 == 0 or i == 1:
            say(f"  UFRAME_NUM={k + 1}")
            say(f"  UTOOL_NUM={k + 1}")
        label = f"P[{i}]" if i % 4 else f'P[{i}:"LJ P1 {i}"]'
        move = label.replace('"', "")
        if i % 9 == 0:
            _goal(made, i, "joints", q)
            names = [f"J{j}= {v:9.{digits}f} deg" for j, v in enumerate(np.degrees(q), 1)]
            data += [
                f"{label}{{",
                "   GP1:",
                f"\tUF : {k + 1}, UT : {k + 1},\t",
                "\t" + ",\t".join(names[:3]) + ",",
                "\t" + ",\t".join(names[3:]),
                "};",
            ]
            say(f"J {move} 100% FINE   ")
            continue
        (_, tool), (_, base) = pairs[k]
        numbers = numbers_of("fanuc", _goal(made, i, "pose", q, tool, base))
        flip, elbow, back, *turns = configuration("fanuc", q)
        shown = [re.sub(r"(?<![\d])(-?)0\.", r"\1.", f"{v:.{digits}f}").rjust(10) for v in numbers]
        config = f"'{flip} {elbow} {back}, {turns[0]}, {turns[1]}, {turns[2]}'"
        data += [f"{label}{{", "   GP1:", f"\tUF : {k + 1}, UT : {k + 1},\t\tCONFIG : {config},"]
        data += [f"\tX ={shown[0]}  mm,\tY ={shown[1]}  mm,\tZ ={shown[2]}  mm,"]
        data += [f"\tW ={shown[3]} deg,\tP ={shown[4]} deg,\tR ={shown[5]} deg", "};"]
        if circle:
            code[-1] = code[-1].replace(" ;", f"\n    :  {move} 100mm/sec CNT50    ;")
            circle = False
        elif i % 9 == 4 and (i + 1) % 10 and (i + 1) % 9 and i < len(joints):
            say(f"C {move}   ")
            circle = True
            continue
        else:
            say(f"{'JL'[i % 2]} {move} {'100%' if i % 2 == 0 else 'R[5]mm/sec'} CNT{i % 100} ACC80   ")
        if i % 5 == 0:
            say("  !L P[1] 100mm/sec FINE")
            say("  DO[3:gun P[2]]=ON")
            say("  WAIT   .30(sec)")
    head = [
        "/PROG  CELL",
        "/ATTR",
        "OWNER\t\t= MNEDITOR;",
        'COMMENT\t\t= "P[1] = 5";',
        f"LINE_COUNT\t= {len(code)};",
        "/APPL",
        "/MN",
    ]
    made.files[".LS"] = "\n".join([*head, *code, "/POS", *data, "/END", ""])


def _yaskawa(made, joints, pairs, digits):
    code, data = [], ["/JOB", "//NAME CELL", "//POS", f"///NPOS {len(joints)},0,0,0,0,0"]
    made.options = {
        "tools": {f"TOOL{k}": pairs[k][0][0] for k in range(2)},
        "bases": {f"USER{k + 1}": pairs[k][1][0] for k in range(2)},
        "pulses": PULSES,
    }
    for i, q in enumerate(joints):
        k, name = i // 10 % 2, f"C{i:05d}"
        (_, tool), (_, base) = pairs[k]
        data.append(f"///TOOL {k}")
        if i % 9 == 0:
            pulses = [round(v) for v in np.degrees(q) * PULSES]
            _goal(made, name, "joints", np.radians(np.array(pulses) / PULSES))
            data += ["///POSTYPE PULSE", "///PULSE", f"{name}={','.join(map(str, pulses))}"]
            code.append(f"MOVJ {name} VJ=25.00")
            continue
        user = i % 2
        pose = _goal(made, name, "pose", q, tool, base if user else None)
        data += [f"///USER {k + 1}"] * user + [f"///POSTYPE {'USER' if user else 'ROBOT'}", "///RECTAN"]
        data += [
            f"///RCONF {','.join(map(str, configuration('yaskawa', q)))},0,0",
            f"{name}={_listed(numbers_of('yaskawa', pose), digits)}",
        ]
        code.append(f"{('MOVL', 'MOVJ', 'MOVC', 'MOVS')[i % 4]} {name} {'VJ=10.0' if i % 4 == 1 else 'V=138.0'} PL=0")
        if i % 6 == 0:
            code += ["'MOVL C00001 V=1", "DOUT OT#(3) ON", "TIMER T=0.30", "SET B000 1"]
    made.files[".JBI"] = "\n".join(
        [
            *data,
            "//INST",
            "///DATE 2020/01/31 12:00",
            "///COMM MOVL C00001",
            "///ATTR SC,RW",
            "///GROUP1 RB1",
            "NOP",
            *code,
            "END",
            "",
        ]
    )


NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"


def read_back(made, files):
    """Numbers of each target, by its key, as this file reads them: [six or seven numbers], configuration."""
    found, text = {}, "\n".join(files.values())
    for key, (kind, *_) in made.goals.items():
        if made.language == "rapid":
            row = re.search(rf"target {key}\s*:=\s*(\[[^!;]*);", text)[1]
        elif made.language == "krl":
            name = str(key)
            row = (
                re.search(rf"[^\n]*;{name}\s", text)[0]
                if name.startswith("inline")
                else re.search(rf" {name}=([^\n]*)", text)[1]
            )
            row = row.partition(" C_PTP")[0].replace("E6POS", "")
        elif made.language == "urscript":
            row = re.search(rf"{key}\s?=([^\n#]*)", text)[1].replace("d2r", "")
        elif made.language == "fanuc":
            row = (
                re.search(rf"(?s)\nP\[{key}(?::[^\]]*\])?\]?\{{(.*?)\}}", text)[1].partition("UT")[2].partition(",")[2]
            )
            row = (
                row
                if kind == "joints"
                else re.sub("[NFUDTB]", lambda m: str(ord(m[0])), row.partition("'")[2]).replace(" P ", "")
            )
        else:
            row = re.search(rf"\n{key}=([^\n\r]*)", text)[1]
        row = re.sub(r"\b[A-Z]\d\s*=?(?=\s)|J\d=", " ", row)
        found[key] = [float(each) for each in re.findall(NUMBER, row)]
    return found


def landed(made, numbers, start):
    """Joint values that the controller takes for the numbers of a target, by key, beginning near a start (6,)."""
    joints = {}
    for key, (kind, _, tool, base) in made.goals.items():
        values = numbers[key]
        if kind == "joints":
            turns = values[:6]
            if made.language == "yaskawa":
                joints[key] = np.radians(np.array(turns) / PULSES)
            elif made.language == "urscript" and int(str(key)[1:]) % 2:
                joints[key] = np.array(turns)
            else:
                joints[key] = np.radians(turns)
            continue
        values = values[-6:] if made.language == "fanuc" else values
        pose = pose_of(made.language, values[: 7 if made.language == "rapid" else 6])
        joints[key] = taken(made.language, base @ pose @ np.linalg.inv(tool), start[key])
    return joints
