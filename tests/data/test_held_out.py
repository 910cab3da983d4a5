"""What a fit has not seen: rows, regions, faces and sessions held out, and each face predicted by the others."""

import dataclasses
import json

import numpy as np
import pytest
from conftest import ROOT

from casacal import CasacalError, calibrate, simulate, verify
from casacal.calibration.summary import summary
from casacal.cli.main import main
from casacal.data.columns import Labels
from casacal.data.holdout import split
from casacal.data.samples import Samples
from casacal.errors import UnknownNameError
from casacal.kernels.losses import huber


@pytest.fixture(scope="module")
def rows(corner_simulation):
    """Samples of three faces in four sessions."""
    samples = corner_simulation.samples
    return dataclasses.replace(samples, extra={"session": tuple(f"day {k // 30}" for k in range(len(samples)))})


def quick(hsr, samples, **options):
    return calibrate(hsr, samples, method="lm", reference=False, noise="stated", discrepancy="none", **options)


# ------------------------------------------------------------------------------------------------ what is held out


def test_whole_groups_are_held_out(rows):
    for by, values in (
        ("face", rows.labels["plane"]),
        ("plane", rows.labels["plane"]),
        ("session", rows.extra["session"]),
    ):
        fitted, held = split(rows, 0.5, 3, by, "plane")
        assert sorted([*fitted, *held]) == list(range(len(rows)))
        one, two = ({values[k] for k in part} for part in (fitted, held))
        assert not one & two
        assert len(two) == 2  # of three faces, of four sessions
        np.testing.assert_array_equal(split(rows, 0.5, 3, by, "plane")[1], held)
    assert any(split(rows, 0.3, 4, "session")[1][0] != split(rows, 0.3, seed, "session")[1][0] for seed in range(8))
    assert len(split(rows, 0.01, 0, "session")[1]) == 30  # one, where a part of one was asked for
    assert len(split(rows, 0.0, 0, "session")[1]) == 0


def test_a_region_is_the_nearest_postures_of_each_face(rows):
    fitted, held = split(rows, 0.25, 7, "region")
    faces = np.array(rows.labels["plane"])
    for face in ("floor", "wall", "side"):
        there = np.flatnonzero(faces == face)
        inside, outside = np.intersect1d(there, held), np.intersect1d(there, fitted)
        assert (len(inside), len(outside)) == (10, 30)
        scaled = rows.joints / rows.joints[there].std(axis=0)
        far = np.linalg.norm(scaled[:, None] - scaled[None], axis=2)
        # one of them has the other nine nearest to it
        assert any(far[k, inside].max() < far[k, outside].min() for k in inside)


def test_what_cannot_be_held_out(rows, hsr):
    for arguments, says in (
        ((rows, 0.9, 0, "face", "plane"), "leaves nothing to fit"),
        ((rows, 0.5, 0, "face", None), "these samples name none"),
        ((rows, 0.5, 0, 3), "Got an int as what is held out together"),
        ((rows, 1.0, 0, "face", "plane"), "from 0 to below 1"),
    ):
        with pytest.raises(CasacalError, match=says):
            split(*arguments)
    with pytest.raises(UnknownNameError, match="Did you mean 'session'"):
        quick(hsr, rows, holdout=0.5, holdout_by="sesion")


def test_a_held_out_face_stands_where_its_own_rows_say(rows, hsr, tmp_path):
    found = quick(hsr, rows, holdout=0.34, holdout_by="face", seed=1)
    held = found.heldout.block.samples
    (label,) = set(held.labels["plane"])
    assert f"plane.{label}.offset" not in found.fit.names
    assert found.x.size == len(found.fit.names) == found.fit.unknowns
    # the plane that fits the tips best, each row by its noise: a weighted total least squares
    for when, nominal in (("before", True), ("after", False)):
        tips = found.predict(held, frame="tip", nominal=nominal).positions
        weight = 1 / found.heldout.block.noise.ravel()
        middle = (tips * weight[:, None] ** 2).sum(axis=0) / (weight**2).sum()
        normal = np.linalg.svd((tips - middle) * weight[:, None])[2][2]
        size = np.sqrt((((tips - middle) @ normal) ** 2).mean())
        assert found.metrics[when]["heldout"]["rmse_mm"] == pytest.approx(size, rel=1e-5)
    assert found.metrics["after"]["heldout"]["rmse_mm"] < 0.2 * found.metrics["before"]["heldout"]["rmse_mm"]
    document = found.to_dict()
    assert document["data"]["heldout_by"] == "face"
    assert label not in document["planes"]
    assert "40 held out by face" in summary(found, "hsr")
    page = found.report(tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Each face predicted by the others" in page
    assert "held out by face to judge the fit" in page


def test_the_command_holds_out_sessions(tmp_path, capsys):
    lines = (ROOT / "problems" / "hsr_jr680" / "samples.csv").read_text(encoding="utf-8").splitlines()
    lines = [line for line in lines if not line.startswith("#")]
    table = [f"{lines[0]},session", *(f"{line},{k // 30}" for k, line in enumerate(lines[1:]))]
    (tmp_path / "s.csv").write_text("\n".join(table) + "\n", encoding="utf-8")
    arguments = ["calibrate", str(ROOT / "problems" / "hsr_jr680"), str(tmp_path / "s.csv"), "--no-reference"]
    assert main([*arguments, "--holdout", "0.25", "--holdout-by", "session", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["data"]["heldout"], document["data"]["heldout_by"]) == (30, "session")
    assert [face["face"] for face in document["leave_one_face_out"]] == ["floor", "wall", "side"]
    assert main([*arguments, "--holdout-by", "face"]) == 2
    assert "without --holdout" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------ each face by the others


def test_a_face_left_out_is_a_face_verified(rows, hsr):
    """The same by another way: calibrate from the other faces, and verify by this one."""
    faces = np.array(rows.labels["plane"])
    found = {one.face: one for one in quick(hsr, rows).left_out}
    for face in ("floor", "side"):
        others, alone = (
            dataclasses.replace(rows.take(np.flatnonzero(each)), sha256=str(k))
            for k, each in enumerate((faces != face, faces == face))
        )
        judged, one = verify(quick(hsr, others), alone), found[face]
        assert (one.rows, one.freedom) == (judged.judged.rows, judged.freedom) == (40, 37)
        assert one.chi_square == pytest.approx(judged.chi_square, rel=0.02)
        assert one.actual_mm == pytest.approx(judged.after_mm, rel=0.02)
        assert one.predicted_mm == pytest.approx(judged.predicted_mm, rel=0.02)
        assert one.p == pytest.approx(judged.p, abs=0.02)
        assert one.ratio == one.actual_mm / one.predicted_mm


def test_a_model_that_misses_something_predicts_faces_badly(hsr):
    bent = simulate(hsr.problem, dataclasses.replace(hsr.cell, compliance=1.5), seed=2)
    worst = min(one.p for one in quick(hsr, bent.samples).left_out)
    well = min(one.p for one in quick(hsr, simulate(hsr.problem, hsr.cell, seed=2).samples).left_out)
    assert worst < 1e-6 < 1e-3 < well


def test_nothing_is_said_where_nothing_can_be(hsr, rows):
    one = quick(hsr, rows.take(np.flatnonzero(np.array(rows.labels["plane"]) == "floor")))
    assert one.left_out == ()
    assert one.to_dict()["leave_one_face_out"] == []
    assert "each face by the others" not in summary(one, "hsr")
    few = np.concatenate(
        [np.flatnonzero(np.array(rows.labels["plane"]) == f)[:n] for f, n in (("floor", 40), ("wall", 4))]
    )
    lone = quick(hsr, rows.take(few), holdout=0.0)
    assert {face.face: face.freedom for face in lone.left_out} == {"floor": 37, "wall": 1}


def test_rows_that_a_loss_ignored_do_not_count(hsr, rows):
    reading = rows.columns["reading"].copy()
    reading[9] += 2.0
    spoiled = dataclasses.replace(rows, columns={"reading": reading})
    face = rows.labels["plane"][9]
    plain = {one.face: one for one in quick(hsr, spoiled, outliers="keep").left_out}[face]
    robust = {one.face: one for one in quick(hsr, spoiled, loss=huber()).left_out}[face]
    assert plain.p < 1e-6
    assert robust.p > 1e-3
    assert robust.freedom == plain.freedom - 1


def test_the_part_that_was_asked_for_is_held_out_of_many_small_faces():
    """Rounding each of them by itself held nothing out, or twice too much; each keeps a row to fit."""
    labels = Labels.of([f"face {k // 5}" for k in range(120)])
    joints = np.random.default_rng(1).normal(size=(120, 2))
    samples = dataclasses.replace(Samples.of_joints(joints), labels={"plane": labels})
    for part in (0.02, 0.1, 0.3, 0.5, 0.7, 0.78):
        for by in ("rows", "region"):
            fitted, held = split(samples, part, 3, by)
            assert abs(len(held) - part * 120) <= 1, (part, by)
            counts = np.bincount(labels.codes[held], minlength=24)
            assert set(np.bincount(labels.codes[fitted], minlength=24)) <= {1, 2, 3, 4, 5}
            assert np.ptp(counts) <= 1, "no face gives much more than its part"
    single = dataclasses.replace(samples, labels={"plane": Labels.of(map(str, range(120)))})
    for one, part in ((single, 0.3), (samples.take(range(3)), 0.1)):
        with pytest.raises(CasacalError, match="holds none out"):
            split(one, part, 0)
    with pytest.raises(CasacalError, match="leaves no row"):
        split(samples, 0.95, 0)
