"""result.json stands alone: it holds the arm as data, runs no code, and notices an arm that was edited since."""

import copy
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
from importlib import import_module
from typing import get_args

import casadi as ca
import jsonschema
import numpy as np
import pytest
from conftest import ROOT
from fuzz_seeds import URDF
from seals import resealed
from test_export import PLAIN
from test_own_instrument import written

import casacal
from casacal import CasacalError, Instrument, calibrate, effects, load, load_problem, simulate
from casacal.cli.main import main
from casacal.deployment.as_data import KINDS, problem_data, problem_from
from casacal.deployment.result import SCHEMA, Level
from casacal.deployment.result_file import misfits, read_result, schema_text
from casacal.effects import Effect
from casacal.kernels.program import graph_data, graph_from
from casacal.model.unknown import Unknown

PROBLEMS = ("hsr_jr680", "ur5", "kuka_iiwa14", "adept_cobra600", "motoman_ma1400")
FROM_FILE = """from casacal import Problem, Robot, TrackedPoint, tool_point
from pathlib import Path
from sizes import NOISE
robot = Robot.{read}(Path(__file__).parent / "{file}")
problem = Problem(robot, TrackedPoint(noise_std=NOISE, tool=tool_point(0, 0, 50, prior_std=1.0)))
"""
DH = "# convention: standard\n" + PLAIN + "1,90,0,300,0\n2,0,400,0,0\n3,0,300,0,0\n"


def folder_of(place, read, file, text):
    place.mkdir(parents=True)
    (place / file).write_text(text)
    (place / "sizes.py").write_text("NOISE = 0.01\n")
    (place / "problem.py").write_text(FROM_FILE.format(read=read, file=file))
    return place


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A project of problem folders, each with a result in its `out`, to be copied and edited."""
    place = tmp_path_factory.mktemp("project")
    for name, read, file, text in (("urdf", "from_urdf", "arm.urdf", URDF), ("dh", "from_dh_file", "arm.csv", DH)):
        folder = folder_of(place / name, read, file, text)
        assert main(["simulate", str(folder), "--out", str(folder / "samples.csv"), "--samples", "60"]) == 0
        calibrate(folder, method="lm", reference=False).save(folder / "out")
    return place


def test_formats_that_an_arm_does_not_use_are_not_loaded():
    """A dial needs neither trackers nor known points."""
    code = (
        "import sys\nfrom casacal import calibrate\n"
        "from casacal.calibration import result_json\n"
        "from casacal.deployment.as_data import problem_data, problem_from\n"
        "from casacal.model.problem_file import load_problem\n"
        f"problem_from(problem_data(load_problem({str(ROOT / 'problems' / 'hsr_jr680')!r}).problem))\n"
        "print(*sorted({'instruments.points', 'instruments.tracked_pose'} & "
        "{name.removeprefix('casacal.') for name in sys.modules}))\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == ""


def test_every_class_of_the_data_is_where_it_is_said_to_be():
    for name, home in KINDS.items():
        assert getattr(import_module(home), name).__module__ == home
    public = [getattr(casacal, name) for name in casacal.__all__] + [getattr(effects, name) for name in vars(effects)]
    ours = [each for each in public if isinstance(each, type) and issubclass(each, (Instrument, Unknown, Effect))]
    assert len(ours) > 15
    for each in set(ours) - {Instrument, Effect}:
        assert each.__name__ in KINDS, f"{each.__name__} would come back from a file as a trace, without its words"


@pytest.mark.parametrize("name", PROBLEMS)
def test_an_arm_is_told_as_data_and_taken_back(name):
    problem = load_problem(ROOT / "problems" / name).problem
    back = problem_from(json.loads(json.dumps(problem_data(problem))))
    rng = np.random.default_rng(0)
    for function in ("tip", "pose", "residual", "noise", "jacobian"):
        one, two = getattr(problem.model, function), getattr(back.model, function)
        given = [
            0.01 * rng.normal(size=one.numel_in(0)),
            rng.normal(size=one.numel_in(1)),
            rng.normal(size=one.numel_in(2)),
        ]
        for a, b in zip(one.call(given), two.call(given), strict=True):
            np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=0, atol=1e-9)
    assert back.robot.arm == problem.robot.arm
    assert back.robot.axes == problem.robot.axes
    assert back.layout() == problem.layout()
    assert problem_data(back)["joints"] == problem_data(problem)["joints"]


def test_graphs_of_every_operation_are_read_back():
    x = ca.SX.sym("x", 2, 2)
    a, b = x[0, 0], x[1, 0]
    built = [
        ca.if_else(a > b, ca.sin(a), ca.atan2(a, b)) + ca.fmod(a, 0.3) * ca.erf(b) + ca.sqrt(ca.fabs(a)) ** 1.7,
        ca.vertcat(
            ca.tanh(a), ca.log1p(b**2), ca.fmin(a, b), ca.sign(a), ca.logic_not(a < b), ca.hypot(a, b), 1 / a, 3.5
        ),
        ca.SX(2, 2) + ca.horzcat(ca.asinh(a), ca.floor(b)).T @ ca.SX.ones(1, 2),
    ]
    function = ca.Function("f", [x, ca.SX.sym("unused", 0, 1)], [ca.densify(each) for each in built])
    back = graph_from(json.loads(json.dumps(graph_data(function))))
    for seed in range(20):
        value = np.random.default_rng(seed).normal(size=(2, 2))
        for one, two in zip(function.call([value, []]), back.call([value, []]), strict=True):
            np.testing.assert_array_equal(np.asarray(one), np.asarray(two))


@pytest.mark.parametrize(
    "line",
    ["sin 9", "sin", "sin 0 0", "mul 0", "const x", "input 0 9", "input 1 0", "call 0", "sin -1", "", "lift 0 0"],
)
def test_a_line_that_is_no_operation_is_refused(line):
    x = ca.SX.sym("x")
    data = graph_data(ca.Function("f", [x], [ca.sin(x)]))
    data["operations"][1] = line
    with pytest.raises(CasacalError, match="A graph cannot be read"):
        graph_from(data)


@pytest.mark.long_unless("adept_cobra600")
@pytest.mark.parametrize("name", ["hsr_jr680", "ur5", "adept_cobra600"])
def test_a_result_predicts_compensates_and_exports_from_anywhere(name, tmp_path, monkeypatch):
    shutil.copytree(ROOT / "problems" / name, tmp_path / "project" / name)
    found = calibrate(tmp_path / "project" / name, method="lm", reference=False)
    found.save(tmp_path / "project" / "out")
    (tmp_path / "alone").mkdir()
    shutil.move(tmp_path / "project" / "out" / "result.json", tmp_path / "alone" / "some.json")
    shutil.rmtree(tmp_path / "project")
    monkeypatch.chdir(tmp_path / "alone")
    alone = load("some.json")
    q = found.samples.joints[:5]
    for frame in ("flange", "tip"):
        one, two = (arm.predict(q, frame=frame, std=True) for arm in (found, alone))
        np.testing.assert_allclose(one.positions, two.positions, rtol=0, atol=1e-9)
        np.testing.assert_allclose(one.std, two.std, rtol=1e-9)
        mine, theirs = (arm.compensate(q, frame=frame) for arm in (found, alone))
        np.testing.assert_allclose(mine.joints, theirs.joints, rtol=0, atol=1e-9)
    for form in ("zeros", "c") + (("dh",) if name != "adept_cobra600" else ()):
        assert alone.export(form).splitlines()[5:] == found.export(form).splitlines()[5:]


def test_a_urdf_is_exported_from_the_result_alone(made, tmp_path):
    shutil.copy(made / "urdf" / "out" / "result.json", tmp_path / "r.json")
    text = load(tmp_path / "r.json").export("urdf")
    assert text.replace("r.json", "result.json", 1) == load(made / "urdf" / "out").export("urdf")
    (tmp_path / "new.urdf").write_text(text)
    moved = casacal.Robot.from_urdf(tmp_path / "new.urdf")
    assert moved.arm.chain != casacal.Robot.from_urdf(made / "urdf" / "arm.urdf").arm.chain


EDITS = {
    "urdf/arm.urdf": [("1.5 0 0", "1.4 0 0"), ('xyz="0 0 1"/><limit', 'xyz="0 0 -1"/><limit'), ("0.3 0 0", "0.5 0 0")],
    "dh/arm.csv": [("2,0,400", "2,0,401"), ("1,90,0", "1,-90,0")],
    "urdf/problem.py": [("0, 0, 50", "0, 0, 150")],
    "dh/sizes.py": [("0.01", "0.02")],
}


@pytest.mark.parametrize(("file", "old", "new"), [(file, *edit) for file, edits in EDITS.items() for edit in edits])
@pytest.mark.parametrize("command", ["predict", "compensate", "export"])
def test_an_arm_that_was_edited_since_is_noticed(made, tmp_path, file, old, new, command, capsys):
    name = file.partition("/")[0]
    shutil.copytree(made / name, tmp_path / name)
    result = str(tmp_path / name / "out" / "result.json")
    (tmp_path / "q.csv").write_text("q1_deg,q2_deg,q3_deg\n10,20,30\n")
    given = {"predict": ["q.csv"], "compensate": ["q.csv"], "export": ["--to", "zeros"]}[command]
    given = [str(tmp_path / word) if word == "q.csv" else word for word in given]
    typed = [command, result, *given, "--out", str(tmp_path / "answer.csv")]
    assert main(typed) == 0
    (tmp_path / "answer.csv").unlink()
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new))
    assert main(typed) == 2
    said = capsys.readouterr().err
    assert f"{file.rpartition('/')[2]} has changed since the calibration" in said
    assert not (tmp_path / "answer.csv").exists()
    (tmp_path / file).write_text(text)
    assert main(typed) == 0


def test_comments_and_layout_are_no_change(made, tmp_path):
    shutil.copytree(made / "dh", tmp_path / "dh")
    file = tmp_path / "dh" / "problem.py"
    file.write_text("# a comment\n\n" + file.read_text().replace("noise_std=NOISE, ", "noise_std = NOISE,  # why\n"))
    (tmp_path / "dh" / "arm.csv").write_text(
        (tmp_path / "dh" / "arm.csv").read_text().replace("400", "400.0") + "# end\n"
    )
    q = np.full((1, 3), 0.3)
    np.testing.assert_array_equal(
        load(tmp_path / "dh" / "out").predict(q).positions, load(made / "dh" / "out").predict(q).positions
    )
    shutil.copytree(made / "urdf", tmp_path / "urdf")
    arm = tmp_path / "urdf" / "arm.urdf"
    arm.write_text(
        arm.read_text().replace("<robot", "<!-- mine -->\n<robot").replace('xyz="0.4 0 0"', 'xyz="0.40 0 0.0"')
    )
    np.testing.assert_array_equal(
        load(tmp_path / "urdf" / "out").predict(q).positions, load(made / "urdf" / "out").predict(q).positions
    )


def test_no_code_is_run(tmp_path):
    """Neither that of a result that holds its arm, nor that of an older one whose problem is another one now."""
    place = written(tmp_path, "stylus")
    source = load_problem(place)
    calibrate(source, simulate(source.problem, samples=80, seed=1).samples, method="lm").save(place / "out")
    ran = f"open({str(tmp_path / 'ran')!r}, 'w').close()\n"
    text = (place / "problem.py").read_text()
    (place / "problem.py").write_text(ran + text)
    with pytest.raises(CasacalError, match="has changed since"):
        load(place / "out")
    document = json.loads((place / "out" / "result.json").read_text())
    older = {key: item for key, item in document.items() if key not in ("schema", "arm", "seal")}
    older["problem"] = {"name": "own", "path": str(place / "problem.py"), "sha256": source.sha256}
    (tmp_path / "older.json").write_text(json.dumps(older))
    with pytest.raises(CasacalError, match="has changed since"):
        load(tmp_path / "older.json")
    assert not (tmp_path / "ran").exists()
    (place / "problem.py").write_text(text)
    q = np.zeros((1, len(source.problem.robot.axes)))
    np.testing.assert_allclose(
        load(tmp_path / "older.json").predict(q).positions, load(place / "out").predict(q).positions, atol=1e-9
    )
    shutil.rmtree(place)
    with pytest.raises(CasacalError, match=r"problem=\.\.\."):
        load(tmp_path / "older.json")


def test_a_newer_result_is_refused_in_a_sentence(made, tmp_path, capsys):
    document = json.loads((made / "dh" / "out" / "result.json").read_text())
    assert document["schema"] == SCHEMA
    document["schema"] = SCHEMA + 1
    (tmp_path / "r.json").write_text(json.dumps(document))
    assert main(["predict", str(tmp_path / "r.json"), "q.csv", "--out", str(tmp_path / "p.csv")]) == 2
    assert "a newer casacal wrote it" in capsys.readouterr().err


def test_an_arm_that_was_changed_in_the_file_is_refused(made, tmp_path):
    text = (made / "dh" / "out" / "result.json").read_text()
    document = json.loads(text)
    document["arm"]["arm"]["a"][1] += 1.0
    for changed in (document, resealed(document)):
        (tmp_path / "r.json").write_text(json.dumps(changed))
        with pytest.raises(CasacalError, match="changed after it was written"):
            read_result(tmp_path / "r.json")


EDITED = {
    "the level": lambda d: d["verdict"].update(level="use with care"),
    "the words": lambda d: d["verdict"].update(words="Calibrated: expect a tip error of 0.001 mm."),
    "the tip": lambda d: d["tip"].update(expected_rms_mm=0.01),
    "the covariance, scaled": lambda d: d.update(covariance=(1e-4 * np.array(d["covariance"])).tolist()),
    "no convergence": lambda d: d.update(converged=False),
    "the method": lambda d: d.update(method="truth"),
    "the noise": lambda d: next(iter(d["noise"]["by_face"].values())).update(used_mm=0.5),
    "the hash of the rows": lambda d: d["data"].update(sha256="0" * 64),
    "the rows": lambda d: d["data"]["fitted_rows"]["values"].reverse(),
    "no rows": lambda d: d["data"].pop("fitted_rows"),
    "no noise": lambda d: d.pop("noise"),
    "metrics": lambda d: d["metrics"]["after"]["fit"].update(rmse_mm=0.0),
    "a null": lambda d: d.update(covariance=None),
    "the seal's keys": lambda d: d["seal"]["of"].remove("verdict"),
    "the seal's keys and what they name": lambda d: (d["seal"]["of"].remove("noise"), d.pop("noise")),
    "the seal": lambda d: d["seal"].update(sha256="0" * 64),
    "no seal": lambda d: d.pop("seal"),
    "an empty seal": lambda d: d.update(seal=None),
    "a seal of nothing": lambda d: d.update(seal={"of": [], "sha256": d["seal"]["sha256"]}),
    "a seal of numbers": lambda d: d.update(seal={"of": [3, {}], "sha256": d["seal"]["sha256"]}),
    "an older schema": lambda d: d.update(schema=0),
    "an older schema without a seal": lambda d: (d.update(schema=1), d.pop("seal")),
}


@pytest.mark.parametrize("edit", EDITED)
def test_whatever_was_edited_by_hand_is_noticed(made, tmp_path, edit):
    document = json.loads((made / "dh" / "out" / "result.json").read_text())
    assert document == resealed(document), "the seal is what its words say"
    EDITED[edit](document)
    (tmp_path / "r.json").write_text(json.dumps(document))
    with pytest.raises(CasacalError, match=r"changed after it was written. Restore it, or calibrate again"):
        load(tmp_path / "r.json")


@pytest.mark.parametrize("level", [None, "DO NOT USE", "calibrated!", 3, "", ["calibrated"]])
def test_a_verdict_that_says_nothing_known_is_refused(made, tmp_path, level):
    document = json.loads((made / "dh" / "out" / "result.json").read_text())
    document["verdict"]["level"] = level
    (tmp_path / "r.json").write_text(json.dumps(resealed(document)))
    with pytest.raises(CasacalError, match=r"its 'verdict\.level' is"):
        load(tmp_path / "r.json")
    for missing in (lambda d: d.pop("verdict"), lambda d: d.update(verdict=None)):
        missing(document)
        (tmp_path / "r.json").write_text(json.dumps(resealed(document)))
        with pytest.raises(CasacalError, match="it holds no verdict"):
            load(tmp_path / "r.json")
        document["verdict"] = {}


def test_what_others_add_layout_and_seconds_break_no_seal(made, tmp_path):
    file = made / "dh" / "out" / "result.json"
    document = json.loads(file.read_text())
    document["seconds"]["total"] = 0.0
    changed = {"remark": "cell 4", **dict(reversed(document.items()))}
    (tmp_path / "r.json").write_text(json.dumps(changed, indent=7))
    q = np.full((1, 3), 0.3)
    found, first = load(tmp_path / "r.json").predict(q, std=True), load(file).predict(q, std=True)
    np.testing.assert_array_equal(found.std, first.std)


def test_a_truth_has_a_seal_and_needs_no_verdict(made, tmp_path):
    document = json.loads((made / "dh" / "samples.truth.json").read_text())
    assert "verdict" not in document
    assert document == resealed(document)
    load(made / "dh" / "samples.truth.json")
    document["seed"] += 1
    (tmp_path / "t.json").write_text(json.dumps(document))
    with pytest.raises(CasacalError, match="changed after it was written"):
        load(tmp_path / "t.json")


def test_the_levels_of_a_file_are_those_of_a_verdict():
    known = json.loads(schema_text())["$defs"]["verdict"]["properties"]["level"]["enum"]
    assert get_args(Level) == tuple(known)


def test_what_is_written_fits_the_schema_that_is_printed(made, capsys):
    assert main(["schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    jsonschema.Draft202012Validator.check_schema(schema)
    for file in (made / "dh" / "out" / "result.json", made / "dh" / "samples.truth.json"):
        document = json.loads(file.read_text())
        jsonschema.validate(document, schema)
        assert set(document) <= set(schema["properties"]), "every key that is written is described"


@pytest.mark.long_unless("few")
@pytest.mark.parametrize("rounds", [pytest.param(20, id="few"), pytest.param(120, id="many")])
def test_damage_is_found_where_another_validator_finds_it(made, rounds):
    document = json.loads((made / "dh" / "out" / "result.json").read_text())
    schema, rng, damaged = json.loads(schema_text()), random.Random(1), 0
    other = jsonschema.Draft202012Validator(schema)
    for _ in range(rounds):
        changed = mutated(document, rng)
        if "NaN" in json.dumps(changed):  # which JSON has no word for, so that no schema speaks of it
            continue
        errors = list(other.iter_errors(changed))
        there = {tuple(error.absolute_path) for error in errors if error.validator != "required"}
        there |= {
            (*error.absolute_path, error.message.split("'")[1]) for error in errors if error.validator == "required"
        }
        assert {way for way, _ in misfits(schema, changed)} == there
        damaged += bool(there)
    assert damaged > rounds / 10


@pytest.mark.parametrize(
    ("way", "value", "good"),
    [
        (("parameters", 0, "estimate"), 1e5, False),
        (("parameters", 0, "estimate"), -1e5, False),
        (("parameters", 0, "std"), None, True),
        (("noise", "by_face", "wall", "stated_mm"), 0, False),
        (("noise", "by_face", "wall", "used_mm"), -1.0, False),
        (("discrepancy", "effects", 0, "times"), 0, False),
        (("schema",), True, False),
        (("converged",), 1, False),
    ],
)
def test_sizes_and_kinds_are_those_of_another_validator(made, way, value, good):
    document = json.loads((made / "dh" / "out" / "result.json").read_text())
    document["noise"]["by_face"] = {"wall": {"stated_mm": 0.01, "used_mm": 0.01}}
    document["discrepancy"] = {"effects": [{"key": "k", "words": "w", "times": 1.0}], "unknowns": []}
    holder = document
    for step in way[:-1]:
        holder = holder[step]
    holder[way[-1]] = value
    schema = json.loads(schema_text())
    assert jsonschema.Draft202012Validator(schema).is_valid(document) is good
    assert [each for each, _ in misfits(schema, document)] == ([] if good else [way])


def mutated(document, rng):
    """A copy in which one value anywhere is another one, gone, or there twice."""
    changed = copy.deepcopy(document)
    holder, key = changed, None
    while isinstance(holder if key is None else holder[key], (dict, list)):
        inner = holder if key is None else holder[key]
        if not inner or (key is not None and rng.random() < 0.1):
            break
        holder, key = inner, rng.choice(list(inner) if isinstance(inner, dict) else range(len(inner)))
    others = [None, True, -1, 1e308, "", "x", [], {}, [[]], {"name": 3}, float("nan"), 10**400]
    if rng.random() < 0.3:
        del holder[key]
    elif rng.random() < 0.2 and isinstance(holder, list):
        holder.append(copy.deepcopy(holder[key]))
    else:
        holder[key] = rng.choice(others)
    return changed


@pytest.mark.long
def test_a_damaged_result_is_refused_in_a_sentence(made, tmp_path):
    """Whatever one changes: an answer or a sentence, in all that is asked of a result."""
    document = json.loads((made / "dh" / "out" / "result.json").read_text())
    del (
        document["cures"],
        document["data"]["fitted_rows"],
    )  # nothing that is asked here reads them, so that damage to them is no damage
    rng, q, said = random.Random(0), np.zeros((1, 3)), []
    for _ in range(90):
        changed = mutated(document, rng)
        (tmp_path / "r.json").write_text(json.dumps(resealed(changed) if "seal" in changed else changed))
        try:
            saved = load(tmp_path / "r.json")
            _ = repr(saved), saved.success, saved.message, saved.cost, saved.parameters, saved.metrics
            saved.predict(q, std=True)
            saved.export("zeros")
        except CasacalError as error:
            said.append(str(error))
    assert 25 < len(said) < 90
    assert not [sentence for sentence in said if "\n" in sentence]


def with_arm_edited(document, edit):
    """A copy with an edited arm whose hash was made anew: what somebody who knows how may write."""
    changed = copy.deepcopy(document)
    edit(changed["arm"])
    kept = {key: item for key, item in changed["arm"].items() if key != "sha256"}
    changed["arm"]["sha256"] = hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()
    return resealed(changed)


@pytest.mark.parametrize(
    "edit",
    [
        lambda arm: arm.update(joints=20_000_000),
        lambda arm: arm.update(joints=10**40),
        lambda arm: arm.update(pose="x"),
        lambda arm: arm["parameters"].update(items={}),
        lambda arm: arm["instruments"][0]["tool"].update(labels=[True, 1, None]),
        lambda arm: arm["instruments"][0].update(noise_std=10**400),
        lambda arm: arm["instruments"].clear(),
    ],
)
def test_an_arm_of_the_wrong_kind_is_refused(made, tmp_path, edit):
    document = json.loads((made / "dh" / "out" / "result.json").read_text())
    (tmp_path / "r.json").write_text(json.dumps(with_arm_edited(document, edit)))
    with pytest.raises(CasacalError):
        load(tmp_path / "r.json")


def test_a_result_that_says_two_things_is_refused(made, tmp_path):
    text = (made / "dh" / "out" / "result.json").read_text()
    for edit in ("parameters", "unknowns", "covariance", "huge", "negative"):
        document = json.loads(text)
        if edit == "parameters":
            document["parameters"][0]["estimate"] += 0.01
        elif edit == "unknowns":
            document["unknowns"][0]["value"] += 0.01
        elif edit == "covariance":
            document["covariance"][0][1] *= 1.01
        elif edit == "huge":
            document["covariance"][0][1] = 1e200
        else:
            document["covariance"] = (-np.array(document["covariance"])).tolist()
        (tmp_path / "r.json").write_text(json.dumps(resealed(document)))
        with pytest.raises(CasacalError, match=r"two things|symmetric|negative"):
            load(tmp_path / "r.json")
    for edit in ({"covariance_of": ["a1"]}, {"covariance_of": [1]}, {"covariance_of": "a1"}, {"covariance_of": ["z9"]}):
        (tmp_path / "r.json").write_text(json.dumps(json.loads(text) | edit))
        with pytest.raises(CasacalError, match=r"covariance_of|symmetric"):
            load(tmp_path / "r.json")
    (tmp_path / "r.json").write_text(text.rstrip().rstrip("}") + ', "seed": 3}')
    with pytest.raises(CasacalError, match="not a result"):
        load(tmp_path / "r.json")


def test_files_that_a_result_names_are_read_only_if_they_are_files(made, tmp_path):
    document = json.loads((made / "dh" / "out" / "result.json").read_text())
    os.mkfifo(tmp_path / "pipe")
    for path in ("/dev/zero", str(tmp_path / "pipe")):
        document["problem"]["files"][0]["path"] = path
        (tmp_path / "r.json").write_text(json.dumps(resealed(document)))
        assert load(tmp_path / "r.json").predict(np.zeros((1, 3))).positions.shape == (1, 3)
