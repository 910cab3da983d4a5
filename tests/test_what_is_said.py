"""Sentences that once left somebody alone: each says which, how much, and what to do at that place."""

import io
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT

from casacal import CasacalError, DialOnPlane, Problem, calibrate, dial_zero, load_problem, plan
from casacal.calibration.brief import next_step
from casacal.calibration.saved import SavedCalibration
from casacal.calibration.summary import direction_table
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.data.samples import write_samples
from casacal.deployment.arm import CalibratedArm
from casacal.errors import ProblemError
from casacal.planning import handouts as ways_of
from casacal.planning.handouts import program_text
from casacal.planning.plan import plan_sentences, plan_text
from casacal.planning.set_ups import SetUp
from casacal.shopfloor import Session
from casacal.shopfloor.known import Alarm, SessionState, Suspected
from casacal.wording import figures, with_spread

HSR = ROOT / "problems" / "hsr_jr680"


def spoken(capsys):
    return " ".join(capsys.readouterr().out.split())


@pytest.fixture(scope="module")
def small(hsr):
    return plan(hsr.problem, hsr.cell, touches=12, pool=60, starts=1, seed=2)


@pytest.mark.long
def test_the_message_carries_a_verdict_that_denies(hsr, corner_simulation):
    wrong = hsr.problem.with_settings({"sign": -1})
    found = calibrate(wrong, corner_simulation.samples, method="lm", reference=False)
    words = verdict_of(found).words
    assert words.startswith("Do not use")
    assert found.message == f"{words} {found.result.message}"
    verdict = {"level": "do not use", "words": words, "reasons": []}
    saved = SavedCalibration(CalibratedArm("a file", hsr, {"verdict": verdict, "status": "Converged."}))
    assert saved.message == f"{words} Converged."
    assert SavedCalibration(CalibratedArm("a file", hsr, {"status": "The truth."})).message == "The truth."


def test_what_cannot_be_corrected_names_no_function(hsr, small):
    alarm = Alarm(0, 1.0, 0.1, (Suspected(0, None, 1.0),))
    session = replace(
        Session(hsr.problem, small),
        state=SessionState(alarm=alarm),
        touches=Session(hsr.problem, small)._all_planned[:1],
    )
    with pytest.raises(CasacalError, match="Take it back, or keep it") as refused:
        session.correct()
    assert "()" not in str(refused.value)


@pytest.mark.long
@pytest.mark.parametrize("way", ["asked", "option"])
def test_the_session_is_asked_for_where_the_problem_tells_sessions_apart(tmp_path, monkeypatch, capsys, way):
    (tmp_path / "mine").mkdir()
    text = (HSR / "problem.py").read_text(encoding="utf-8")
    text += "\nfrom casacal import DialOnPlane, dial_zero\n"
    text += "problem = Problem(robot, DialOnPlane(noise_std=0.01, zero_shift=dial_zero()))\n"
    (tmp_path / "mine" / "problem.py").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert (
        main(["plan", "mine", "--out", "p.csv", "--touches", "12", "--pool", "60", "--check", "0", "--again", "0"]) == 0
    )
    named = [] if way == "asked" else ["--session", "monday"]
    monkeypatch.setattr("sys.stdin", io.StringIO(("monday\n" if way == "asked" else "") + "2.5\nq\n"))
    capsys.readouterr()
    assert main(["measure", "mine", "--plan", "p.csv", "--out", "s.csv", *named]) == 0
    assert ("session (Enter: " in capsys.readouterr().out) == (way == "asked")
    assert ",monday," in (tmp_path / "s.csv").read_text().splitlines()[-1]


def test_a_session_of_which_only_touches_to_verify_were_made_ends_quietly(hsr):
    problem = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, zero_shift=dial_zero()))
    session = Session(problem, plan(problem, hsr.cell, touches=12, pool=60, starts=1, check=0.2, again=0, seed=2))
    planned = session._all_planned
    first = next(touch for touch in planned if touch.purpose == "check")
    other = replace(first, labels={**first.labels, "session": "yesterday"})
    fits = [touch for touch in planned if touch.purpose == "fit"]
    assert session.resumed([other, *fits]).checked() is None
    off, _ = session.resumed([first, *fits]).checked()
    assert len(off) == 1


def test_an_error_that_nothing_bounds_is_called_so_by_plan_and_simulate(tmp_path, capsys):
    camera = str(ROOT / "problems" / "instruments" / "camera")
    assert main(["simulate", camera, "--samples", "12", "--out", str(tmp_path / "s.csv")]) == 0
    assert "from unbounded to" in spoken(capsys)
    assert main(["plan", camera, "--touches", "12", "--pool", "60", "--out", str(tmp_path / "p.csv")]) == 0
    assert "Priors alone: unbounded;" in spoken(capsys)


def test_targets_outside_the_limits_say_which_joint_and_by_how_much(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", str(HSR), "--samples", "40", "--out", "s.csv"]) == 0
    (tmp_path / "t.csv").write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,30,0,10,0\n0,200,0,0,-90,0\n")
    capsys.readouterr()
    assert main(["compensate", "s.truth.json", "t.csv", "--out", "c.csv"]) == 1
    assert "(q2 is 200 degrees, its limits -85 to 85)" in spoken(capsys)
    assert main(["compensate", "s.truth.json", "t.csv", "--out", "c.csv", "--json"]) == 1
    (lost,) = json.loads(capsys.readouterr().out)["missed"]
    assert "q2 is 200 degrees" in lost["meaning"]
    assert "q1" not in lost["meaning"]


@pytest.mark.parametrize(("flange", "tip", "said"), [(0.8, 0.05, True), (0.6, 0.6, False), (np.nan, 0.6, True)])
def test_what_is_promised_of_the_tip_is_compensated_at_the_tip(flange, tip, said):
    found = SimpleNamespace(hidden_tool=None, flange_std=(3.0, flange), tip_std=(3.0, tip))
    step = next_step(found, SimpleNamespace(level="calibrated"), out="out/fit")
    assert step.startswith("verify with fresh touches, then correct joint targets with casacal compensate out/fit/res")
    assert ("--frame tip" in step) == said


def test_samples_come_from_standard_input(monkeypatch, capsys):
    data = (HSR / "samples.csv").read_bytes()
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(data)))
    assert main(["check", str(HSR), "-"]) == 0
    assert "120 samples of standard input" in capsys.readouterr().out
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(data.replace(b",floor", b",", 1))))
    assert main(["check", str(HSR), "-"]) == 2
    assert "casacal: standard input, line " in capsys.readouterr().err


def test_a_program_leads_past_a_touch_from_which_the_arm_cannot_draw_back(hsr, small, monkeypatch):
    whole, true = ways_of.approaches(hsr.problem, small, hsr.cell), ways_of._above

    def held(*given):
        found = true(*given)
        found[[0, 4]] = np.nan
        return found

    monkeypatch.setattr(ways_of, "_above", held)
    ways = ways_of.approaches(hsr.problem, small, hsr.cell)
    np.testing.assert_array_equal(np.isnan(ways.retreat), np.isin(np.arange(len(small)), [0, 4]))
    assert not ways.clear[[0, 4]].any()
    assert ways.clear.sum() >= whole.clear.sum() - 3
    text = program_text(hsr.problem, small, ways, "krl", "an arm")
    assert text.count("is left out: the arm cannot draw back") == 2
    assert "touch 5 is left out" in text
    assert text.count("HALT") == 1 + len(small) - 2 + int((~ways.clear).sum()) - 2
    assert "nan" not in text
    monkeypatch.setattr(ways_of, "_above", lambda *given: np.full_like(true(*given), np.nan))
    with pytest.raises(CasacalError, match=r"From no touch .* smaller --retreat"):
        ways_of.approaches(hsr.problem, small, hsr.cell)


def test_set_ups_say_that_they_compare_with_one_another(hsr, small):
    compared = [SetUp("as it is", hsr.problem, hsr.cell, 0.6)]
    said = " ".join(plan_sentences(small, compared, where="over the workspace", pool=3000, after=False))
    assert "fitted touches of 600 candidates" in said
    assert "not with the plan above, chosen of 3000" in said


@pytest.mark.parametrize(
    ("value", "spread", "most", "said"),
    [
        (3.01234, 0.086, 2, ("+3.01", "0.09")),
        (12.345, 4.2, 2, ("+12.3", "4.2")),
        (-123.4, 57.0, 3, ("-123", "57")),
        (0.17263, 0.00493, 4, ("+0.1726", "0.0049")),
    ],
)
def test_no_more_digits_than_an_interval_deserves(value, spread, most, said):
    assert with_spread(value, spread, most) == said


@pytest.mark.parametrize(
    ("value", "count", "said"),
    [(123.4, 2, "120"), (4567.8, 3, "4570"), (0.01234, 3, "0.0123"), (2.0, 3, "2"), (-3.4e-5, 2, "-0.000034"),
     (0, 3, "0"), (float("inf"), 3, "inf")],
)  # fmt: skip
def test_lengths_and_angles_have_no_exponent(value, count, said):
    assert figures(value, count) == said
    assert figures(12.34, 2, signed=True) == "+12"


def test_a_number_that_is_none_is_said_with_what_is_allowed(tmp_path, capsys):
    asked = ["plan", str(HSR), "--touches", "12", "--pool", "60", "--out", str(tmp_path / "p.csv")]
    for option, said in (
        ("--check=nan", "Got nan as the part 'check'. Give a number from 0 to below 1"),
        ("--again=-1", "Got -1 as the part 'again'. Give a number from 0 to below 1"),
        ("--keep-out=0:inf,1:2,1:2", "--keep-out is 0:inf,1:2,1:2. Give numbers of mm"),
        ("--box=nan:1,1:2,1:2", "--box is nan:1,1:2,1:2. Give numbers of mm"),
    ):
        assert main([*asked, option]) == 2
        assert said in capsys.readouterr().err
    for tolerance in (float("nan"), float("inf"), -1.0):
        with pytest.raises(CasacalError, match=rf"Got {tolerance:g} as the tolerance\. Give a positive number of mm"):
            Session(load_problem(HSR).problem, tolerance=tolerance)
    assert not list(tmp_path.iterdir())


def test_a_file_in_the_wrong_place_is_answered_with_the_right_one(hsr, small, tmp_path, capsys):
    """A plan in place of samples; the folder of problems, or the samples, in place of a problem."""
    file = tmp_path / "plan.csv"
    file.write_text(plan_text(small, hsr.problem, "hsr"))
    for command in ("check", "calibrate"):
        assert main([command, str(HSR), str(file)]) == 2
        assert "this is a plan, which expects a reading and holds none. Give what was" in capsys.readouterr().err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "problem.py").write_text("")
    for path in (tmp_path, tmp_path / "mine" / "samples.csv"):
        with pytest.raises(ProblemError, match=rf"known here: .*{tmp_path.name}/mine"):
            load_problem(path)


def test_problems_of_this_project_need_no_session():
    layouts = [load_problem(ROOT / "problems" / name).problem for name in ("hsr_jr680", "ur5")]
    assert all(set(each.layout().labels) <= {each.instrument.groups} for each in layouts)


def with_a_dial_the_other_way_round(folder, simulation):
    """A file of the rows of a simulation, each reading counted from the other end of the travel."""
    rows, path = simulation.samples, folder / "turned.csv"
    turned = replace(rows, columns={"reading": 10 - rows.columns["reading"]})
    write_samples(path, simulation.problem.layout(), turned, [])
    return str(folder / "turned.csv")


@pytest.mark.long
def test_a_plan_after_samples_that_look_wrong_is_refused(corner_simulation, tmp_path, capsys):
    turned, out = with_a_dial_the_other_way_round(tmp_path, corner_simulation), str(tmp_path / "plan")
    asked = ["plan", str(HSR), "--touches", "8", "--pool", "100", "--out", out, "--after"]
    assert main([*asked, turned]) == 2
    said = capsys.readouterr()
    assert f"{turned} looks wrong (wrong dial sign)" in said.err
    assert f"casacal check {HSR} {turned}" in said.err
    assert said.out == ""
    assert not Path(out).exists()
    rows = corner_simulation.samples
    off = replace(rows, columns={"reading": rows.columns["reading"] + 2.0 * (np.arange(len(rows)) == 7)})
    for name, made, warned in (("right", rows, False), ("off", off, True)):
        write_samples(tmp_path / f"{name}.csv", corner_simulation.problem.layout(), made, [])
        assert main([*asked, str(tmp_path / f"{name}.csv")]) == 0
        assert ("looks wrong (lost revolution)" in spoken(capsys)) is warned


@pytest.mark.long
def test_the_advice_to_check_keeps_what_was_set_but_not_what_is_wrong(corner_simulation, tmp_path, capsys):
    turned = with_a_dial_the_other_way_round(tmp_path, corner_simulation)
    sign = load_problem(HSR).problem.instrument.sign
    asked = ["calibrate", str(HSR), turned, "--set", "noise_std=0.012", "--set", f"sign={sign}", "--prior", "a2=0.5"]
    assert main([*asked, "--accuracy", "0.7", "--no-reference"]) == 1
    said = spoken(capsys)
    assert f"run casacal check {HSR} {turned} --set noise_std=0.012 --prior a2=0.5 --accuracy 0.7." in said


@pytest.mark.long
def test_the_better_set_up_keeps_clear_of_what_the_plan_does(tmp_path, capsys):
    asked = ["plan", str(HSR), "--touches", "40", "--pool", "300", "--out", str(tmp_path / "plan")]
    assert main([*asked, "--keep-out", "5000:5100,0:10,0:10"]) == 0
    said = spoken(capsys).partition("touches: ")[0]
    assert "keep off the table, box 1, face 'floor'" in said
    assert "Consider another set-up first" in said
    assert "ignore" not in said, "both were compared among touches that keep clear"
    assert main(asked) == 0
    assert "box 1" not in spoken(capsys)


def test_directions_that_move_no_tip_are_listed_by_name(corner_calibration):
    _, harmless = direction_table(corner_calibration)
    assert len(harmless) > 2
    assert harmless == sorted(harmless)
