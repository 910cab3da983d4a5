"""What leaves the command line: JSON alone where asked for, any encoding, colour for people, readers that leave."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

import casacal
from casacal.cli.main import COMMANDS, build_parser, main
from casacal.cli.terminal import width
from casacal.files import jsonable

HSR = (ROOT / "problems" / "hsr_jr680").as_posix()
SAMPLES = f"{HSR}/samples.csv"
CASACAL = (sys.executable, "-m", "casacal")
ESCAPE = "\x1b["
UNIX = pytest.mark.skipif(os.name != "posix", reason="needs a POSIX shell")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a calibrated arm, joint targets and a pendant's rows."""
    folder = tmp_path_factory.mktemp("terminal")
    assert main(["calibrate", HSR, "--out", str(folder / "fit")]) == 0
    joints = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n"
    (folder / "q.csv").write_text(joints + "10,20,30,-40,50,60\n5,10,40,-90,-60,-90\n")
    (folder / "pendant.csv").write_text("q1,q2,q3,q4,q5,q6,x,y,z,a,b,c\n1,2,3,4,5,6,1,2,3,4,5,6\n")
    return folder


@pytest.fixture
def letters(tmp_path):
    """Samples whose labels have letters that few codes have."""
    text = Path(SAMPLES).read_text(encoding="utf-8")
    (tmp_path / "letters.csv").write_text(text.replace(",wall\n", ",Wänd 壁\n", 1).replace("floor", "Böden"), "utf-8")
    return tmp_path / "letters.csv"


def run(*arguments, cwd=None, **environment):
    """The command line in a process of its own, its output as bytes."""
    return subprocess.run(
        [*CASACAL, *map(str, arguments)], cwd=cwd, capture_output=True, check=False, env={**os.environ, **environment}
    )


def call(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.long
def test_json_is_all_there_is(capsys, place, tmp_path):
    result = place / "fit" / "result.json"
    commands = {
        "calibrate": (HSR,),
        "check": (HSR,),
        "simulate": (HSR, "--out", tmp_path / "s.csv", "--samples", 30),
        "predict": (result, place / "q.csv", "--out", tmp_path / "p.csv"),
        "compensate": (result, place / "q.csv", "--out", tmp_path / "c.csv"),
        "export": (result, "--to", "zeros", "--out", tmp_path / "z.csv"),
    }
    found = {}
    for name, arguments in commands.items():
        code, out, err = call(capsys, name, *arguments, "--json")
        assert (code, err) == (0, ""), name
        found[name] = json.loads(out)
        assert out.isascii()
    kept = json.loads(result.read_text(encoding="utf-8"))
    assert kept.pop("written_by").startswith("casacal ")
    for document in (found["calibrate"], kept):
        document.pop("seconds")
        document.pop("seal")  # of the paths, too
        document["data"].pop("file")  # in a file, paths are relative to it
        for part in (document["problem"], *document["problem"]["files"]):
            assert part.pop("path").endswith("hsr_jr680/problem.py")
    assert found["calibrate"] == kept
    assert found["check"]["counts"] == {"error": 0, "warning": 0, "remark": 2}
    assert found["check"]["findings"][0]["about"] == "no length was measured"
    assert found["simulate"]["written"] == [(tmp_path / name).as_posix() for name in ("s.csv", "s.truth.json")]
    assert found["simulate"]["tip"]["after_rms_mm"] < found["simulate"]["tip"]["before_rms_mm"]
    assert found["predict"]["poses"] == found["compensate"]["targets"] == 2
    assert found["export"]["remarks"]


@pytest.mark.long
def test_json_tells_of_what_went_wrong_by_the_same_codes(capsys, place, tmp_path):
    code, out, err = call(capsys, "calibrate", HSR, "nowhere.csv", "--json")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    code, out, _ = call(capsys, "calibrate", HSR, "--method", "plane-only", "--json")
    assert code == 1
    assert json.loads(out)["verdict"]["level"] == "do not use"
    code, out, err = call(capsys, "doctor", HSR, place / "pendant.csv", "--json")
    document = json.loads(out)
    assert (code, document["certain"], document["meanings"]) == (1, False, [])
    far = tmp_path / "far.csv"
    far.write_text("x_mm,y_mm,z_mm,qw,qx,qy,qz\n9000,0,0,1,0,0,0\n")
    code, out, _ = call(capsys, "compensate", place / "fit" / "result.json", far, "--out", tmp_path / "c.csv", "--json")
    assert code == 1
    (missed,) = json.loads(out)["missed"]
    assert missed["line"] == 2
    assert missed["meaning"]
    assert missed["outcome"] != "reached"


def test_what_a_problem_file_prints_does_not_get_into_json(capsys, tmp_path):
    shutil.copytree(HSR, tmp_path / "arm")
    text = (tmp_path / "arm/problem.py").read_text()
    (tmp_path / "arm/problem.py").write_text(f"{text}\nprint('here I am')\n")
    code, out, err = call(capsys, "check", tmp_path / "arm", "--json")
    assert (code, json.loads(out)["counts"]["error"]) == (0, 0)
    assert "here I am" in err


def test_json_of_a_box(capsys):
    code, out, _ = call(capsys, "calibrate", HSR, "--no-reference", "--json", "--box", "1000:1700,-400:400,400:1000")
    box = json.loads(out)["box"]
    assert (code, box["range_mm"][2]) == (0, [400, 1000])
    assert 0 < box["expected_rms_mm"] <= box["worst_mm"]


def test_json_is_of_the_arm_as_options_want_it(capsys, tmp_path):
    """As result.json is: a number that was held is held in both."""
    asked = ["calibrate", HSR, "--no-reference", "--method", "lm", "--fix", "a3", "--out", tmp_path / "fit", "--json"]
    code, out, _ = call(capsys, *asked)
    kept = json.loads((tmp_path / "fit" / "result.json").read_text())
    said = json.loads(out)
    assert code == 0
    assert said["arm"] == kept["arm"]
    assert [row["std"] for row in said["parameters"] if row["name"] == "a3"] == [0.0]


def test_a_long_list_of_lines_is_counted_right_and_whole_in_json(capsys, tmp_path):
    lines = Path(SAMPLES).read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line[0] in "-0123456789")
    twice = tmp_path / "twice.csv"
    twice.write_text("\n".join([*lines, *lines[first : first + 30]]) + "\n")
    code, out, _ = call(capsys, "check", HSR, twice)
    told = re.search(r"repeated rows \(lines ([\d, ]+) and (\d+) more\)", out)
    assert code == 0
    assert len(told[1].split(",")) + int(told[2]) == 30
    _, out, _ = call(capsys, "check", HSR, twice, "--json")
    (finding,) = (f for f in json.loads(out)["findings"] if f["about"] == "repeated rows")
    assert finding["lines"] == list(range(len(lines) + 1, len(lines) + 31))


def test_version_and_no_command(capsys):
    assert call(capsys, "--version") == (0, f"casacal {casacal.__version__}\n", "")
    code, out, err = call(capsys)
    assert (code, err) == (0, "")
    assert out.startswith("usage: casacal")
    listed = re.findall(r"^  ([a-z0-9]+)  +[a-z]", out, re.M)
    assert listed == list(COMMANDS)
    assert out.index("measure:") < out.index("  plan ") < out.index("calibrate:") < out.index("  verify ")


ENCODINGS = ("cp932", "ascii", "latin-1", "utf-8", "cp1252:strict", "ascii:surrogateescape")


@pytest.mark.long_unless("ascii:surrogateescape")
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_letters_that_an_encoding_lacks_are_replaced(encoding, letters):
    done = run("check", HSR, letters, PYTHONIOENCODING=encoding)
    assert done.returncode == 1
    assert b"Traceback" not in done.stderr
    assert b"cannot be bound" in done.stdout
    shown = done.stdout.decode(encoding.partition(":")[0])
    assert ("Wänd" if encoding in ("latin-1", "utf-8", "cp1252:strict") else "W?nd") in shown
    assert ("壁" in shown) == (encoding in ("utf-8", "cp932"))


@pytest.mark.long
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_refusal_is_one_line_in_any_encoding(encoding, letters):
    done = run("calibrate", HSR, letters, PYTHONIOENCODING=encoding)
    assert done.returncode == 2
    assert done.stderr.count(b"\n") == 1
    assert b"Traceback" not in done.stderr


def shell(command, cwd):
    return subprocess.run(["sh", "-c", command], cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.long
@UNIX
def test_a_reader_that_leaves_costs_nothing(tmp_path):
    python = f"{sys.executable} -m casacal"
    for command in (f"calibrate {HSR} --verbose --out out", f"calibrate {HSR} --json --out out2", f"check {HSR}"):
        done = shell(f"({python} {command}; echo code $? >&2) | true", tmp_path)
        assert done.stderr == "code 0\n", command
    for folder in ("out", "out2"):
        assert (tmp_path / folder / "report.html").is_file()
    done = shell(f"{python} calibrate {HSR} | head -1", tmp_path)
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""


@pytest.mark.long
@UNIX
def test_output_that_is_closed_or_full(tmp_path):
    python = f"{sys.executable} -m casacal"
    done = shell(f"{python} calibrate {HSR} --out out >&-; echo code $?", tmp_path)
    assert (done.stdout, done.stderr) == ("code 0\n", "")
    assert json.loads((tmp_path / "out" / "result.json").read_text())["converged"]
    done = shell(f"{python} calibrate nowhere 2>&-; echo code $?", tmp_path)
    assert (done.stdout, done.stderr) == ("code 2\n", "")
    if os.path.exists("/dev/full"):
        done = shell(f"{python} check {HSR} >/dev/full; echo code $?", tmp_path)
        assert done.stdout == "code 2\n"
        assert re.fullmatch(r"casacal: Standard output cannot be written \(.*\)\. Send it elsewhere\.\n", done.stderr)


def on_a_terminal(arguments, **environment):
    """Output of the command line where it believes that someone looks."""
    import pty

    seen, within = pty.openpty()
    kept = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "COLUMNS")}
    process = subprocess.Popen(
        [*CASACAL, *arguments], stdout=within, stderr=within, env={**kept, "TERM": "xterm", **environment}
    )
    os.close(within)
    parts = []
    while True:
        try:
            part = os.read(seen, 65536)
        except OSError:  # Linux says so when the other end is closed
            break
        if not part:
            break
        parts.append(part)
    os.close(seen)
    return process.wait(), b"".join(parts).decode()


@pytest.mark.long
@UNIX
def test_colour_is_for_terminals_that_want_it(capsys):
    code, out = on_a_terminal(["calibrate", HSR])
    assert code == 0
    assert f"{ESCAPE}1;32mCalibrated{ESCAPE}0m: expect" in out
    assert f"{ESCAPE}1;31mcasacal:{ESCAPE}0m nowhere" in on_a_terminal(["calibrate", HSR, "nowhere"])[1]
    assert f"{ESCAPE}1;31mDo not use{ESCAPE}0m" in on_a_terminal(["calibrate", HSR, "--method", "plane-only"])[1]
    assert ESCAPE not in on_a_terminal(["calibrate", HSR], NO_COLOR="1")[1]
    assert ESCAPE not in on_a_terminal(["calibrate", HSR], TERM="dumb")[1]
    assert ESCAPE not in call(capsys, "calibrate", HSR)[1]


@UNIX
def test_findings_are_broken_into_lines_where_someone_looks(capsys):
    _, out = on_a_terminal(["check", HSR], COLUMNS="60")
    lines = out.replace("\r", "").splitlines()
    assert len(lines) > 3
    assert max(len(re.sub(r"\x1b\[[\d;]*m", "", line)) for line in lines) <= 60
    assert len(call(capsys, "check", HSR)[1].splitlines()) == 3


def test_width_stays_within_reason(monkeypatch):
    for columns, expected in (("20", 40), ("80", 80), ("500", 120), ("", 100)):
        monkeypatch.setenv("COLUMNS", columns)
        monkeypatch.setattr("os.get_terminal_size", lambda *_: (_ for _ in ()).throw(OSError))
        assert width() == expected


def test_an_interruption_says_what_it_left_behind(capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["casacal.fit.filters"], "sckf_lm", stop)
    assert call(capsys, "calibrate", HSR) == (130, "", "casacal: Interrupted. No file was left half-written.\n")


TWO = """
from casacal import DialOnPlane, Problem, Robot, TrackedPoint

robot = Robot.from_dh("two", alpha=(-1.57, 0, 1.57, -1.57, 1.57, 0), a=(250, 900, -200, 0, 0, 0),
                      d=(650, 0, 0, 1000, 0, 200), theta=(0, -1.57, 3.14, 0, 1.57, 0), length_std=0.7, angle_std=1e-3)
problem = Problem(robot, DialOnPlane(noise_std=0.01), TrackedPoint(noise_std=0.05))
"""


@pytest.mark.parametrize("command", ["calibrate", "check"])
def test_one_file_for_two_instruments_is_refused_in_a_sentence(command, tmp_path, capsys):
    (tmp_path / "problem.py").write_text(TWO)
    code, out, err = call(capsys, command, tmp_path, SAMPLES)
    assert (code, out) == (2, "")
    assert "Name one for each: --samples instrument1=FILE --samples instrument2=FILE" in err
    assert err.count("\n") == 1


@pytest.fixture(scope="module")
def older(hsr):
    """A result as those were that held no arm of their own, and no seal."""
    document = jsonable(casacal.calibrate(hsr, method="lm", reference=False).to_dict())
    return {key: item for key, item in document.items() if key not in ("schema", "arm", "seal")}


@pytest.mark.parametrize("command", ["predict", "compensate", "export"])
def test_a_result_whose_problem_has_two_instruments_by_now_is_refused(command, tmp_path, older, capsys):
    (tmp_path / "problem.py").write_text(TWO)
    document = {**older, "problem": {**older["problem"], "path": str(tmp_path / "problem.py")}}
    (tmp_path / "result.json").write_text(json.dumps(document))
    arguments = ["--to", "zeros"] if command == "export" else [SAMPLES]
    code, out, err = call(capsys, command, tmp_path / "result.json", *arguments, "--out", tmp_path / "x.csv")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert "has changed since the calibration" in err


def test_no_help_speaks_in_riddles():
    parsers = {"": build_parser(), **build_parser()._subparsers._group_actions[0].choices}
    for name, parser in parsers.items():
        said = " ".join(parser.format_help().split())
        for riddle in ("up to the base", "only last one", "written half", "a setting", "a second", "FILE.truth"):
            assert riddle not in said, name
    assert "x.truth.json" in parsers["simulate"].format_help()
    for name in ("", "predict"):
        said = " ".join(parsers[name].format_help().split())
        assert "the tip is where the instrument touches" in said
    for action in (action for parser in parsers.values() for action in parser._actions):
        assert action.help or action.metavar == "COMMAND", action.option_strings


@UNIX
def test_what_solvers_print_by_python_by_c_or_past_both_goes_to_the_errors():
    program = (
        "import ctypes, os, sys\n"
        "from casacal.cli.terminal import on_stderr\n"
        "with on_stderr():\n"
        "    print('python'); ctypes.CDLL(None).puts(b'c'); os.write(1, b'past')\n"
        "print('after')\n"
    )
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=buffered)
    assert done.stdout == "after\n"
    assert all(word in done.stderr for word in ("python", "c\n", "past"))
