"""Frames that depend on the way that a program takes, targets that hang together, and what is not corrected halfway."""

import numpy as np
import pytest
from written_programs import arm_of, changes_of

from casacal.errors import CasacalError
from casacal.programs import compensate_program, read_program

J, A = "[0.5236, -1.2217, 1.3963, -1.7453, -1.5708, 0.0]", "p[-.48782, -.34768, .21811, 1.5708, 2.7207, 0.0]"
SMALL, LARGE = "set_tcp(p[0,0,0.12,0,0,0])", "set_tcp(p[0,0,0.2,0,0,0])"
MOVE = f"movel({A})"


def script(*lines):
    return "\n".join(["def c():", *(f"  {line}" for line in lines), "end", ""])


def read(tmp_path, text, name="p.script", **options):
    (tmp_path / name).write_text(text)
    return read_program(tmp_path / name, **options)


def refused_or_taken(program, words):
    """Refused with these words; None where all of it is understood."""
    if words is None:
        assert program.puzzles == ()
        return
    with pytest.raises(CasacalError, match=words):
        program.refuse_puzzles()


@pytest.mark.parametrize(
    "text",
    [
        f"def gripper():\n  {LARGE}\nend\n" + script(SMALL, f"movej({J})", "gripper()", MOVE),
        f"def inner():\n  {LARGE}\nend\ndef outer():\n  inner()\nend\n" + script(SMALL, "outer()", MOVE),
        f"def go():\n  {MOVE}\nend\n" + script(SMALL, "go()", LARGE, "go()"),
        script(SMALL, f"def go():\n  {MOVE}\nend", "go()", LARGE, "go()"),
        script(SMALL, "i=0", "while i<3:", MOVE, LARGE, "i=i+1", "end"),
        script(SMALL, "if get_standard_digital_in(0):", LARGE, "end", MOVE),
        script("if get_standard_digital_in(0):", LARGE, "else:", SMALL, "end", MOVE),
        script("if get_standard_digital_in(0):", LARGE, "else:", MOVE, "end", SMALL),
        f"def c():\n  thread t():\n    {LARGE}\n  end\n  run t()\n  {SMALL}\n  {MOVE}\nend\n",
        f"def c():\n  {SMALL}\n  thread t():\n    {LARGE}\n  end\n  run t()\n  {MOVE}\nend\n",
    ],
)
def test_a_tool_that_depends_on_the_way_is_refused(text, tmp_path):
    program = read(tmp_path, text, tools={"tcp": (0, 0, 0.12, 0, 0, 0)} if "else" in text else {})
    with pytest.raises(CasacalError, match="tool"):
        program.refuse_puzzles()


@pytest.mark.parametrize(
    "text",
    [
        script(SMALL, "while True:", MOVE, "end"),
        script(SMALL, MOVE.replace(".21811", ".22"), LARGE, MOVE),
        script("while True:", SMALL, MOVE, LARGE, MOVE.replace(".21811", ".22"), "end"),
        script("if get_standard_digital_in(0):", SMALL, MOVE, "else:", LARGE, MOVE.replace(".21811", ".22"), "end"),
        f"def a():\n  {SMALL}\n  {MOVE}\nend\ndef b():\n  {LARGE}\n  {MOVE.replace('.21811', '.22')}\nend\na()\nb()\n",
        f"def gripper():\n  {SMALL}\nend\n" + script(SMALL, "gripper()", MOVE),
    ],
)
def test_one_that_is_set_before_the_move_on_every_way_is_taken(text, tmp_path):
    program = read(tmp_path, text)
    assert program.puzzles == ()
    assert len(program.targets) >= 1


KRL = "DEF M( )\n$TOOL={X 0,Y 0,Z 120,A 0,B 0,C 0}\n$BASE={X 900,Y 0,Z 0,A 0,B 0,C 0}\n%s\nEND\n%s"
POINT = "LIN {X 10,Y 0,Z 300,A 0,B 90,C 0,S 2,T 10}"


@pytest.mark.parametrize(
    ("inside", "after", "words"),
    [
        (f"{POINT}\nsub1( )\n{POINT}", "DEF sub1( )\n$BASE=$NULLFRAME\nEND\n", "which base holds here"),
        (f"IF $IN[1] THEN\n$BASE=$NULLFRAME\nENDIF\n{POINT}", "", "which base holds here"),
        (f"LOOP\n{POINT}\n$TOOL=$NULLFRAME\nENDLOOP", "", "which tool holds here"),
        (f"WAIT FOR $IN[1]\nLOOP\n{POINT}\nENDLOOP", "", None),
        (f"LOOP\n$BASE=$NULLFRAME\n{POINT}\nENDLOOP", "", None),
        (f"$IPO_MODE=#TCP\n{POINT}", "", "not understood"),
        (f"$ACT_TOOL=2\n{POINT}", "", "not understood"),
    ],
)
def test_frames_of_krl_that_depend_on_the_way_are_refused(inside, after, words, tmp_path):
    program = read(tmp_path, KRL % (inside, after), "m.src")
    refused_or_taken(program, words)


RAPID = """MODULE M
PERS tooldata tGun:=[TRUE,[[0,0,120],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];
CONST robtarget p10:=[[900,0,700],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
PROC main()
%s
MoveL p10,v100,fine,tGun;
ENDPROC
ENDMODULE
"""


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("SetT tGun;", "'tGun' is told to something in line 5"),
        ("MToolTCPCalib j1,j2,j3,j4,tGun,e1,e2;", "'tGun' is told to something in line 5"),
        ('SetDataVal "p10",pNew;', "SetDataVal .* not understood"),
        ("MoveL p10,v100,fine,tGun\\Corr;", "a sensor corrects the path"),
        ("pV:=CRobT(\\Tool:=tGun);", None),
        ('TPWrite "tGun";', None),
    ],
)
def test_what_may_change_a_tool_or_target_of_rapid_is_refused(line, words, tmp_path):
    program = read(tmp_path, RAPID % line, "m.mod")
    refused_or_taken(program, words)


FANUC = """/PROG T
/MN
%s
/POS
P[1]{
   GP1:
 UF : 0, UT : 0,  CONFIG : 'N U T, 0, 0, 0',
 X = 900.000 mm, Y = 0.000 mm, Z = 700.000 mm,
 W = 180.000 deg, P = 0.000 deg, R = 0.000 deg
%s};
/END
"""


@pytest.mark.parametrize(
    ("lines", "group", "words"),
    [
        ("  1: Touch Offset PR[2] ;\n  2: L P[1] 100mm/sec FINE ;", "", "Touch Offset .* not understood"),
        ("  1: UTOOL[1]=PR[1] ;\n  2: L P[1] 100mm/sec FINE ;", "", "not understood"),
        ("  1: UTOOL_NUM=2 ;\n  2: L P[1] 100mm/sec FINE ;", "", r"P\[1\] stands in UT0, and UTOOL_NUM is 2 here"),
        ("  1: L P[1] 100mm/sec FINE ;", "   GP2:\n J1 = 90.000 deg\n", "another group moves with it"),
        ("  1: L P[1] 100mm/sec FINE COORD ;", "", "together with another group"),
        ("  1: L PAL_1[BTM] 100mm/sec FINE ;", "", "PAL_1|too few"),
        ("  1: UTOOL_NUM=0 ;\n  2: L P[1] 100mm/sec FINE ;", "   GP2:\n J1 = 0.000 deg\n", None),
    ],
)
def test_frames_and_groups_of_fanuc_that_disagree_are_refused(lines, group, words, tmp_path):
    program = read(tmp_path, FANUC % (lines, group), "t.ls")
    refused_or_taken(program, words)


def test_a_target_that_is_the_base_of_another_is_not_corrected_twice(tmp_path):
    text = script(SMALL, f"movej({J})", f"w={A}", "movel(pose_trans(w,p[0,0,-0.05,0,0,0]))", "movel(w)")
    with pytest.raises(CasacalError, match=r"it would miss what was meant by .* mm"):
        compensate_program(arm_of("urscript", changes_of(1)), read(tmp_path, text))


def test_what_a_skipped_line_names_stays_as_it_is(tmp_path):
    text = script(SMALL, f"movej({J})", f"w={A}", "movel(w)", LARGE, "movel(w)", MOVE.replace(".21811", ".25"))
    done = compensate_program(arm_of("urscript", changes_of(1)), read(tmp_path, text), skip_unknown=True)
    old, new = text.splitlines(), done.texts[0].splitlines()
    assert [k for k, (one, other) in enumerate(zip(old, new, strict=True)) if one != other] == [2, 7]
    assert any("line 7 has it" in why for why in done.why.values())
    assert np.isfinite(done.left_mm[[i for i, _ in enumerate(done.outcomes) if i not in done.why]]).all()
