"""What a calibration found as a value: the same fresh and read back, with types, and cheap to ask."""

import dataclasses
import json
import math
import pickle

import numpy as np
import pytest

from casacal import calibrate, load
from casacal.deployment.document import result_of
from casacal.deployment.result import CalibrationResult, FaceNoise, Verdict


@pytest.fixture(scope="module")
def made(hsr, corner_simulation, tmp_path_factory):
    found = calibrate(hsr, corner_simulation.samples, reference=False)
    folder = tmp_path_factory.mktemp("made")
    found.save(folder)
    return found, folder


def test_a_fresh_result_and_the_one_that_is_read_back_are_the_same_value(made):
    found, folder = made
    fresh, read = found.arm.found, load(folder).arm.found
    for field in dataclasses.fields(CalibrationResult):
        if field.name not in ("effects", "data", "covariance"):
            assert getattr(fresh, field.name) == getattr(read, field.name), field.name
    np.testing.assert_allclose(fresh.covariance, read.covariance, rtol=1e-12)
    np.testing.assert_allclose(fresh.effects.covariance, read.effects.covariance, rtol=1e-12)
    assert (fresh.data.sha256, fresh.data.fitted_rows) == (read.data.sha256, read.data.fitted_rows)
    assert fresh.effects.corrected == read.effects.corrected == found.corrected


def test_it_says_what_the_file_says(made):
    found, folder = made
    document, value = json.loads((folder / "result.json").read_text()), load(folder).arm.found
    assert value.verdict == Verdict(**{**document["verdict"], "reasons": tuple(document["verdict"]["reasons"])})
    assert [row.name for row in value.parameters] == [row["name"] for row in document["parameters"]]
    for row, said in zip(value.parameters, document["parameters"], strict=True):
        assert (row.nominal, row.estimate, row.known_from) == (said["nominal"], said["estimate"], said["known_from"])
        assert row.change == said["estimate"] - said["nominal"]
        assert math.isnan(row.std) if said["std"] is None else row.std == said["std"]
    assert value.tip.expected_mm == document["tip"]["expected_rms_mm"] == pytest.approx(found.tip_std[1])
    assert value.tip.flange_prior_mm == document["tip"]["flange_prior_rms_mm"]
    assert value.tip.prior_mm == document["tip"]["prior_rms_mm"] == pytest.approx(found.tip_std[0])
    assert value.tip.flange_expected_mm == document["tip"]["flange_expected_rms_mm"]
    assert value.noise.by_face["floor"].used_mm == document["noise"]["by_face"]["floor"]["used_mm"]
    assert value.unknowns == {row["name"]: row["value"] for row in document["unknowns"]}
    assert set(value.planes) == set(document["planes"])
    faces = {
        "a": {"stated_mm": 0.01, "used_mm": 0.03, "without_joints_mm": 0.02},
        "b": {"stated_mm": 1.0, "used_mm": 2.0},
    }
    noisy = result_of({**document, "noise": {"ratio": 2.0, "low": 1.5, "high": 2.5, "by_face": faces}}).noise
    assert (noisy.ratio, noisy.low, noisy.high, noisy.joints_rad) == (2.0, 1.5, 2.5, 0.0)
    assert noisy.by_face == {"a": FaceNoise(0.01, 0.03, 0.02), "b": FaceNoise(1.0, 2.0, 2.0)}
    null = {**document, "tip": None, "covariance": None, "verdict": {**document["verdict"], "level": "do not use"}}
    denied = result_of(null)
    assert math.isnan(denied.tip.expected_mm)
    assert denied.covariance is None
    assert denied.verdict.level == "do not use"


def test_it_is_frozen_and_travels(made):
    value = made[0].arm.found
    again = pickle.loads(pickle.dumps(value))
    assert again == value
    assert dataclasses.replace(value, method="lm") != value
    with pytest.raises(dataclasses.FrozenInstanceError):
        value.method = "lm"
    with pytest.raises(ValueError, match="read-only"):
        value.covariance[0, 0] = 1.0
    with pytest.raises(TypeError):
        value.unknowns["a1"] = 0.0


def test_values_are_those_of_the_arm_and_without_corrections_those_of_one_that_nobody_corrects(made):
    value = made[0].arm.found
    known = value.values(alone=False)
    assert known["a1"] == next(row.change for row in value.parameters if row.name == "a1")
    less = dict.fromkeys(("a1", "theta2"), 0.5)
    effects = dataclasses.replace(
        value.effects, without_corrections=less, corrected=("give",), values={"give": 2.0, "play": 3.0},
        of={"give": "give", "play": "play"},
    )  # fmt: skip
    other = dataclasses.replace(value, effects=effects)
    assert other.values(alone=True) == {**known, **less}
    assert other.values(alone=False) == known
    assert other.of_effects == {"give": 2.0}


def test_asking_where_the_arm_is_works_out_nothing_that_only_a_report_shows(hsr, corner_simulation):
    found = calibrate(hsr, corner_simulation.samples, reference=False)
    found.predict(np.zeros(6))
    shown = {"left_out", "cures", "sensitivity", "effect_sizes", "identifiability", "metrics_by_instrument"}
    assert "left_out" not in vars(found.unjudged)
    assert "cures" not in vars(found.unjudged)
    assert not shown & set(found.arm.document)
    assert shown - {"sensitivity", "effect_sizes", "left_out", "metrics_by_instrument"} <= set(found.to_dict())
