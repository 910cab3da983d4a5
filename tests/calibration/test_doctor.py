"""The data doctor names planted faults, and says nothing of clean samples."""

import dataclasses
import math
import re
import sys

import numpy as np
import pytest
from conftest import ROOT

from casacal import Conventions, DialOnBody, DialOnPlane, Problem, Step, bind, check, deg, lm, load_problem, simulate
from casacal.calibration.before_fit import odd_labels, outside, tells_a_wrong_sign
from casacal.calibration.set_aside import studentised_outliers
from casacal.cli.common import number_or_range
from casacal.cli.main import main
from casacal.data.columns import Labels
from casacal.data.samples import write_samples
from casacal.effects import with_kit
from casacal.uncertainty.figures import leverages

REPLACE = dataclasses.replace


def moved(samples, change):
    return REPLACE(samples, joints=change(samples.joints.copy()))


def with_reading(samples, reading):
    return REPLACE(samples, columns={"reading": reading})


def flipped(samples, joint):
    return moved(samples, lambda q: q * np.where(np.arange(6) == joint - 1, -1, 1))


def relabelled(samples):
    labels = list(samples.labels["plane"])
    for i, label in ((0, "wall"), (3, "wall"), (6, "wall"), (1, "floor"), (4, "floor")):
        labels[i] = label
    return REPLACE(samples, labels={"plane": tuple(labels)})


def with_outliers(samples):
    reading = samples.columns["reading"].copy()
    reading[7] += 0.83
    reading[50] -= 0.37
    return with_reading(samples, reading)


def with_a_lost_turn(samples):
    reading = samples.columns["reading"].copy()
    reading[7] += 1.0
    return with_reading(samples, reading)


def beyond_travel(samples):
    reading = samples.columns["reading"].copy()
    reading[[7, 50]] = 11.0, -2.0
    return with_reading(samples, reading)


def in_cell(**changes):
    def make(hsr, samples):
        return simulate(hsr.problem, REPLACE(hsr.cell, **changes), seed=3).samples

    return make


def small_faces(hsr, samples):
    return in_cell(faces=tuple(REPLACE(face, size=(20.0, 20.0)) for face in hsr.cell.faces))(hsr, samples)


def wrong_sign(hsr, samples):
    turned = Problem(hsr.problem.robot, REPLACE(hsr.problem.instruments[0], sign=-1))
    return simulate(turned, hsr.cell, seed=3).samples


# how it is planted, what it must be called, whether it makes a result wrong, and the lines it must name
PLANTED = {
    "wrong dial sign": (wrong_sign, "wrong dial sign", True, ()),
    "degrees as radians": (lambda _, s: moved(s, np.degrees), "unit of the joints", True, ()),
    "radians as degrees": (lambda _, s: moved(s, np.radians), "unit of the joints", True, ()),
    "readings in inches": (lambda _, s: with_reading(s, s.columns["reading"] / 25.4), "unit of the readings", True, ()),
    "readings in cm": (lambda _, s: with_reading(s, s.columns["reading"] / 10), "unit of the readings", True, ()),
    "readings a row early": (lambda _, s: with_reading(s, np.roll(s.columns["reading"], -1)), "readings one row off",
                             True, ()),
    "readings a row late": (lambda _, s: with_reading(s, np.roll(s.columns["reading"], 1)), "readings one row off",
                            True, ()),
    "joints 2 and 3 swapped": (lambda _, s: moved(s, lambda q: q[:, [0, 2, 1, 3, 4, 5]]), "joints 2 and 3 swapped",
                               True, ()),
    "joint 2 flipped": (lambda _, s: flipped(s, 2), "joint 2 flipped", True, ()),
    "joint 4 flipped": (lambda _, s: flipped(s, 4), "joint 4 flipped", True, ()),
    "three repeated rows": (lambda _, s: s.take([*range(120), 3, 4, 5]), "repeated rows", False, (121, 122, 123)),
    "two gross outliers": (lambda _, s: with_outliers(s), "outliers", True, (8, 51)),
    "a lost revolution": (lambda _, s: with_a_lost_turn(s), "lost revolution", True, (8,)),
    "readings outside travel": (lambda _, s: beyond_travel(s), "readings outside travel", True, (8, 51)),
    "tilts below 2 degrees": (in_cell(tilt=math.radians(2)), "tilt too small", False, ()),
    "faces of 20 mm": (small_faces, "faces too small", False, ()),
    "joints rounded": (lambda _, s: moved(s, lambda q: np.radians(np.round(np.degrees(q), 1))), "joints rounded",
                       True, ()),
    "labels exchanged": (lambda _, s: relabelled(s), "labels exchanged", True, (1, 2, 4, 5, 7)),
}  # fmt: skip
NAMED_BY_THE_VERDICT = {
    *("radians as degrees", "readings in inches", "readings in cm", "readings a row late", "joints 2 and 3 swapped"),
    *("joint 4 flipped", "joints rounded"),
}
"""Faults of all rows that the command has no words of its own for; test_verdict.py has `calibrate` name every error."""


@pytest.mark.long_unless(
    "wrong dial sign",
    "joint 2 flipped",
    "three repeated rows",
    "two gross outliers",
    "a lost revolution",
    "readings a row early",
    "readings outside travel",
    "tilts below 2 degrees",
    "labels exchanged",
)
@pytest.mark.parametrize("name", sorted(PLANTED.keys() - NAMED_BY_THE_VERDICT))
def test_planted_faults_are_named(hsr, corner_simulation, name, tmp_path, capsys):
    plant, about, wrong, lines = PLANTED[name]
    samples = plant(hsr, corner_simulation.samples)
    file = tmp_path / "planted.csv"
    write_samples(file, hsr.problem.layout(), samples, ["planted"])
    if name == "degrees as radians":
        file.unlink()
        write_samples(file, hsr.problem.layout(), corner_simulation.samples, ["planted"])
        file.write_text(file.read_text().replace("_deg", "_rad"))
    code = main(["check", str(hsr.path), str(file)])
    out = capsys.readouterr().out
    named = [line for line in out.splitlines() if re.match(rf"(error|warning): {about}( \(|:)", line)]
    assert named, out
    assert code == (1 if wrong else 0)
    assert name != "wrong dial sign" or "with the arm as drawn the residuals already" in out, "seen before any fit"
    if lines:
        found = {int(n) for line in named for n in re.findall(r"\d+", re.search(r"\(lines? ([^)]*)\)", line)[1])}
        assert found == {line + 2 for line in lines}  # a comment and the header stand above


def test_rows_that_were_pasted_again_count_once(hsr, corner_simulation):
    """Counted twice, they look surer than they are: noise then passes for an error that neighbours share."""
    once, rows = corner_simulation.samples, len(corner_simulation.samples)
    alone, pasted = check(hsr.problem, once), check(hsr.problem, once.take([*range(rows)] * 4))
    assert [each.about for each in pasted if each.lines] == ["repeated rows"]
    assert [each for each in pasted if not each.lines] == [each for each in alone if not each.lines]


@pytest.mark.long_unless("two gross outliers")
@pytest.mark.parametrize(
    "name",
    ["joint 2 flipped", "two gross outliers", "tilts below 2 degrees", "labels exchanged", "clean"],
)
def test_many_rows_are_judged_as_few_are(hsr, corner_simulation, name, monkeypatch):
    """Large sets are looked at in parts and by drawn rows: here with limits that a small set exceeds."""
    plant = PLANTED[name][0] if name in PLANTED else lambda _, samples: samples
    samples = plant(hsr, corner_simulation.samples)
    expected = check(hsr.problem, samples)
    monkeypatch.setattr(sys.modules["casacal.calibration.check"], "SPREAD", 90)
    monkeypatch.setattr("casacal.uncertainty.figures.TOGETHER", 25)
    monkeypatch.setattr("casacal.calibration.set_aside.JUDGES", 30)
    found = check(hsr.problem, samples)
    assert [(each.severity, each.about, each.lines) for each in found] == [
        (each.severity, each.about, each.lines) for each in expected
    ]


def test_leverages_by_parts_are_those_of_the_whole(hsr, corner_simulation, monkeypatch):
    monkeypatch.setattr("casacal.uncertainty.figures.TOGETHER", 25)
    bound = bind(hsr.problem, corner_simulation.samples)
    result = lm(bound)
    stacked = np.vstack([bound.jacobian(result.x) * bound.start_std, np.diag(bound.start_std / bound.prior_std)])
    basis, _ = np.linalg.qr(stacked)
    expected = (basis[: bound.rows] ** 2).sum(axis=1)
    np.testing.assert_allclose(leverages(bound, result), expected, rtol=1e-9)
    alike = np.abs(bound.residual(result.x)) / np.sqrt(1 - expected)  # Cook and Weisberg: of the same spread
    assert studentised_outliers(bound, result).scale == pytest.approx(1.4826 * np.median(alike), rel=1e-9)


@pytest.mark.long_unless("0", "4")
@pytest.mark.parametrize("seed", range(5))
def test_clean_corners_raise_nothing_above_a_remark(hsr, seed):
    findings = check(hsr.problem, simulate(hsr.problem, hsr.cell, seed=seed).samples)
    assert [finding for finding in findings if finding.severity != "remark"] == []


@pytest.mark.parametrize("seed", [10, 12])
def test_nine_rows_of_a_face_are_not_called_outliers_for_being_few(seed):
    """A plane through three of nine tips passes near five of them by chance; the drawn arm's faces fit them all."""
    scara = load_problem(ROOT / "problems" / "adept_cobra600")
    samples = simulate(scara.problem, scara.cell, samples=27, seed=seed).samples
    assert [finding for finding in check(scara.problem, samples) if finding.severity == "error"] == []


@pytest.mark.long
def test_a_flipped_joint_ends_with_the_line_to_paste(hsr, corner_simulation):
    samples = corner_simulation.samples
    (found,) = (each for each in check(hsr.problem, flipped(samples, 4)) if each.severity == "error")
    assert "with its limits: conventions=Conventions(signs=(1, 1, 1, -1, 1, 1))." in str(found)
    pasted = eval(found.fix.partition("conventions=")[2], {"Conventions": Conventions, "deg": deg})
    assert np.allclose(pasted.to_model(flipped(samples, 4).joints), samples.joints)


@pytest.mark.long
def test_what_cannot_be_told_is_said(hsr, corner_simulation):
    constant = with_reading(corner_simulation.samples, np.full(120, 5.0))
    assert any(finding.about == "dial sign not tested" for finding in check(hsr.problem, constant))
    # an exact arm with its tip on the last axis looks the same whichever way joint 6 turns
    contact = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.05, reading=False))
    exact = simulate(contact, REPLACE(hsr.cell, error_scale=0.0), seed=1).samples
    assert any(finding.about == "joint 6 flipped?" for finding in check(contact, exact))


def test_noise_that_is_not_as_stated_is_a_warning(hsr):
    noisy = simulate(hsr.problem, REPLACE(hsr.cell, repeatability=0.016), seed=2).samples
    assert [f.about for f in check(hsr.problem, noisy) if f.severity == "warning"] == ["noise"]


def test_few_rows_and_parallel_faces_are_warned_about(hsr):
    one = REPLACE(hsr.cell, faces=hsr.cell.faces[:1])
    findings = {f.about: f.severity for f in check(hsr.problem, simulate(hsr.problem, one, samples=40, seed=1).samples)}
    assert findings["few rows"] == "warning"
    assert findings["faces nearly parallel"] == "warning"


@pytest.mark.long
def test_unexplained_misfit_is_an_error(hsr):
    bent = simulate(hsr.problem, REPLACE(hsr.cell, joint_std=1e-3), seed=1).samples
    assert "misfit" in {f.about for f in check(hsr.problem, bent) if f.severity == "error"}


def labelled(samples, changes):
    """With other labels in some rows, counted from 0."""
    labels = list(samples.labels["plane"])
    for rows, label in changes.items():
        for i in rows:
            labels[i] = label
    return REPLACE(samples, labels={"plane": Labels.of(labels)})


def rows_of(samples, label, count):
    return tuple(i for i, each in enumerate(samples.labels["plane"]) if each == label)[:count]


@pytest.mark.long_unless(
    "wall-wal-1-labels alike",
    "wall-walll-2-labels alike",
    "floor-flour-3-labels alike",
    "wall-Wall-15-labels alike",
    "wall-table-3-rare label",
)
@pytest.mark.parametrize(
    ("label", "slip", "count", "about"),
    [
        ("wall", "wal", 1, "labels alike"),
        ("wall", "walll", 2, "labels alike"),
        ("floor", "flour", 3, "labels alike"),
        ("wall", "Wall", 15, "labels alike"),
        ("wall", "w all", 6, "labels alike"),
        ("wall", "table", 3, "rare label"),
        ("wall", "table", 4, "rare label"),
    ],
)
def test_odd_labels_are_named_with_their_lines(hsr, corner_simulation, label, slip, count, about):
    rows = rows_of(corner_simulation.samples, label, count)
    samples = labelled(corner_simulation.samples, {rows: slip})
    (finding,) = (f for f in check(hsr.problem, samples) if f.about in ("labels alike", "rare label"))
    assert (finding.severity, finding.about) == ("warning", about)
    assert finding.lines == tuple(samples.lines[i] for i in rows)
    assert f"'{slip}'" in finding.cause
    assert f"'{label}'" in finding.fix


@pytest.mark.long_unless("face1, face2, face3")
@pytest.mark.parametrize(
    "names",
    [("face1", "face2", "face3"), ("side A", "side B", "side C"), ("a", "b", "c"), ("top", "tip", "tap")],
    ids=", ".join,
)
def test_labels_that_are_only_named_in_a_row_are_not_odd(hsr, corner_simulation, names):
    samples = corner_simulation.samples
    by_name = dict(zip(samples.labels["plane"].names, names, strict=True))
    renamed = REPLACE(samples, labels={"plane": Labels.of([by_name[each] for each in samples.labels["plane"]])})
    assert not [f for f in check(hsr.problem, renamed) if "label" in f.about]


def test_a_step_may_have_few_rows_of_the_plane_it_stands_on(hsr, corner_simulation):
    rows = rows_of(corner_simulation.samples, "floor", 3)
    samples = labelled(corner_simulation.samples, {rows: "block"})
    dial = REPLACE(hsr.problem.instruments[0], steps={"block": Step(on="floor", height=100.0)})
    assert not odd_labels(Problem(hsr.problem.robot, dial), samples)
    assert odd_labels(hsr.problem, samples)
    certified = DialOnBody(noise_std=0.01, normals={"floor": (0, 0, 1), "wall": (-1, 0, 0), "side": (0, -1, 0)})
    assert not odd_labels(Problem(hsr.problem.robot, certified), corner_simulation.samples)


def test_an_odd_label_is_named_where_binding_fails(hsr, corner_simulation):
    (row,) = rows_of(corner_simulation.samples, "wall", 1)
    refused, named = check(hsr.problem, labelled(corner_simulation.samples, {(row,): "wal"}))
    assert (refused.severity, refused.about) == ("error", "cannot be bound")
    assert (named.about, named.lines) == ("labels alike", (corner_simulation.samples.lines[row],))


@pytest.mark.long
def test_what_check_advises_on_outliers_works(hsr, corner_simulation, tmp_path, capsys):
    file = tmp_path / "spoiled.csv"
    write_samples(file, hsr.problem.layout(), with_outliers(corner_simulation.samples), [])
    assert main(["check", str(hsr.path), str(file)]) == 1
    assert "calibrate leaves them out" in capsys.readouterr().out
    assert main(["calibrate", str(hsr.path), str(file)]) == 0
    assert "lines 9, 52" in capsys.readouterr().out
    assert main(["calibrate", str(hsr.path), str(file), "--keep-outliers"]) == 1
    assert main(["calibrate", str(hsr.path), str(file), "--loss", "huber"]) == 0


@pytest.mark.parametrize(
    ("low", "high", "travel", "says", "not_said"),
    [
        (-0.12, 7.84, 7.0, ["set to zero within its travel", "--set travel=-1:8)"], "minus"),
        (-4.6, 4.2, 10.0, ["set to zero within its travel", "--set travel=-5:5)"], "minus"),
        (-7.84, -0.12, 10.0, ["--set travel=-8:0)", "sign of the column is reversed", "without the minus"], "add"),
        (0.0, 12.3, 10.0, ["--set travel=13"], "minus"),
        (-6.0, 7.2, (-5.0, 5.0), ["--set travel=-6:8)"], "minus"),
        (-4.0, 7.2, (-5.0, 5.0), ["--set travel=-5:8)"], "minus"),
    ],
)
def test_what_is_advised_on_readings_outside_travel_brings_them_inside(
    hsr, corner_simulation, low, high, travel, says, not_said
):
    """What is advised, followed to the letter, ends the error."""
    samples = corner_simulation.samples
    reading = np.linspace(low, high, len(samples))
    problem = hsr.problem.with_settings({"travel": travel})
    (finding,) = outside(problem, with_reading(samples, reading))
    assert all(words in finding.fix for words in says)
    assert not_said not in finding.fix
    if "minus" in finding.fix:
        assert not [*outside(problem, with_reading(samples, -reading))]
    found = re.search(r"--set travel=([-\d:]+)", finding.fix)
    problem = problem.with_settings({"travel": number_or_range(found[1])})
    assert not [*outside(problem, with_reading(samples, reading))]


@pytest.mark.parametrize("count", [1, 3])
def test_one_row_with_the_joints_of_another_may_be_that(hsr, corner_simulation, count):
    samples = corner_simulation.samples
    joints, reading = samples.joints.copy(), samples.columns["reading"].copy()
    floor, wall = (list(rows_of(samples, label, count)) for label in ("floor", "wall"))
    joints[floor], reading[floor] = joints[wall], reading[wall]
    found = check(hsr.problem, with_reading(moved(samples, lambda _: joints), reading))
    (finding,) = (finding for finding in found if finding.about == "labels exchanged")
    assert ("or the joints, if they are another row's" in finding.fix) == (count == 1)


def test_numbers_in_findings_agree_with_their_nouns(hsr, corner_simulation):
    samples = corner_simulation.samples
    one = check(hsr.problem, samples.take([*range(120), 3]))
    assert any(f.cause.startswith("1 row with the same joints") for f in one)
    single = check(hsr.problem, in_cell(faces=hsr.cell.faces[:1])(hsr, samples))
    assert any(f.cause == "there is only one face" for f in single)
    for finding in (*one, *single):
        assert not re.search(r"\b1 \w+s\b", str(finding)), finding


@pytest.mark.parametrize(
    ("folder", "silent"), [("ur5", "faces too small"), ("adept_cobra600", "no length was measured")]
)
def test_a_known_step_and_a_ruler_are_no_faults(folder, silent):
    """A step is small and gives a length; on certified angles a sliding joint measures one."""
    source = load_problem(ROOT / "problems" / folder)
    assert silent not in {finding.about for finding in check(source.problem, source.problem.read(source.samples))}


@pytest.mark.parametrize(
    ("slope", "std", "wrong"),
    [
        *[(1.96, 0.18, True), (1.78, 0.24, True), (2.4, 0.2, True)],
        *[(1.0, 0.11, False), (1.2, 0.23, False), (0.3, 0.1, False), (0.0, 0.1, False), (1.9, 0.5, False)],
    ],
)
def test_only_a_slope_of_two_tells_a_wrong_sign(slope, std, wrong):
    """Slopes about one were measured on right signs: arms far from their drawing, driven by it."""
    assert tells_a_wrong_sign(slope, std) is wrong


def test_unknowns_of_effects_need_no_rows_of_their_own(hsr):
    samples = simulate(hsr.problem, hsr.cell, samples=60, seed=1).samples
    assert all("few rows" not in f.about for f in check(with_kit(hsr.problem), samples))
