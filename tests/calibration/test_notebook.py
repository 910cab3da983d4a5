"""Work at a prompt: a calibration's figures, frames and pictures are those of result.json and of the library."""

import dataclasses

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from casacal import calibrate, plan, simulate, verify
from casacal.calibration.calibrated import Calibrated
from casacal.calibration.result_json import calibration_document


@pytest.fixture(scope="module")
def found(hsr):
    return calibrate(hsr.problem, hsr.problem.read(hsr.samples), holdout=0.2, seed=1)


def test_names_are_scipys(found):
    assert isinstance(found, Calibrated)
    np.testing.assert_array_equal(found.x, found.result.x)
    assert found.success
    assert found.result.success
    assert found.message == found.result.status.value
    assert found.cost == pytest.approx(found.fit.cost(found.x))
    assert (found.nfev, found.njev) == (found.result.residual_rows // 96, found.result.jacobian_rows // 96)


def test_parameters_are_a_frame_of_what_result_json_holds(found, hsr):
    rows = {row["name"]: row for row in calibration_document(found, hsr)["parameters"]}
    table = found.parameters
    assert list(table.index) == list(rows)
    for name, row in table.iterrows():
        assert row["estimate"] == rows[name]["estimate"]
        assert row["std"] == rows[name]["std"]
        assert row["known_from"] == rows[name]["known_from"]
        assert row["change"] == pytest.approx(row["estimate"] - row["nominal"])
    assert set(table.loc["a3", ["unit", "nominal"]]) == {"mm", -206.14449}


def test_what_is_shown_says_what_it_is(found):
    before, now = found.tip_std
    assert f"apart from the pose of the base: {now:.3g} mm RMS (before: {before:.3g} mm)" in found.summary()
    assert "HSR-JR680 by sckf-lm: 120 samples" in repr(found)
    assert "mm RMS, calibrated>" in repr(found)
    denied = dataclasses.replace(found, method="plane-only", result=found.before)
    assert repr(denied).endswith("120 samples, do not use>")
    page = found._repr_html_()
    assert page.count("<tr") == len(found.parameters) + 2
    assert "<casacal" not in page


def test_pictures_take_an_axes_or_make_one(found):
    for name in ("plot_residuals", "plot_convergence", "plot_tip_std"):
        axes = Figure().subplots()
        assert getattr(found, name)(axes) is axes
        assert axes.get_title() or axes.get_title(loc="right")
    with mpl.rc_context({"backend": "agg"}):
        import matplotlib.pyplot as plt

        made = found.plot_tip_std()
        spread = made.collections[0].get_array()
        plt.close(made.figure)
    _, now = found.tip_std
    assert np.sqrt(np.mean(np.asarray(spread) ** 2)) == pytest.approx(now, rel=1e-9)


def test_values_show_themselves_as_tables(hsr):
    problem = hsr.problem
    samples = problem.read(hsr.samples)
    shown = problem.with_prior({"a2": 0.2})._repr_html_()
    assert "<td>a2</td><td>mm</td><td>0.2</td>" in shown
    assert shown.count("<tr>") == 1 + 24 + 3  # the arm, and a plane whose prior is flat
    assert "<td>a3</td><td>mm</td><td>0.7</td>" in shown
    assert shown.count("<td>flat</td>") == 3
    rows = samples._repr_html_()
    assert rows.count("<tr>") == 1 + 10
    assert f"<td>{samples.joints[0, 0]:.5g}</td>" in rows
    assert f"<td>{samples.labels['plane'][0]}</td>" in rows
    route = plan(problem, hsr.cell, touches=12, pool=60, seed=0)
    assert f"<td>{route.curve[min(route.curve)]:.3g}</td>" in route._repr_html_()
    named = dataclasses.replace(samples, file="<b>.csv", labels={"plane": ["<i>"] * len(samples)})
    assert "<b>" not in named._repr_html_()
    assert "<i>" not in named._repr_html_()


def test_a_verification_shows_what_it_says(found, hsr):
    judged = verify(found, simulate(hsr.problem, hsr.cell, samples=30, seed=5).samples)
    shown = judged._repr_html_()
    assert shown.startswith("<p>Promise")
    assert shown.count("<p>") == len(judged.summary(whole=False).splitlines())
