"""Programs in corners: the move before, postures that differ by move, external axes, tools elsewhere, other names."""

import http.server
import threading

import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial.transform import Rotation
from written_programs import arm_of, changes_of, flange

from casacal.cli.main import main
from casacal.deployment.compensate import Outcome
from casacal.errors import CasacalError
from casacal.programs import compensate_program, read_program
from casacal.programs.correct import run_program
from casacal.shopfloor.controllers import controller

HOME, OTHER = [0.5, -1.2, 1.4, -1.7, -1.57, 0.0], [0.5, -0.3, -1.4, 1.6, 1.57, 3.0]
ONE, TWO = [0.55, -1.25, 1.45, -1.7, -1.5, 0.1], [0.4, -1.1, 1.3, -1.6, -1.6, 0.1]
NONE = ",".join(["9E9"] * 6)


@pytest.fixture(scope="module")
def arm():
    return arm_of("urscript", changes_of(3))


def posed(joints):
    """The pose of joint values as URScript has it."""
    pose = flange("urscript", np.array(joints))
    numbers = [*(pose[:3, 3] / 1000), *Rotation.from_matrix(pose[:3, :3]).as_rotvec()]
    return f"p[{', '.join(f'{value:.7f}' for value in numbers)}]"


def script(folder, *lines, tool="p[0,0,0,0,0,0]"):
    path = folder / "cell.script"
    path.write_text("\n".join(["def cell():", f"  set_tcp({tool})", *(f"  {line}" for line in lines), "end", ""]))
    return path


def test_a_pose_lies_beside_the_move_before_it_also_where_that_target_was_used_before(arm, tmp_path):
    path = script(
        tmp_path, f"home = {HOME}", f"other = {OTHER}", "movej(home)", f"movel({posed(ONE)})", "movej(other)",
        "movej(home)", f"movel({posed(TWO)})"
    )  # fmt: skip
    run = run_program(arm, read_program(path))
    assert not run.why
    assert run.joints[-1] == pytest.approx(np.array(TWO), abs=1e-5)


def test_a_pose_that_two_moves_take_in_two_postures_is_left_and_said(arm, tmp_path):
    lines = [f"home = {HOME}", f"other = {OTHER}", f"p1 = {posed(ONE)}", "movej(home)", "movel(p1)"]
    twice = run_program(arm, read_program(script(tmp_path, *lines, "movej(other)", "movel(p1)")))
    assert ["two postures" in words for words in twice.why.values()] == [True]
    same = run_program(arm, read_program(script(tmp_path, *lines, "movej(home)", "movel(p1)")))
    assert not same.why
    near = [f"movej(get_inverse_kin({posed(ONE)}, qnear={each}))" for each in (HOME, OTHER)]
    read = read_program(script(tmp_path, f"p1 = {posed(ONE)}", *(each.replace(posed(ONE), "p1") for each in near)))
    assert any("other joint values than before" in puzzle.what for puzzle in read.puzzles)


@pytest.mark.parametrize("word", ["ConfL", "ConfJ"])
def test_where_configurations_are_left_to_the_controller_it_is_said(word, tmp_path):
    program = tmp_path / "p.mod"
    program.write_text(
        f"MODULE m\nPROC main()\n{word}\\Off;\n{word}\\On;\nMoveAbsJ [[1,2,3,4,5,6],[{NONE}]],v100,fine,tool0;\n"
        "ENDPROC\nENDMODULE\n"
    )
    (puzzle,) = read_program(program).puzzles
    assert (puzzle.line, f"after {word}\\Off" in puzzle.what) == (3, True)


def test_a_joint_move_whose_tool_ends_elsewhere_is_not_corrected_for_the_tip(arm, tmp_path):
    path = script(tmp_path, f"movej({ONE})", tool="p[0,0,0.35,0,0,0]")
    with pytest.raises(CasacalError, match=r"its tool ends 350\.0 mm from the tip"):
        compensate_program(arm, read_program(path), frame="tip")
    assert compensate_program(arm, read_program(path), frame="flange").reached.all()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("e.src", "DEF e()\nPTP {A1 28,A2 -70,A3 80,A4 -97,A5 -90,A6 0,E1 500.0}\nEND\n"),
        (
            "e.mod",
            f"MODULE m\nPROC main()\nMoveAbsJ [[1,2,3,4,5,6],[500,{NONE[4:]}]],v100,fine,tool0;\nENDPROC\nENDMODULE\n",
        ),
        (
            "e.ls",
            "/PROG E\n/MN\n1: J P[1] 100% FINE ;\n/POS\nP[1]{\n GP1:\n UF : 0, UT : 1,\n J1= 1 deg, J2= 2 deg,\n"
            " J3= 3 deg, J4= 4 deg, J5= 5 deg, J6= 6 deg,\n E1= 500 mm\n};\n/END\n",
        ),
    ],
)  # fmt: skip
def test_joint_targets_that_move_an_external_axis_are_not_understood(name, text, tmp_path):
    (tmp_path / name).write_text(text)
    still = text.replace("E1 500.0", "E1 0.0").replace("[500,", "[0,").replace("E1= 500", "E1= 0")
    assert "an external axis moves" in read_program(tmp_path / name).puzzles[0].what
    (tmp_path / name).write_text(still)
    read = read_program(tmp_path / name)
    assert (len(read.targets), read.puzzles) == (1, ())


def test_names_that_the_program_does_not_have_are_refused(tmp_path):
    path = script(tmp_path, f"movej({ONE})")
    for kind, name in (("base", "wrold"), ("tool", "flnage")):
        with pytest.raises(CasacalError, match=f"The program names no {kind} '{name}'"):
            read_program(path, **{f"{kind}s": {name: (0, 0, 0.5, 0, 0, 0)}})
    assert read_program(path, bases={"world": (0, 0, 0.5, 0, 0, 0)}, tools={"flange": (0,) * 6}).targets


def test_reasons_of_points_that_are_not_brought_back(arm, tmp_path):
    path = script(tmp_path, f"movej({ONE})")
    with pytest.raises(CasacalError, match=Outcome.BEYOND.value):
        compensate_program(arm, read_program(path), inverse=True, largest=1e-5)
    assert compensate_program(arm, read_program(path), inverse=True).reached.all()


def test_a_target_that_is_not_known_is_the_reason_why_a_reading_has_no_pose(tmp_path, capsys):
    job = tmp_path / "j.jbi"
    job.write_text(
        "/JOB\n//NAME J\n//POS\n///NPOS 1,0,0,0,0,0\n///TOOL 0\n///POSTYPE PULSE\n///PULSE\nC00000=1,2,3,4,5,6\n"
        "//INST\n///DATE 2026/01/01 00:00\n///ATTR SC,RW\n///GROUP1 RB1\nNOP\nMOVJ C00000 VJ=10.00\nEND\n"
    )
    readings = tmp_path / "r.csv"
    readings.write_text("pose,reading_mm,plane\nC00000,1.0,floor\n")
    assert main(["check", str(ROOT / "problems" / "ur5"), str(job), "--readings", str(readings)]) == 2
    said = capsys.readouterr().err
    assert "pulses" in said
    assert "has no pose" not in said


def test_what_answers_and_is_no_controller_is_a_sentence():
    class Odd(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.wfile.write(b"what is this\r\n\r\n")

        def log_message(self, *_):
            return

    from casacal import load_problem

    robot = load_problem(ROOT / "problems" / "ur5").problem.robot
    with http.server.HTTPServer(("127.0.0.1", 0), Odd) as odd:
        threading.Thread(target=odd.serve_forever, daemon=True).start()
        with pytest.raises(CasacalError, match="gives no joint values"):
            controller(f"rws:127.0.0.1:{odd.server_address[1]}", robot).joints()
        with pytest.raises(CasacalError, match="gives no joint values"):
            controller(f"rws:127.0.0.1:{odd.server_address[1]}/ROB 1", robot).joints()
        odd.shutdown()


def test_limits_of_some_joints_alone_leave_the_others_to_be_filled_in(tmp_path, capsys):
    table = tmp_path / "arm.csv"
    rows = [
        "# convention: standard",
        "joint,alpha_deg,a_mm,d_mm,theta_deg,lower_deg,upper_deg",
        "1,90,0,89.159,0,-170,170",
    ]
    rest = [(0, -425, 0), (0, -392.25, 0), (90, 0, 109.15), (-90, 0, 94.65), (0, 0, 82.3)]
    rows += [f"{k},{alpha},{a},{d},0,," for k, (alpha, a, d) in enumerate(rest, 2)]
    table.write_text("\n".join(rows) + "\n")
    assert main(["new", "mine", "--dh", str(table), "--out", str(tmp_path)]) == 0
    assert "joint limits" in " ".join(capsys.readouterr().out.split())
