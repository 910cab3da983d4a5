"""What must not be used has no figure of accuracy, and is not exported or compensated by mistake."""

import csv
import dataclasses
import json
import re
import xml.etree.ElementTree as ET
from functools import cached_property

import casadi as ca
import numpy as np
import pytest
from seals import resealed

import casacal
from casacal import CasacalError, calibrate
from casacal.calibration.calibration import Calibration
from casacal.calibration.result_json import calibration_document
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.data.samples import write_samples
from casacal.deployment.export import export
from casacal.errors import RefusedResultError
from casacal.files import jsonable
from casacal.fit import BoundProblem
from casacal.values import alike
from studies.cell_mistakes import PROBLEMS, simulated

ACCURACY = re.compile(r"tip error of|expected tip error|error of the (flange|tip) to expect", re.IGNORECASE)
FORMS = {"zeros": "zeros.csv", "c": "arm.c"}
ARM = PROBLEMS / "adept_cobra600"


@pytest.fixture(scope="module")
def denied(tmp_path_factory):
    """A folder of a SCARA whose dial was read the wrong way on one face, and its samples."""
    folder = tmp_path_factory.mktemp("denied")
    source = casacal.load_problem(ARM)
    _, problem, samples = simulated(source.problem, source.cell, "sign on one face", 60, 0)
    write_samples(folder / "samples.csv", problem.layout(), samples, [])
    assert main(["calibrate", str(ARM), str(folder / "samples.csv"), "--out", str(folder / "out")]) == 1
    found = calibrate(source, folder / "samples.csv", reference=False)
    return folder, found


@pytest.mark.long
def test_no_file_holds_a_figure_of_accuracy(denied, capsys):
    folder, _ = denied
    document = json.loads((folder / "out" / "result.json").read_text())
    assert document["verdict"]["level"] == "do not use"
    assert document["tip"] is None
    assert document["covariance"] is None
    assert document["cures"] == []
    assert {row["std"] for row in document["parameters"] if row["known_from"] != "held"} == {None}
    with (folder / "out" / "parameters.csv").open() as file:
        next(file)  # the mark
        assert {row["std"] for row in csv.DictReader(file) if row["known_from"] != "held"} == {""}
    page = re.sub(r"<[^>]*>", " ", (folder / "out" / "report.html").read_text().split("<body")[1])
    assert not ACCURACY.search(re.sub(r"Expected tip error\s+not stated", "", page))
    for options in ([], ["--verbose"], ["--json"]):
        assert main(["calibrate", str(ARM), str(folder / "samples.csv"), *options]) == 1
        assert not ACCURACY.search(capsys.readouterr().out)


def numbers_in(item):
    """All numbers of a document, at any depth."""
    if isinstance(item, dict):
        item = list(item.values())
    if isinstance(item, list):
        return [number for each in item for number in numbers_in(each)]
    return [item] if isinstance(item, (int, float)) and not isinstance(item, bool) else []


def as_shown(number):
    """A number to as many digits as it was rounded to, six at least and nine at most: more alike is no chance."""
    return next((text for text in (f"{number:.{d}g}" for d in (6, 7, 8)) if float(text) == number), f"{number:.9g}")


def forced(found):
    """Figures of accuracy that would be told were the result not denied, to six digits or more, with what they are."""
    bare = found.unjudged
    directions = (*bare.identifiability.null, *bare.identifiability.weak)
    kinds = {
        "tip": (*bare.tip_std, bare.tip_std_without_prior[0]),
        "flange": bare.flange_std,
        "std": bare.result.std[bare.result.std < 0.999 * bare.fit.prior_std],  # what nobody found out is no figure
        "covariance": bare.covariance.ravel(),
        "cure": [cure.expected_rms_mm for cure in bare.cures],
        "direction": [each.tip_mm for each in directions],
        "face": [number for each in bare.left_out for number in (each.predicted_mm, each.ratio)],
    }
    told = {}
    for kind, figures in kinds.items():
        # short ones, as of a prior of 0.7 mm, stand elsewhere by their own right
        some = [f"{figure:.6g}" for figure in figures if np.isfinite(figure)]
        some = [text for text in some if len(text.partition("e")[0].strip("-0.").replace(".", "")) >= 5]
        assert some or kind == "flange", kind
        told.update(dict.fromkeys(some, kind))
        told.update({f"{figure:.{d}g}": kind for figure in figures for d in (7, 8, 9) if f"{figure:.6g}" in some})
    return told


@pytest.mark.long
def test_no_figure_of_accuracy_stands_anywhere_in_the_result(denied, capsys):
    """The whole document is walked: a part that somebody adds later is looked at too."""
    folder, found = denied
    told = forced(found)
    assert main(["calibrate", str(ARM), str(folder / "samples.csv"), "--json"]) == 1
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((folder / "out" / "result.json").read_text())
    for document in (written, printed, found.to_dict()):
        leaks = {text: told[text] for text in (as_shown(number) for number in numbers_in(document)) if text in told}
        assert not leaks
    good = json.loads(json.dumps(jsonable(calibration_document(sound(found)))))
    assert {told[text] for text in (as_shown(number) for number in numbers_in(good)) if text in told} >= {
        *("tip", "std", "covariance", "cure", "direction", "face")
    }, "this would not see them"


def sound(found):
    """The same calibration with a verdict that denies nothing."""
    bare = dataclasses.replace(found).unjudged
    vars(bare)["plain_errors"] = vars(bare)["data_errors"] = ()
    vars(bare)["noise"] = dataclasses.replace(bare.noise, low=1.0)
    return bare


def test_nor_in_the_report_or_at_length(denied, capsys):
    folder, found = denied
    page = (folder / "out" / "report.html").read_text()
    left_out = page.partition('id="left-out"')[2].partition("</table>")[0]
    assert "Found, mm RMS" in left_out
    assert "redicted" not in left_out.partition("</caption>")[2]
    directions = page.partition('id="directions"')[2].partition("</table>")[0]
    assert directions
    assert not re.search(r"<td[^>]*>[0-9.e-]+</td>", directions)
    assert 'id="correlations"' not in page
    assert main(["calibrate", str(ARM), str(folder / "samples.csv"), "--verbose"]) == 1
    said = capsys.readouterr().out
    assert "Each face by the others" in said
    for words in ("redicted", "moves the tip most", "at the tip under the prior", "correlated above"):
        assert words not in said
    found.report(folder / "again.html")
    assert "Not stated: a figure would be worth nothing" in (folder / "again.html").read_text()


def test_nor_does_any_attribute(denied):
    """Public figures of the object: NaN, nothing, or a sentence; the verdict itself still rests on the real ones."""
    folder, found = denied
    assert not found.success
    assert not found.passed
    assert found.unjudged.passed
    assert not casacal.load(folder / "out").success
    assert np.isnan(found.tip_std).all()
    assert np.isnan(found.flange_std).all()
    assert np.isnan(found.tip_std_without_prior[0])
    assert np.isnan(found.tip_from_minimum)
    assert np.isnan(found.covariance).all()
    told = found.sensitivity
    assert np.isnan(told.tip_by_row).all()
    assert np.isnan(told.tip_by_prior).all()
    assert told.most() == ([], [])
    assert np.isfinite(told.by_reading).all()
    assert max(found.unjudged.sensitivity.tip_by_row) > 0
    assert found.cures == ()
    assert np.isnan([each.tip_mm for each in (*found.identifiability.null, *found.identifiability.weak)]).all()
    assert np.isnan([each.predicted_mm for each in found.left_out]).all()
    with pytest.raises(CasacalError, match=r"Do not use this result.*; so nothing is known of how uncertain"):
        found.plot_tip_std()
    again = dataclasses.replace(found)
    said = verdict_of(again)
    assert again.tip_std is not None  # asked for before and after: the same verdict
    assert verdict_of(again) == said == verdict_of(found.unjudged)
    assert not any("no bound" in reason for reason in said.reasons)


WITHHELD = {
    *("passed", "std", "tip_std", "flange_std", "tip_std_without_prior", "tip_from_minimum", "covariance", "cures"),
    *("identifiability", "left_out", "sensitivity", "motion", "dial_errors", "leverages"),
}


def test_all_else_is_what_it_was(denied):
    """No further figure is worked out from what is withheld: such a one would be quietly wrong."""
    _, found = denied
    kinds = (property, cached_property)
    names = {name for each in Calibration.__mro__ for name, item in vars(each).items() if isinstance(item, kinds)}
    assert names > WITHHELD
    for name in sorted(names):
        told, real = getattr(found, name), getattr(found.unjudged, name)
        same = told == real if isinstance(told, BoundProblem) else alike(told, real)
        assert same is (name not in WITHHELD), name


def test_nor_does_the_object(denied):
    _, found = denied
    assert found.parameters["std"][found.parameters["known_from"] != "held"].isna().all()
    assert "tip error" not in repr(found)
    with pytest.raises(CasacalError, match="no standard deviations"):
        found.predict(np.zeros(4), std=True, force=True)
    assert all(np.isnan(error.tip_mm) for error in found.dial_errors)
    assert found.leverages
    assert all(np.isnan([each.tip_mm, each.left_mm]).all() for each in found.leverages)
    assert "do not use" in repr(found.arm)
    whole = found.to_dict()
    assert whole["tip"] is None
    assert whole["covariance"] is None
    assert "covariance" not in whole["discrepancy"]
    assert {row["std"] for row in whole["parameters"] if row["known_from"] != "held"} == {None}
    asked = {
        "predict": lambda **drawn: found.predict(np.zeros(4), **drawn),
        "values": found.values,
        "pose": found.pose_function,
        "tip": found.tip_function,
    }
    for ask in asked.values():
        with pytest.raises(RefusedResultError, match=r"Do not use this result.*force=True"):
            ask()
        ask(force=True)
        ask(nominal=True)  # what is drawn needs no verdict
    found.pose_function(free=True)
    with pytest.raises(CasacalError, match=r"Do not use.*force"):
        found.compensate(np.zeros((1, 4)))
    assert np.isnan(found.compensate(np.full((1, 4), 0.3), force=True).expected_mm).all()
    with pytest.raises(CasacalError, match=r"Do not use.*force"):
        found.export("zeros")


@pytest.mark.parametrize("form", FORMS)
def test_exports_refuse_and_say_so_when_forced(denied, form, tmp_path, capsys):
    folder, _ = denied
    command = ["export", str(folder / "out" / "result.json"), "--to", form, "--out", str(tmp_path / FORMS[form])]
    assert main(command) == 1
    assert "--force" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert main([*command, "--force"]) == 0
    written = (tmp_path / FORMS[form]).read_text()
    assert "Do not use this result" in written
    assert not ACCURACY.search(written)


def test_a_forced_function_for_casadi_says_so_in_its_name(denied, tmp_path, capsys):
    folder, _ = denied
    command = ["export", str(folder / "out"), "--to", "casadi", "--out", str(tmp_path / "arm.casadi")]
    assert main(command) == 1
    assert "--force" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert main([*command, "--force"]) == 0
    assert "Do not use this result" in capsys.readouterr().out
    assert ca.Function.load(str(tmp_path / "arm.casadi")).name() == "pose_forced_against_the_verdict"


@pytest.mark.long
@pytest.mark.parametrize("form", ["urdf", "dh"])
def test_forced_files_that_keep_their_form_say_so_in_a_comment(form, tmp_path):
    from robots_of_others import UR5_CSV, UR5_URDF

    place = tmp_path / f"ur5.{'urdf' if form == 'urdf' else 'csv'}"
    place.write_text(UR5_URDF if form == "urdf" else UR5_CSV)
    given = ["--urdf", str(place), "--tip", "tool0"] if form == "urdf" else ["--dh", str(place)]
    assert main(["new", "mine", *given, "--out", str(tmp_path)]) == 0
    source = casacal.load_problem(tmp_path / "mine")
    found = calibrate(source, casacal.simulate(source.problem, samples=60, seed=0).samples, reference=False)
    words = {"level": "do not use", "words": "Do not use this result: it -- is a test.", "reasons": []}
    arm = dataclasses.replace(found.arm, document={**found.arm.document, "verdict": words})
    with pytest.raises(CasacalError, match=r"Do not use.*force"):
        export(arm, form)
    text = export(arm, form, force=True)
    assert "Do not use this result" in text.split("<link" if form == "urdf" else "joint,")[0]
    if form == "urdf":
        assert ET.fromstring(text.encode()).tag == "robot"


def test_compensated_targets_say_so_when_forced(denied, tmp_path, capsys):
    folder, _ = denied
    result, targets = str(folder / "out" / "result.json"), tmp_path / "targets.csv"
    targets.write_text("q1_deg,q2_deg,q3_mm,q4_deg\n10,-80,70,20\n")
    for form in ("csv",):
        command = ["compensate", result, str(targets), "--out", str(tmp_path / form), "--format", form]
        assert main(command) == 1
        assert not (tmp_path / form).exists()
        assert main([*command, "--force"]) == 0
        written = (tmp_path / form).read_text()
        assert "WARNING, forced against the verdict: Do not use" in written
        assert not ACCURACY.search(written)
    assert (tmp_path / "csv").read_text().splitlines()[-1].endswith(",")  # nothing is expected
    capsys.readouterr()
    predict = ["predict", result, str(targets), "--out", str(tmp_path / "p.csv")]
    assert main(predict) == 1
    assert "Do not use" in capsys.readouterr().err
    assert not (tmp_path / "p.csv").exists()
    assert main([*predict, "--force"]) == 0
    assert "Do not use" in capsys.readouterr().out
    assert "# WARNING, against the verdict: Do not use" in (tmp_path / "p.csv").read_text()
    assert main([*predict, "--nominal"]) == 0
    assert "WARNING" not in (tmp_path / "p.csv").read_text(), "the drawn arm is no result"
    assert main(["verify", result, str(folder / "samples.csv")]) == 2
    assert "Do not use" in (folder / "out" / "parameters.csv").read_text().splitlines()[0]


@pytest.fixture(scope="module")
def with_care(tmp_path_factory):
    """The result.json of a UR5 whose verdict is to use it with care, and what it says."""
    from robots_of_others import UR5_CSV

    folder = tmp_path_factory.mktemp("care")
    (folder / "ur5.csv").write_text(UR5_CSV)
    assert main(["new", "mine", "--dh", str(folder / "ur5.csv"), "--out", str(folder)]) == 0
    assert main(["simulate", str(folder / "mine"), "--samples", "60", "--out", str(folder / "s.csv")]) == 0
    found = calibrate(folder / "mine", folder / "s.csv", method="lm", reference=False)
    result, document = folder / "result.json", jsonable(found.to_dict())
    document["verdict"] = {
        "level": "use with care",
        "words": f"Use with care: it -- is {'so ' * 120}a test.",
        "reasons": ["Why."],
    }
    result.write_text(json.dumps(resealed(document)))
    return result, document["verdict"]["words"]


@pytest.mark.parametrize(
    ("arguments", "form"),
    [
        (["compensate", "TARGETS"], "csv"),
        (["compensate", "TARGETS", "--format", "rapid"], "mod"),
        (["predict", "TARGETS"], None),
        (["predict", "TARGETS", "--std"], None),
        *((["export", "--to", to], to) for to in ("dh", "zeros", "ur", "c")),
    ],
)
def test_what_is_used_with_care_says_so(with_care, arguments, form, tmp_path, capsys):
    """On the terminal, for other programs, and in files that have comments."""
    result, words = with_care
    targets = tmp_path / "targets.csv"
    targets.write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,-80,70,20,30,40\n")
    command, *rest = [str(targets) if each == "TARGETS" else each for each in arguments]
    place = tmp_path / "written"
    capsys.readouterr()
    assert main([command, str(result), *rest, "--out", str(place)]) == 0
    assert words in capsys.readouterr().out
    assert form is None or words in re.sub(r"\s*\n\s*[#!;*]+ +", " ", place.read_text())
    assert main([command, str(result), *rest, "--out", str(place), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == {"level": "use with care", "words": words}


@pytest.mark.long
def test_a_urdf_of_a_result_to_be_used_with_care_says_so_once(tmp_path):
    from robots_of_others import UR5_URDF

    place = tmp_path / "ur5.urdf"
    place.write_text(UR5_URDF)
    assert main(["new", "mine", "--urdf", str(place), "--tip", "tool0", "--out", str(tmp_path)]) == 0
    source = casacal.load_problem(tmp_path / "mine")
    found = calibrate(source, casacal.simulate(source.problem, samples=60, seed=0).samples, reference=False)
    words = {"level": "use with care", "words": "Use with care: it -- is a test.", "reasons": []}
    arm = dataclasses.replace(found.arm, document={**found.arm.document, "verdict": words})
    place.write_text(UR5_URDF.replace("<robot", "<!-- casacal: an older verdict\n of two lines -->\n<robot"))
    for text in (export(arm, "urdf"), export(arm, "urdf", source=place)):
        assert text.count("Use with care: it - - is a test.") == text.count("casacal: the result") == 1
        assert "an older verdict" not in text
    good = dataclasses.replace(found.arm, document={**found.arm.document, "verdict": {**words, "level": "calibrated"}})
    assert "Use with care" not in export(good, "urdf")
