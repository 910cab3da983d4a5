"""Programs in place: round trips through a controller of this test's own, bytes that stay, and refusals by line."""

import csv
import difflib
import json
import math
import re

import numpy as np
import pytest
import written_programs as w
from conftest import ROOT
from oracles import dh_chain
from scipy.spatial.transform import Rotation
from written_programs import ENDINGS, arm_of, changes_of, flange, landed, read_back, written

from casacal import calibrate
from casacal.calibration.result_json import calibration_document
from casacal.cli.main import main
from casacal.deployment.compensate import Outcome
from casacal.deployment.predict import predict
from casacal.errors import CasacalError, RefusedResultError
from casacal.files import write_json
from casacal.programs import TaughtProgram, compensate_program, predict_program, read_program
from casacal.programs.program import Form, Number

LANGUAGES = list(ENDINGS)


def stored(made, folder, coding="utf-8", head=b""):
    """The files of a program in a folder; the path of the one that names it."""
    for ending, text in made.files.items():
        (folder / f"cell{ending}").write_bytes(head + text.encode(coding))
    return folder / f"cell{ENDINGS[made.language]}"


def tips(made, joints, changes=None):
    """Where the tips stand (N, 3) at joint values by key."""
    rows = [(flange(made.language, joints[key], changes) @ tool)[:3, 3] for key, (_, _, tool, _) in made.goals.items()]
    return np.array(rows)


def meant_joints(made):
    return {key: joints for key, (_, joints, _, _) in made.goals.items()}


def corrected(made, folder, arm, **options):
    program = read_program(stored(made, folder), **made.options)
    assert not program.puzzles
    assert len(program.targets) == len(made.goals)
    done = compensate_program(arm, program, **options)
    assert done.reached.all()
    return done, read_back(made, dict(zip(made.files, done.texts, strict=True)))


def last_digit(made, digits):
    """How far (mm) the tip may be off for the digits of a file; a pulse is a thousandth of a degree."""
    if made.language == "yaskawa":
        return 0.05
    return 3e-7 if digits == 9 else 10 ** (1 - digits) * 20


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("digits", [9, 3])
def test_the_true_arm_stands_where_the_program_meant_it(language, digits, tmp_path):
    """Joints, poses, circles, both wrists and elbows, turns beyond 180 degrees, two tools and bases."""
    made, changes = written(language, moves=60, seed=4, digits=digits), changes_of(3)
    done, numbers = corrected(made, tmp_path, arm_of(language, changes))
    joints = landed(made, numbers, meant_joints(made))
    original = landed(made, read_back(made, made.files), meant_joints(made))
    meant, before = tips(made, original), tips(made, original, changes)
    off = np.linalg.norm(tips(made, joints, changes) - meant, axis=1)
    assert off.max() < last_digit(made, digits)
    assert np.median(np.linalg.norm(before - meant, axis=1)) > 1.0
    ours = np.array([target.kind == "pose" for target in done.program.targets])
    theirs = np.array([kind == "pose" for kind, *_ in made.goals.values()])
    sizes = np.linalg.norm(before - meant, axis=1)
    np.testing.assert_allclose(np.sort(done.correction_mm[ours]), np.sort(sizes[theirs]), atol=1e-5)
    np.testing.assert_allclose(np.sort(done.left_mm[ours]), np.sort(off[theirs]), atol=1e-6)
    turned = np.abs(np.array(list(meant_joints(made).values()))[:, 3:])
    assert language == "urscript" or (turned > math.pi).any()


@pytest.mark.parametrize("language", [each for each in LANGUAGES if each != "urscript"])
def test_the_configuration_stated_is_that_of_the_corrected_joint_values(language, tmp_path):
    """On postures beside borders of quadrants and turns, which corrections pass."""
    made = written(language, moves=50, seed=8)
    _, numbers = corrected(made, tmp_path, arm_of(language, changes_of(5)))
    joints = landed(made, numbers, meant_joints(made))
    passed = 0
    for key, (kind, q, _, _) in made.goals.items():
        if kind == "joints" or language == "yaskawa":
            continue
        stated = w.configuration(language, joints[key])
        if language == "fanuc":
            read = [*(chr(int(each)) for each in numbers[key][:3]), *map(int, numbers[key][3:6])]
        else:
            read = [int(each) for each in numbers[key][7:11] if language == "rapid"] or [
                int(e) for e in numbers[key][6:8]
            ]
        assert read == stated, key
        passed += stated != w.configuration(language, q)
    assert language != "krl" or passed >= 0


@pytest.mark.parametrize("language", LANGUAGES)
def test_taught_points_come_back_to_nominal_and_to_where_they_were(language, tmp_path):
    made, changes = written(language, moves=40, seed=6), changes_of(9)
    arm = arm_of(language, changes)
    _, numbers = corrected(made, tmp_path, arm, inverse=True)
    joints = landed(made, numbers, meant_joints(made))
    taught = landed(made, read_back(made, made.files), meant_joints(made))
    off = np.linalg.norm(tips(made, joints) - tips(made, taught, changes), axis=1)  # nominal now as the true arm was
    assert off.max() < last_digit(made, 9)


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_program_moves_to_another_arm_of_its_type(language, tmp_path):
    made, one, two = written(language, moves=40, seed=7), changes_of(1), changes_of(2)
    _, numbers = corrected(made, tmp_path, arm_of(language, one), onto=arm_of(language, two))
    joints = landed(made, numbers, meant_joints(made))
    taught = landed(made, read_back(made, made.files), meant_joints(made))
    off = np.linalg.norm(tips(made, joints, two) - tips(made, taught, one), axis=1)
    assert off.max() < last_digit(made, 9)


@pytest.mark.long
@pytest.mark.parametrize(("language", "seed"), [(language, seed) for seed, language in enumerate(LANGUAGES)])
def test_programs_of_500_lines_on_five_true_arms(language, seed, tmp_path):
    made, changes = written(language, moves=260, seed=100 + seed), changes_of(40 + seed)
    assert sum(len(text.splitlines()) for text in made.files.values()) >= 500
    done, numbers = corrected(made, tmp_path, arm_of(language, changes))
    off = np.linalg.norm(
        tips(made, landed(made, numbers, meant_joints(made)), changes) - tips(made, meant_joints(made)), axis=1
    )
    assert off.max() < last_digit(made, 9)
    assert done.correction_mm.max() > 2


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_perfect_arm_changes_no_byte(language, tmp_path):
    made = written(language, moves=30, seed=3, digits=6, end="\r\n")
    done = compensate_program(arm_of(language), read_program(stored(made, tmp_path), **made.options))
    assert done.texts == tuple(text for text in made.files.values())
    assert done.diff == ""


@pytest.mark.parametrize(
    ("language", "coding", "head"),
    [
        ("rapid", "latin-1", b""),
        ("krl", "utf-8", b"\xef\xbb\xbf"),
        ("urscript", "utf-8", b""),
        ("fanuc", "cp1252", b""),
        ("yaskawa", "latin-1", b""),
    ],
)
def test_only_digits_of_targets_change(language, coding, head, tmp_path):
    """Byte order mark, CRLF, umlauts of three encodings; comments and strings that look like targets."""
    made = written(language, moves=40, seed=5, digits=4, end="\r\n")
    mark = {"rapid": "! ", "krl": ";", "urscript": "# ", "fanuc": " 900:  !", "yaskawa": "'"}[language]
    first = next(iter(made.files))
    lines = made.files[first].split("\r\n")
    marks = {"fanuc": "/MN", "yaskawa": "NOP"}
    at = lines.index(marks[language]) + 1 if language in marks else 4
    lines.insert(
        at,
        f"{mark}Fläche prüfen {{X 1,Y 2}} p[1,2,3,4,5,6] [[1,2,3]]" + (" ;" if language == "fanuc" else ""),
    )
    made.files[first] = "\r\n".join(lines)
    path = stored(made, tmp_path, coding, head)
    done = compensate_program(arm_of(language, changes_of(2)), read_program(path, **made.options))
    for ending, text in zip(made.files, done.texts, strict=True):
        before, after = (tmp_path / f"cell{ending}").read_bytes(), text.encode("latin-1")
        assert after.startswith(head)
        assert masked(after) == masked(before)
        assert before.count(b"\r\n") == after.count(b"\r\n")
        kept = [line for line in before.split(b"\r\n") if b"Fl" in line or b"popup" in line or b"TPWrite" in line]
        assert all(line in after.split(b"\r\n") for line in kept)
    assert done.reached.all()


def masked(data):
    """Bytes with every number as one mark: what may not change."""
    return re.sub(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", b"#", data)


def test_a_diff_shows_lines_that_change_and_no_others(tmp_path):
    made = written("rapid", moves=20, seed=2, digits=3)
    done = compensate_program(arm_of("rapid", changes_of(1)), read_program(stored(made, tmp_path)))
    ours = [line for line in done.diff.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    theirs = [
        line for line in difflib.ndiff(made.files[".mod"].splitlines(), done.texts[0].splitlines()) if line[0] in "+-"
    ]
    assert sorted(line[1:] for line in ours) == sorted(line[2:] for line in theirs)
    assert 0 < len(ours) <= 2 * len(done.program.targets)


@pytest.mark.parametrize(
    ("old", "value", "new"),
    [
        ("12.500", 12.5004, "12.500"),
        ("12.500", 12.5006, "12.501"),
        ("600", 600.25, "600.250"),
        ("+1.0000", 1.5, "+1.5000"),
        (".131", -0.2, "-.200"),
        ("-.000", 0.0001, "-.000"),
        ("-.001", 0.0001, ".000"),
        ("0.5", -0.00001, "0.000"),
        ("7.22116E-07", 3e-4, "3.00000E-04".replace("3.00000", "3.000000")),
        ("1e2", 250.0, "2.500000e+02"),
        ("5.", 5.0, "5."),
    ],
)
def test_numbers_keep_the_form_of_their_digits(old, value, new):
    number = Number(0, 0, len(old), float(old), 1.0, 3)
    assert number.written(old, value) == new
    assert Number(0, 0, 3, 512.0).written("512", 512.4) == "512"
    assert Number(0, 0, 3, 512.0).written("512", 513.4) == "513"


@pytest.mark.parametrize("turned", ["quaternion", "vector", "zyx", "xyz"])
def test_orientations_are_those_of_the_makers(turned):
    """Against elementary rotations multiplied by hand, at random, near and at the singular second angle."""
    language = {"quaternion": "rapid", "vector": "urscript", "zyx": "krl", "xyz": "fanuc"}[turned]
    form = Form(1000.0 if turned == "vector" else 1.0, turned, (3, 3), "")
    rng = np.random.default_rng(0)
    for k in range(200):
        if turned in ("zyx", "xyz"):
            rest = rng.uniform(-180, 180, 3)
            rest[1] = (90.0, -90.0, 89.9999999, rest[1])[k % 4]
        else:
            rest = w.numbers_of(
                language, np.block([[w.vector_turn(rng.uniform(-2, 2, 3)), np.zeros((3, 1))], [np.zeros(3), 1]])
            )[3:]
        numbers = [*rng.uniform(-2, 2, 3), *rest]
        pose = w.pose_of(language, numbers)
        np.testing.assert_allclose(form.pose(numbers), pose, atol=1e-12)
        near = np.array(numbers) + rng.normal(0, 1e-3, len(numbers))
        back = form.numbers(pose, near)
        np.testing.assert_allclose(w.pose_of(language, back), pose, atol=1e-9)
        if turned not in ("zyx", "xyz") or k % 4 == 3:
            np.testing.assert_allclose(back, numbers, atol=1e-6)


RAPID = """MODULE M
  PERS tooldata t1:=[TRUE,[[0,0,150],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];
  CONST jointtarget j1:=[[0,0,0,0,45,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  CONST robtarget p1:=[[900,0,900],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  PROC main()
    MoveAbsJ j1,v100,fine,t1;
    {line}
  ENDPROC
ENDMODULE
"""
KRL = """DEF m()
$TOOL={{X 0,Y 0,Z 150,A 0,B 0,C 0}}
$BASE=$NULLFRAME
PTP {{A1 0,A2 -90,A3 90,A4 0,A5 45,A6 0}}
{line}
END
"""
SCRIPT = "def m():\n  set_tcp(p[0,0,0.1,0,0,0])\n  movej([0,-1.5,1.5,0,1,0])\n  {line}\nend\n"
LS = """/PROG  M
/MN
   1:J P[1] 100% FINE    ;
   2:  {line} ;
/POS
P[1]{{
   GP1:
\tUF : 0, UT : 0,\t
\tJ1= 0.000 deg,\tJ2= 0.000 deg,\tJ3= 0.000 deg,
\tJ4= 0.000 deg,\tJ5= -45.000 deg,\tJ6= 0.000 deg
}};
P[2]{{
   GP1:
\tUF : 0, UT : 4,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX = 900.000 mm,\tY = 0.000 mm,\tZ = 900.000 mm,
\tW = 180.000 deg,\tP = 0.000 deg,\tR = 0.000 deg
}};
/END
"""
JBI = """/JOB
//NAME M
//POS
///TOOL 0
///POSTYPE ANGLE
C00000=0.0,0.0,0.0,0.0,45.0,0.0
///POSTYPE PULSE
C00001=0,0,0,0,9,0
//INST
NOP
MOVJ C00000 VJ=1
{line}
END
"""
TEXTS = {".mod": RAPID, ".src": KRL, ".script": SCRIPT, ".ls": LS, ".jbi": JBI}
NOT_UNDERSTOOD = [
    (".mod", "MoveL Offs(p1,0,0,50),v100,fine,t1;", 7, "computed at run time"),
    (".mod", "MoveL RelTool(p1,0,0,50),v100,fine,t1;", 7, "computed at run time"),
    (".mod", "MoveL *,v100,fine,t1;", 7, "computed at run time"),
    (".mod", "MoveL pFar,v100,fine,t1;", 7, "'pFar' is not set"),
    (".mod", "MoveL p1,v100,fine,tOther;", 7, "the tool 'tOther' is not defined here"),
    (".mod", "MoveL p1,v100,fine,t1\\WObj:=wOther;", 7, "the base 'wOther' is not defined here"),
    (".mod", "MoveL p1,v100,fine,t1; p1.trans.z:=5;", 7, "set again at run time"),
    (".mod", "p1:=CRobT();  MoveL p1,v100,fine,t1;", 7, "set again at run time"),
    (".mod", "PDispSet d; MoveL p1,v100,fine,t1;", 7, "shifts the"),
    (".mod", "Pick p1, 50;", 7, "what is done with the target 'p1'"),
    (".mod", "TriggAbsJ [[0,0,0,0,45,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v100,t,fine,t1;", 7, "TriggAbsJ moves or shifts"),
    (".mod", "SearchL di1, sp, p1, v100, t1;", 7, "SearchL moves or shifts"),
    (".mod", "MoveL [[900,0,900],[0,0,2,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v100,fine,t1;", 7, "length 2, not 1"),
    (".mod", "MoveL [[900,0,900],[0,0,1,0],[0,0,0,0],[500,9E9,9E9,9E9,9E9,9E9]],v100,fine,t1;", 7, "external axis"),
    (".mod", "MoveL [[9 00,0,900],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v100,fine,t1;", 7, "not a plain"),
    (".src", "LIN P1:{X 10}", 5, "'P1' is not set"),
    (".src", "LIN_REL {Z 50}", 5, "LIN_REL moves or shifts"),
    (".src", "PTP {A1 10}", 5, "leaves A2 as it is"),
    (".src", "LIN $POS_ACT", 5, "computed at run time"),
    (".src", "LIN P[3]", 5, "computed at run time"),
    (".src", "SPLINE WITH $TOOL=TOOL_DATA[2]\n SPL {X 900,Y 0,Z 900,A 0,B 90,C 0}\nENDSPLINE", 6, "its WITH"),
    (".src", "SLIN {X 900,Y 0,Z 900,A 0,B 90,C 0} WITH $IPO_MODE=#TCP", 5, "IPO_MODE=#TCP moves or shifts"),
    (".script", "movel(pose_add(get_actual_tcp_pose(), p[0,0,0.1,0,0,0]))", 4, "computed at run time"),
    (".script", "movel(w9)", 4, "'w9' is not set"),
    (".script", "servoj([0,0,0,0,0,0])", 4, "servoj moves or shifts"),
    (".script", "movel(pose_trans(plane, p[0.1,0,0.1,0,0,0]))", 4, "'plane' is not set|'plane'"),
    (".script", "blend_move(p[0.4,0,0.4,0,3.14,0])", 4, "blend_move moves or shifts"),
    (".script", "movej(get_inverse_kin(p[0.4,0,0.4,0,3,0], [0,-1.5,1.5,0,1,0], 0, 0, x9))", 4, "'x9' is not set"),
    (".script", "movej(get_inverse_kin(p[0.4,0,0.4,0,3.14,0], limits=3))", 4, "told by 'limits' is not understood"),
    (".script", "movej([0,-1.5,1.5,0,1])", 4, "computed at run time|not six"),
    (".ls", "L PR[3] 100mm/sec FINE", None, "is a register"),
    (".ls", "L P[R[1]] 100mm/sec FINE", None, "is a register"),
    (".ls", "L P[1] 100mm/sec FINE Offset,PR[2]", None, "Offset shifts the target"),
    (".ls", "L P[2] 100mm/sec FINE", None, "the tool 'UT4' is not defined"),
    (".ls", "L P[7] 100mm/sec FINE", None, r"P\[7\]. is not set"),
    (".jbi", "MOVL P001 V=1", 12, "variable"),
    (".jbi", "MOVL C00001 V=1", 12, "pulses"),
    (".jbi", "EIMOVL P001 V=1", 12, "EIMOVL moves or shifts"),
    (".jbi", "IMOV P001 V=1", 12, "IMOV moves or shifts"),
    (".jbi", "MOVL C00000 BC00001 V=1", 12, "another machine"),
]  # fmt: skip


@pytest.mark.parametrize(("ending", "line", "number", "words"), NOT_UNDERSTOOD)
def test_what_is_not_understood_is_refused_by_line_or_left_as_it_is(ending, line, number, words, tmp_path):
    path = tmp_path / f"m{ending}"
    text = TEXTS[ending].format(line=line).replace("   2:  L ", "   2:L ")
    path.write_text(text, newline="")
    program = read_program(path)
    language = program.language
    assert len(program.puzzles) >= 1
    number = number or next(i for i, each in enumerate(text.splitlines(), 1) if each.startswith("   2:"))
    with pytest.raises(CasacalError, match=rf"m\{ending}, line {number}: .*({words})"):
        compensate_program(arm_of(language, changes_of(1)), program)
    if line != next(each for kind, each, *_ in NOT_UNDERSTOOD if kind == ending):
        return  # one of a language is enough
    done = compensate_program(arm_of(language, changes_of(1)), program, skip_unknown=True)
    assert done.reached.any()  # the joint target above it
    assert line in done.texts[0]


def test_frames_that_a_program_changes_cannot_be_given(tmp_path):
    """What an option states would hold at one of its moves, and not at the other."""
    line = "MoveL p1,v100,fine,t1\\WObj:=w1; w1.oframe.trans.x:=w1.oframe.trans.x+50; MoveL p1,v100,fine,t1\\WObj:=w1;"
    work = '  PERS wobjdata w1:=[FALSE,TRUE,"",[[100,0,0],[1,0,0,0]],[[0,10,0],[1,0,0,0]]];\n  PROC main'
    (tmp_path / "m.mod").write_text(RAPID.format(line=line).replace("  PROC main", work))
    (tmp_path / "m.src").write_text(
        KRL.format(line="$BASE=BASE_DATA[2]\nBASE_DATA[2].X=100\nLIN {X 1,Y 2,Z 3,A 0,B 0,C 0}")
    )
    for name, frame, given in (
        ("m.mod", "w1", [100, 10, 0, 1, 0, 0, 0]),
        ("m.src", "BASE_DATA[2]", [0, 0, 0, 0, 0, 0]),
    ):
        for bases in ({}, {frame: given}):
            (puzzle, *_) = read_program(tmp_path / name, bases=bases).puzzles
            assert puzzle.what == f"the program itself sets the base '{frame}', more than once or in parts"
            assert puzzle.fix == "Set it once, with plain numbers, or correct its moves by hand"


def test_a_tool_of_inverse_kinematics_and_optimised_moves_are_read(tmp_path):
    pose, joints = "p[0.4,0.1,{},0,3.14,0]", "[0,-1.5,1.5,0,1,0]"
    lines = [
        f"movej(get_inverse_kin({pose.format(0.1)}, {joints}, 1e-6, 1e-6, p[0,0,0.3,0,0,0]))",
        f"movej(get_inverse_kin({pose.format(0.2)}, {joints}, tcp=p[0,0,0.3,0,0,0]))",
        f'movej(get_inverse_kin({pose.format(0.3)}, qnear={joints}, tcp="active_tcp"))',
        f"optimovel({pose.format(0.4)})",
        "optimovej([0,-1,1,0,1,0])",
    ]
    (tmp_path / "m.script").write_text(SCRIPT.format(line="\n  ".join(lines)))
    program = read_program(tmp_path / "m.script")
    assert not program.puzzles
    assert [move.motion for move in program.moves] == ["joint", "joint", "joint", "joint", "linear", "joint"]
    assert [each.tool[2, 3] for each in program.targets if each.kind == "pose"] == [300, 300, 100, 100]


def test_a_spline_has_frames_of_its_own_and_a_jump_back_is_a_loop(tmp_path):
    data = """DEFDAT m
DECL E6POS XP1={X 900,Y 0,Z 900,A 0,B 90,C 0,S 2,T 0}
DECL E6POS XP2={X 910,Y 0,Z 900,A 0,B 90,C 0,S 2,T 0}
DECL FDAT FP1={TOOL_NO 1,BASE_NO 1,IPO_FRAME #BASE}
DECL FDAT FP2={TOOL_NO 2,BASE_NO 2,IPO_FRAME #BASE}
ENDDAT
"""
    frames = {"tools": {f"TOOL_DATA[{k}]": [0, 0, 100.0 * k, 0, 0, 0] for k in (1, 2)},
              "bases": {f"BASE_DATA[{k}]": [10.0 * k, 0, 0, 0, 0, 0] for k in (1, 2)}}  # fmt: skip
    head = "DEF m()\nFDAT_ACT=FP1\nBAS(#BASE,1)\nBAS(#TOOL,1)\n"
    (tmp_path / "m.dat").write_text(data)
    spline = "SPLINE WITH $BASE=SBASE(FP2.BASE_NO), $TOOL=STOOL2(FP2)\n SPL XP1\nENDSPLINE\nSLIN XP2\nEND\n"
    (tmp_path / "m.src").write_text(head + spline)
    program = read_program(tmp_path / "m.src", **frames)
    assert not program.puzzles
    assert [(each.name, each.tool[2, 3], each.base[0, 3]) for each in program.targets] == [
        ("XP1", 200, 20),
        ("XP2", 100, 10),
    ]
    (tmp_path / "m.src").write_text(f"{head}AGAIN:\nLIN XP1\nBAS(#BASE,2)\nLIN XP2\nGOTO AGAIN\nEND\n")
    del frames["tools"]["TOOL_DATA[2]"]
    (puzzle,) = read_program(tmp_path / "m.src", **frames).puzzles
    assert (puzzle.line, puzzle.what[:21]) == (6, "which base holds here")


def test_moves_within_a_shift_stay_as_they_are(tmp_path):
    lines = ["PDispSet d;", "MoveL p1,v100,fine,t1;", "PDispOff;", "MoveJ p1,v100,fine,t1;"]
    (tmp_path / "m.mod").write_text(RAPID.format(line="\n    ".join(lines)))
    program = read_program(tmp_path / "m.mod")
    assert [puzzle.line for puzzle in program.puzzles] == [7, 8]
    assert [move.line for move in program.moves] == [6, 10]
    lines = ["SFTON P001", "MOVL C00000 V=1", "SFTOF", "MOVJ C00000 VJ=1"]
    (tmp_path / "m.jbi").write_text(JBI.format(line="\n".join(lines)))
    program = read_program(tmp_path / "m.jbi")
    assert [puzzle.line for puzzle in program.puzzles] == [12, 13]
    assert [move.line for move in program.moves] == [11, 15]


def test_frames_can_be_given_and_move_the_correction(tmp_path):
    """A base and a tool from outside, and where world and flange stand, against those written in the program."""
    made = written("fanuc", moves=12, seed=2)
    program = read_program(stored(made, tmp_path), **made.options)
    plain = compensate_program(arm_of("fanuc", changes_of(1)), program)
    shift = [100.0, -50.0, 25.0, 10.0, 20.0, 30.0]
    away = w.pose_of("fanuc", shift)
    moved = {
        name: w.numbers_of("fanuc", np.linalg.inv(away) @ w.pose_of("fanuc", pose))
        for name, pose in made.options["bases"].items()
    }
    turned = {
        name: w.numbers_of("fanuc", np.linalg.inv(away) @ w.pose_of("fanuc", pose))
        for name, pose in made.options["tools"].items()
    }
    again = read_program(program.paths[0], bases={**moved, "World": shift}, tools={**turned, "flange": shift})
    done = compensate_program(arm_of("fanuc", changes_of(1)), again)
    for one, two in zip(plain.texts[0].split(), done.texts[0].split(), strict=True):
        assert one == two or abs(float(one) - float(two)) < 2e-8


def test_a_pose_without_configuration_needs_a_beginning(tmp_path):
    made = written("urscript", moves=12, seed=3)
    text = re.sub(r"  (global q0|movej\(q0).*\n", "", made.files[".script"])
    made.files[".script"] = re.sub(r"(?s)(\n  w1 = .*?\n)(.*?)\n  global q3.*", r"\1\2\nend\n", text)
    path = stored(made, tmp_path)
    arm = arm_of("urscript", changes_of(1))
    with pytest.raises(CasacalError, match="neither a joint target nor --near says where it begins"):
        compensate_program(arm, read_program(path))
    begin = meant_joints(made)["q0"]
    done = compensate_program(arm, read_program(path), begin=begin)
    assert done.reached.all()
    assert done.correction_rad.max() < 0.1


def test_degrees_for_radians_a_wrong_tool_and_a_far_target_are_named(tmp_path):
    arm = arm_of("urscript", changes_of(1))
    (tmp_path / "deg.script").write_text(SCRIPT.format(line="movej([0,-90,90,0,90,0])"))
    with pytest.raises(CasacalError, match=r"line 4.*joint \d would stand at .* degrees.*d2r\(90\)"):
        compensate_program(arm, str(tmp_path / "deg.script"))
    (tmp_path / "m.script").write_text(SCRIPT.format(line="movel(p[3,0,0,0,0,0])"))
    with pytest.raises(CasacalError, match="no posture of the drawn arm takes it"):
        compensate_program(arm, str(tmp_path / "m.script"))
    (tmp_path / "m.mod").write_text(
        RAPID.format(line="MoveL p1,v100,fine,t1;").replace("[0,0,0,0],[9E9", "[0,0,0,6],[9E9")
    )
    with pytest.raises(
        CasacalError, match=r"m.mod, line 4, target 'p1': no posture .* in the configuration that it states"
    ):
        compensate_program(arm_of("rapid", changes_of(1)), str(tmp_path / "m.mod"))


def test_a_singular_target_and_a_jump_are_refused(tmp_path):
    arm = arm_of("rapid", changes_of(1))
    for q5 in (0.0, 0.03, -0.03):
        numbers = w.numbers_of("rapid", flange("rapid", np.radians([10, 10, 10, 40, q5, 20])))
        place, turn = (",".join(f"{v:.12f}" for v in part) for part in (numbers[:3], numbers[3:]))
        line = f"MoveL [[{place}],[{turn}],[0,0,0,{int(q5 < 0)}],[9E9,9E9,9E9,9E9,9E9,9E9]],v5,fine,tool0;"
        (tmp_path / "m.mod").write_text(RAPID.format(line=line))
        with pytest.raises(
            CasacalError, match=r"line 7, target .*(singular|jumps to another configuration|no posture)"
        ):
            compensate_program(arm, str(tmp_path / "m.mod"))
        done = compensate_program(arm, read_program(tmp_path / "m.mod"), skip_unknown=True)
        assert line in done.texts[0]
        assert [outcome is Outcome.REACHED for outcome in done.outcomes] == [True, False]
    with pytest.raises(CasacalError, match=r"beyond the largest correction|singular"):
        compensate_program(arm, str(_plain(tmp_path)), largest=1e-6)


@pytest.mark.parametrize("seed", [5, 8])
def test_a_wrist_that_would_turn_over_is_refused_where_no_configuration_is_stated(seed, tmp_path):
    """Poses of URScript: the true arm takes this one with axis 5 on the other side of zero, 0.3 rad away."""
    joints = np.radians([30, -70, 80, -100, 0.03, 20])
    numbers = w.numbers_of("urscript", flange("urscript", joints))
    first, second = (",".join(f"{v:.12f}" for v in part) for part in (joints, numbers))
    text = f"def m():\n  set_tcp(p[0,0,0,0,0,0])\n  movej([{first}])\n  movel(p[{second}])\nend\n"
    (tmp_path / "m.script").write_text(text)
    with pytest.raises(CasacalError, match=r"line 4, target .* jumps to another configuration"):
        compensate_program(arm_of("urscript", changes_of(seed)), str(tmp_path / "m.script"), largest=0.4)


def _plain(folder):
    (folder / "p.mod").write_text(RAPID.format(line="MoveL p1,v100,fine,t1;"))
    return folder / "p.mod"


def test_one_target_in_two_frames_has_no_one_correction(tmp_path):
    line = "MoveL p1,v100,fine,t1;\n    MoveL p1,v100,fine,tool0;\n    MoveJ p1,v100,fine,t1;"
    (tmp_path / "m.mod").write_text(RAPID.format(line=line))
    program = read_program(tmp_path / "m.mod")
    assert [puzzle.line for puzzle in program.puzzles] == [8]
    assert "another tool or base" in program.puzzles[0].what


def test_a_border_that_a_correction_passes_is_stated_anew(tmp_path):
    """Axis 4 at zero: the sign in Turn, or the quadrant cf4, is that of the corrected axis."""
    for language, ending in (("krl", ".src"), ("rapid", ".mod")):
        joints = np.radians([10, -80, 80, 0, 50, 20] if language == "krl" else [10, 10, 10, 0, 50, 20])
        numbers = w.numbers_of(language, flange(language, joints))
        config = w.configuration(language, joints)
        if language == "krl":
            shown = ",".join(f"{n} {v:.9f}" for n, v in zip("XYZABC", numbers, strict=True))
            text = f"DEF m()\n$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\nPTP {{{shown},S {config[0]},T {config[1]}}}\nEND\n"
        else:
            place, turn = (",".join(f"{v:.12f}" for v in part) for part in (numbers[:3], numbers[3:]))
            target = f"[[{place}],[{turn}],{config},[9E9,9E9,9E9,9E9,9E9,9E9]]".replace(" ", "")
            text = f"MODULE M\nPROC a()\nMoveJ {target},v5,fine,tool0;\nENDPROC\nENDMODULE\n"
        (tmp_path / f"m{ending}").write_text(text)
        seen = set()
        for seed in range(6):
            changes = changes_of(seed)
            done = compensate_program(arm_of(language, changes), str(tmp_path / f"m{ending}"))
            found = [
                float(each)
                for each in re.findall(
                    w.NUMBER,
                    re.sub(
                        "[A-Z]+ ?(?=[-\\d])", " ", done.texts[0].splitlines()[3 if language == "krl" else 2]
                    ).replace("E9", ""),
                )
            ]
            pose = w.pose_of(language, found[: 7 if language == "rapid" else 6])
            reached = w.taken(language, pose, joints)
            stated = w.configuration(language, reached)
            read = [int(v) for v in (found[7:11] if language == "rapid" else found[6:8])]
            assert read == stated, (language, seed)
            seen.add(reached[3] < 0)
        assert seen == {True, False}


def test_predicted_moves_are_where_the_true_arm_goes(tmp_path):
    made, changes = written("rapid", moves=20, seed=4), changes_of(3)
    path = stored(made, tmp_path)
    write_json(tmp_path / "arm.json", {})
    run, prediction = predict_program(arm_of("rapid", changes), str(path))
    assert not run.why
    for i, target in enumerate(run.program.targets):
        _, joints, _, _ = made.goals[target.name]
        np.testing.assert_allclose(prediction.poses[i], flange("rapid", joints, changes), atol=1e-6)
    assert prediction.std is not None


def test_other_languages_endings_and_arms_are_refused(tmp_path, hsr):
    for name, words in (
        ("a.txt", "ending of no robot program"),
        ("b.mod", "cannot be read"),
        ("", "ending of no robot"),
    ):
        with pytest.raises(CasacalError, match=words):
            read_program(tmp_path / name)
    (tmp_path / "u.mod").write_bytes("MODULE".encode("utf-16"))
    with pytest.raises(CasacalError, match="zero bytes"):
        read_program(tmp_path / "u.mod")
    (tmp_path / "e.mod").write_text("MODULE M\nENDMODULE\n")
    assert isinstance(read_program(tmp_path / "e.mod"), TaughtProgram)
    with pytest.raises(CasacalError, match="holds no move to a target"):
        compensate_program(arm_of("rapid"), str(tmp_path / "e.mod"))
    with pytest.raises(CasacalError, match="The tool 't' is not understood: it has 2 numbers"):
        read_program(tmp_path / "e.mod", tools={"t": [1, 2]})
    with pytest.raises(CasacalError, match="Pulses are for Yaskawa"):
        read_program(tmp_path / "e.mod", pulses=[1] * 6)
    with pytest.raises(CasacalError, match="arms with different drawings"):
        compensate_program(arm_of("rapid"), str(_plain(tmp_path)), onto=arm_of("krl"))


def test_a_refused_result_corrects_no_program(tmp_path):
    made = arm_of("rapid", changes_of(1))
    denied = {
        **made.document,
        "verdict": {"level": "do not use", "words": "Do not use it: it is made up.", "reasons": []},
    }
    arm = type(made)(made.file, made.source, denied)
    with pytest.raises(RefusedResultError, match="a program has no place for warnings"):
        compensate_program(arm, str(_plain(tmp_path)))


@pytest.fixture(scope="module")
def fitted(corner_simulation, hsr, tmp_path_factory):
    """A result of a simulated HSR-JR680, and a KRL program for it."""
    folder = tmp_path_factory.mktemp("fitted")
    done = calibrate(hsr, corner_simulation.samples, method="lm", reference=False)
    write_json(folder / "result.json", calibration_document(done))
    joints = np.radians([[10, 20, 10, 40, 70, 60], [-30, 10, 20, -60, -60, 10], [45, -15, 30, 100, 50, -90]])
    poses = predict(done, joints, nominal=True).poses
    rows = []
    for q, pose in zip(joints, poses, strict=True):
        numbers = w.numbers_of("krl", np.linalg.inv(w.pose_of("krl", [500, 0, 100, 5, 0, 0])) @ pose)
        shown = ",".join(f"{n} {v:.4f}" for n, v in zip("XYZABC", numbers, strict=True))
        rows.append(f"LIN {{{shown},T {sum(int(v < 0) << k for k, v in enumerate(q))}}}")
    (folder / "mine.src").write_text(
        "\n".join(["DEF mine()", "$TOOL=$NULLFRAME", "$BASE=BASE_DATA[3]", *rows, "END", ""])
    )
    return folder


def test_the_command_corrects_predicts_and_refuses(fitted, tmp_path, capsys):
    result, program, base = str(fitted / "result.json"), str(fitted / "mine.src"), "BASE_DATA[3]=500,0,100,5,0,0"
    assert main(["compensate", result, program, "--out", str(tmp_path / "a.src")]) == 2
    assert "--base 'BASE_DATA[3]=X,Y,Z,A,B,C" in capsys.readouterr().err
    assert not (tmp_path / "a.src").exists()
    assert main(["compensate", result, program, "--out", str(tmp_path / "a.src"), "--base", base, "--diff"]) == 0
    said = capsys.readouterr().out
    assert "3 moves to 3 targets corrected" in said
    assert said.count("\n+LIN {X ") == 3
    sizes = [float(each) for each in re.findall(r"linear .*?([\d.]+) mm", said)]
    assert sizes == sorted(sizes, reverse=True)
    assert main(["compensate", result, program, "--out", str(tmp_path / "a.src"), "--base", base, "--json"]) == 2
    assert (
        "was not written by casacal" in capsys.readouterr().err
    )  # a program bears no mark, so it is nobody's to replace
    arguments = ["compensate", result, program, "--out", str(tmp_path / "b.src"), "--base", base, "--json"]
    assert main([*arguments, "--inverse"]) == 0
    assert len(json.loads(capsys.readouterr().out)["moves"]) == 3
    assert main(["predict", result, program, "--out", str(tmp_path / "p.csv"), "--base", base]) == 0
    with (tmp_path / "p.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert [row["line"] for row in rows] == ["4", "5", "6"]
    assert sorted((float(row["off_mm"]) for row in rows), reverse=True) == pytest.approx(sizes, abs=6e-4)
    assert all(float(row["std_mm"]) > 0 for row in rows)
    moved = ["compensate", program, "--from", result, "--to", result, "--out", str(tmp_path / "c.src"), "--base", base]
    assert main(moved) == 0
    assert (tmp_path / "c.src").read_text() == (fitted / "mine.src").read_text()  # from an arm onto itself


def test_radians_where_degrees_belong_are_asked_about(fitted, tmp_path, capsys):
    (tmp_path / "r.src").write_text("DEF r()\nPTP {A1 0.5,A2 0.2,A3 0.1,A4 0,A5 0.7,A6 0}\nEND\n")
    assert (
        main(["compensate", str(fitted / "result.json"), str(tmp_path / "r.src"), "--out", str(tmp_path / "o.src")])
        == 0
    )
    assert "are they radians?" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["RESULT"], "There are no TARGETS"),
        (["RESULT", "t.csv", "--inverse"], "--inverse is for a robot program"),
        (["PROGRAM", "--from", "RESULT"], "--from and --to go together"),
        (["RESULT", "PROGRAM", "--frame", "tip", "--inverse"], "The tip is corrected for the arm itself"),
        (["RESULT", "PROGRAM", "--format", "krl"], "are for lists of targets"),
        (["RESULT", "PROGRAM", "--force"], "are for lists of targets"),
        (["RESULT", "PROGRAM", "--near", "1,2"], "--near has 2 joint values"),
        (["RESULT", "PROGRAM", "--tool", "t=1,2"], "The tool 't' is not understood"),
        (["RESULT", "PROGRAM", "--tool", "t=1,x"], "is not NAME=NUMBERS"),
        (["RESULT", "PROGRAM", "--pulses", "1,2,3,4,5,6"], "Pulses are for Yaskawa"),
    ],
)
def test_options_that_do_not_fit_are_refused(arguments, words, fitted, tmp_path, capsys):
    named = {"RESULT": str(fitted / "result.json"), "PROGRAM": str(fitted / "mine.src")}
    assert main(["compensate", *(named.get(each, each) for each in arguments), "--out", str(tmp_path / "o.src")]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert "Traceback" not in said


def test_both_files_of_a_krl_program_are_written(tmp_path, capsys):
    made = written("krl", moves=12, seed=1)
    path = stored(made, tmp_path)
    program = read_program(path, **made.options)
    assert [each.rpartition(".")[2] for each in program.paths] == ["src", "dat"]
    assert compensate_program(arm_of("krl", changes_of(1)), program).texts[1] != made.files[".dat"]


def test_joint_targets_are_the_joints_of_a_calibration(hsr, corner_simulation, tmp_path, capsys):
    """The samples' joints as jointtargets of a program with approach points, the readings by the targets' names."""
    samples = corner_simulation.samples
    rows, moves, readings = [], [], ["pose,reading_mm,plane"]
    for i, joints in enumerate(samples.joints):
        rows.append(
            f"CONST jointtarget t{i}:=[[{','.join(f'{v:.9f}' for v in np.degrees(joints))}],[9E9,9E9,9E9,9E9,9E9,9E9]];"
        )
        moves += ["MoveAbsJ above,v100,z5,tool0;", f"MoveAbsJ t{i},v10,fine,tool0;"]
    order = np.random.default_rng(0).permutation(len(samples))
    readings += [f"t{i},{samples.columns['reading'][i]:.9f},{samples.labels['plane'][i]}" for i in order]
    above = "CONST jointtarget above:=[[0,0,0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];"
    text = "\n".join(["MODULE M", above, *rows, "PROC main()", *moves, "ENDPROC", "ENDMODULE", ""])
    (tmp_path / "touch.mod").write_text(text)
    (tmp_path / "r.csv").write_text("\n".join(readings) + "\n")
    problem, program = str(ROOT / "problems" / "hsr_jr680"), str(tmp_path / "touch.mod")
    assert main(["calibrate", problem, program]) == 2
    assert "Name a CSV by --readings, with a column 'pose'" in capsys.readouterr().err
    options = ["--no-reference", "--method", "lm", "--out", str(tmp_path / "fit")]
    assert main(["calibrate", problem, program, "--readings", str(tmp_path / "r.csv"), *options]) == 0
    capsys.readouterr()
    ours = json.loads((tmp_path / "fit" / "result.json").read_text())
    theirs = calibrate(hsr.problem, samples, method="lm", reference=False).to_dict()
    found, wanted = ({row["name"]: row["estimate"] for row in each["parameters"]} for each in (ours, theirs))
    assert found == pytest.approx(wanted, abs=1e-4)
    (tmp_path / "r.csv").write_text("\n".join([*readings, "t999,0.1,floor"]) + "\n")
    assert main(["calibrate", problem, program, "--readings", str(tmp_path / "r.csv"), *options]) == 2
    assert "'t999' has no pose in" in capsys.readouterr().err


def test_the_doctor_takes_the_joint_targets_of_a_program(tmp_path, capsys):
    """The pendant's pose at each target, by hand-multiplied DH matrices; one sign is turned round in the program."""
    table = np.array(
        [[90, 150, 400, 0], [0, 600, 0, 90], [90, 120, 0, 0], [-90, 0, 640, 0], [90, 0, 0, 0], [0, 0, 100, 0]]
    )
    rows = [f"{i},{al},{a},{d},{th},-170,170" for i, (al, a, d, th) in enumerate(table.tolist(), 1)]
    head = "# name: A\n# convention: standard\njoint,alpha_deg,a_mm,d_mm,theta_deg,lower_deg,upper_deg\n"
    (tmp_path / "a.csv").write_text(head + "\n".join(rows) + "\n")
    arm = ["--dh", str(tmp_path / "a.csv"), "--tool", "0,0,120", "--sign", "-1", "--travel", "10", "--accuracy", "1"]
    assert main(["new", "a", *arm, "--out", str(tmp_path)]) == 0
    shown = np.random.default_rng(4).uniform(-60, 60, (5, 6)).round(3)
    declared, readings = [], ["pose,x_mm,y_mm,z_mm,qw,qx,qy,qz"]
    alpha, a, d, theta = table[:, 0], table[:, 1], table[:, 2], table[:, 3]
    for i, q in enumerate(shown):
        meant = q * [1, 1, -1, 1, 1, 1]
        pose = dh_chain(np.radians(alpha), a, d, np.radians(theta + meant))
        turn = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
        readings.append(f"t{i}," + ",".join(f"{v:.5f}" for v in [*pose[:3, 3], *turn]))
        declared.append(f"CONST jointtarget t{i}:=[[{','.join(map(str, q))}],[9E9,9E9,9E9,9E9,9E9,9E9]];")
    moves = [f"MoveAbsJ t{i},v100,fine,tool0;" for i in range(5)]
    (tmp_path / "p.mod").write_text(
        "\n".join(["MODULE M", *declared, "PROC main()", *moves, "ENDPROC", "ENDMODULE", ""])
    )
    (tmp_path / "r.csv").write_text("\n".join([*readings[:1], *reversed(readings[1:])]) + "\n")
    capsys.readouterr()
    command = ["doctor", str(tmp_path / "a"), str(tmp_path / "p.mod")]
    assert main(command) == 2
    assert "holds joint targets and no poses" in capsys.readouterr().err
    assert main([*command, "--readings", str(tmp_path / "r.csv")]) == 0
    assert "signs = [1, 1, -1, 1, 1, 1]" in capsys.readouterr().out
