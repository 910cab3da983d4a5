"""report.html: its numbers are those of result.json, it is valid, refers to nothing outside, and obeys no data."""

import base64
import gzip
import html
import json
import math
import re
import shlex
import shutil

import html5lib
import numpy as np
import pytest
from conftest import ROOT
from oracles import dh_chain
from page_reader import REFERENCES, Page, facts, tables

import casacal
from casacal import DialOnPlane, Plane, Problem, TrackedPoint, calibrate
from casacal.calibration.report import Workspace, report_page
from casacal.calibration.report_pictures import Touches
from casacal.calibration.result_json import calibration_document
from casacal.calibration.summary import parameters_table
from casacal.cli.main import main
from casacal.data.samples import Samples
from casacal.kernels.losses import huber
from casacal.pages.drawing import Panel, Scale, in_squares, nice_ceiling, tag, ticks
from casacal.pages.space import static

HSR = ROOT / "problems" / "hsr_jr680"
OPTIONS = ("--holdout", "0.25", "--seed", "1", "--box", "1000:1700,-400:400,400:1000")
DOTS = re.compile(r"M[\d.-]+ [\d.-]+h\.1")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "out"
    assert main(["calibrate", str(HSR), *OPTIONS, "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def page(written):
    return (written / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def document(written):
    return json.loads((written / "result.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def calibration(hsr):
    samples = hsr.problem.read(HSR / "samples.csv")
    return calibrate(hsr.problem, samples, method="lm", holdout=0.25, seed=1)


def test_the_share_of_the_prior_is_what_is_left_of_it(calibration):
    table, held = parameters_table(calibration)
    names = list(calibration.fit.names)
    for row in table.rows:
        j = names.index(row[0])
        left, prior = calibration.result.std[j], calibration.fit.prior_std[j]
        assert row[6] == f"{100 * left / prior:.0f} %"
    assert len(table.rows) + len(held) == len(list(calibration.fit.parameters()))


def of(calibration, source, **options):
    return report_page(calibration, calibration_document(calibration, source), **options)


FOLD = re.compile(r'<details id="space-fold">.*?</details>', re.S)
"""The picture in space, the one part of a page with script."""


def assert_valid(page):
    """By a validating parser, and by what it does not look at: nesting as written, ids, references."""
    html5lib.HTMLParser(strict=True).parse(page)
    page = FOLD.sub("", page)
    read = Page(page.partition("\n")[2])
    assert read.faults == []
    assert {name for name, *_ in read.elements} <= {
        *("html", "head", "meta", "title", "style", "body", "main", "header", "section", "h1", "h2", "h3", "p", "ul"),
        *("li", "div", "span", "strong", "code", "pre", "dl", "dt", "dd", "table", "caption", "thead", "tbody", "tr"),
        *("nav", "a", "th", "td", "figure", "figcaption", "svg", "desc", "path", "rect", "text"),
    }
    for name, attributes, _ in read.elements:
        assert not REFERENCES & set(attributes) or (name == "a" and attributes["href"].startswith("#")), name
        assert not [key for key in attributes if key.startswith("on")], name
    style = next(words for _, words in read.all("style"))
    assert "url(" not in style
    assert "@import" not in style
    assert "http:" not in page.replace("&", "")
    assert "https:" not in page
    assert not re.findall(r"\bnan\b|\binf\b", page)
    return read


@pytest.mark.long
def test_the_page_is_valid_and_refers_to_nothing(page):
    read = assert_valid(page)
    assert [attributes["lang"] for attributes, _ in read.all("html")] == ["en"]
    assert len(read.all("h1")) == 1
    assert len(read.all("svg")) == 2 + 2 + 2 + 3 + 4 + 3, "the cell, histograms, rows, faces, maps, keys"


def test_the_validator_finds_faults():
    for bad in ("<p><b></p>", '<p id="a"></p><p id="a"></p>', "<svg></svg>", '<p id="a" id="b"></p>'):
        assert Page(bad).faults


def test_opening_and_provenance_are_those_of_the_result(page, document, written):
    subject, made = facts(page, "subject"), facts(page, "provenance-facts")
    assert Page(page).all("h1")[0][1] == "HSR-JR680"
    assert subject["Problem"] == document["problem"]["name"]
    assert subject["Data"] == made["Data file"] == document["data"]["file"]
    assert subject["SHA-256 of the data"] == made["SHA-256 of the data"] == document["data"]["sha256"]
    assert made["SHA-256 of the problem"] == document["problem"]["sha256"]
    assert subject["Method"] == document["method"]
    assert subject["Status"] == document["status"]
    assert subject["Rows"] == "90 fitted, 30 held out"
    assert made["Versions"] == ", ".join(f"{name} {version}" for name, version in document["versions"].items())
    (command,) = (words for _, words in Page(page).all("pre"))
    assert shlex.split(command) == ["casacal", "calibrate", str(HSR), *OPTIONS, "--out", str(written)]


def test_the_verdict_gives_both_figures_and_says_which_is_not_accuracy(page, document):
    (sentence,) = Page(page).by_class("verdict")
    assert sentence == document["verdict"]["words"]
    assert sentence.startswith("Calibrated: expect")
    assert f"{document['tip']['expected_rms_mm']:.2g} mm RMS over the workspace" in sentence
    assert f"(before: {document['tip']['prior_rms_mm']:.1f} mm)" in sentence
    figures = Page(page).text_of("verdict")
    assert f"not accuracy{document['metrics']['after']['heldout']['rmse_mm']:.4f} mm" in figures.replace(" not", "not")
    assert "Nothing speaks against it." in figures


def test_tables_are_those_of_the_result(page, document):
    shown = tables(page)
    rows = iter(shown["residual-figures"][1:])
    for when in ("before", "after"):
        for part in ("fit", "heldout"):
            figures = document["metrics"][when][part]
            assert next(rows)[1:] == [f"{figures[key]:.4f}" for key in ("rmse_mm", "mae_mm", "std_mm", "max_mm")]
    free = [row for row in document["parameters"] if row["known_from"] != "held"]
    assert len(shown["parameter-table"]) == 1 + len(free)
    for row, cells in zip(free, shown["parameter-table"][1:], strict=True):
        factor = 180 / math.pi if row["unit"] == "rad" else 1.0
        assert cells[:2] == [row["name"], "deg" if row["unit"] == "rad" else "mm"]
        change = row["estimate"] - row["nominal"]
        for cell, value in zip(cells[2:6], (row["nominal"], row["estimate"], change, row["std"]), strict=True):
            assert float(cell) == pytest.approx(factor * value, abs=0.5001e-4)
        assert cells[7] == row["known_from"]
    tip = document["tip"]
    expected = [f"{tip[key]:.3f} mm" for key in ("prior_rms_mm", "expected_rms_mm", "without_prior_rms_mm")]
    assert [cells[1] for cells in shown["tip-figures"][1:4]] == expected
    assert [cells[:3] for cells in shown["faces"][1:]] == [[face, "40", "10"] for face in ("floor", "wall", "side")]
    for cells in shown["faces"][1:]:
        plane = document["planes"][cells[0]]
        np.testing.assert_allclose([float(v) for v in cells[6].split(",")], plane["normal"], atol=0.51e-5)
        np.testing.assert_allclose([float(v) for v in cells[7].split(",")], plane["point_mm"], atol=0.51e-2)


def test_what_the_data_cannot_tell_is_all_there(page, document):
    found = document["identifiability"]
    words = Page(page).text_of("unseen")
    assert f"{len(found['null'])} they do not see at all" in words
    rows = {cells[0]: cells for cells in tables(page)["directions"][1:]}
    for direction in (*found["null"], *found["weak"]):
        assert direction["words"] in words
        if direction["cure"] != "none needed":
            assert rows[direction["words"]][3].lower() == direction["cure"].lower()
    shown = tables(page)["cures"][1:]
    listed = [[cure["words"], f"{cure['expected_rms_mm']:.3f} mm"] for cure in document["cures"]]
    assert [cells[:2] for cells in shown] == [*listed, ["As it is", f"{document['tip']['expected_rms_mm']:.3f} mm"]]
    assert [cells[2] == "yes" for cells in shown[:-1]] == [cure["recommended"] for cure in document["cures"]]
    reference = facts(page, "reference-facts")
    assert float(reference["Cost, ipopt"]) == pytest.approx(document["reference"]["cost"], rel=1e-9)
    assert float(reference["Cost, sckf-lm"]) == pytest.approx(document["cost"], rel=1e-9)


@pytest.mark.long
def test_a_second_run_gives_the_same_bytes_but_for_timings(written, page):
    assert main(["calibrate", str(HSR), *OPTIONS, "--out", str(written)]) == 0
    again = (written / "report.html").read_text(encoding="utf-8")
    timings = re.compile(r'<p class="timings">[^<]*</p>')
    assert len(timings.findall(page)) == 1
    assert timings.sub("", again) == timings.sub("", page)


def test_every_row_is_drawn_and_stands_where_it_should(page, document):
    rows = page.split('<svg id="rows-after"')[1].partition("</svg>")[0]
    assert len(DOTS.findall(rows)) == 120
    faces = [page.split(f'<svg id="face-{k}"')[1].partition("</svg>")[0] for k in range(3)]
    assert [len(DOTS.findall(face)) for face in faces] == [40, 40, 40]
    largest = max(document["metrics"]["after"][part]["max_mm"] for part in ("fit", "heldout"))
    assert f"largest residual is {largest:.4f} mm" in "".join(faces)


def test_touches_lie_on_their_faces_at_their_residuals(calibration, hsr):
    planes = calibration_document(calibration, hsr)["planes"]
    touches = Touches.of(calibration)
    for label in ("floor", "wall", "side"):
        places, normal = touches.places(label), np.array(planes[label]["normal"])
        heights = (places.tips - planes[label]["point_mm"]) @ normal + off_axis(calibration, label, normal)
        np.testing.assert_allclose(heights, places.residuals, atol=1e-6)
        apart, flat = (np.linalg.norm(p[:, None] - p[None], axis=2) for p in (places.tips, places.uv))
        np.testing.assert_allclose(flat, apart, atol=0.05)
        along = places.tips[:, 2] if places.upright else places.tips[:, 0]
        shown = places.uv[:, 1] if places.upright else places.uv[:, 0]
        assert np.corrcoef(along, shown)[0, 1] > 0.9999
        assert places.tilts.max() < 30.5
    # seen from the tool, which stands at smaller x: y runs to the left on the wall
    wall = touches.places("wall")
    assert np.corrcoef(wall.tips[:, 1], wall.uv[:, 0])[0, 1] < -0.9999


def turned(calibration, label):
    """Flange poses (4x4) of the touches of a face, fitted and then held out, and their readings, by NumPy alone."""
    value = {name: nominal + (0 if j is None else calibration.result.x[j]) for name, _, nominal, j in
             calibration.fit.parameters()}  # fmt: skip
    table = {key: np.array([value[f"{key}{i}"] for i in range(1, 7)]) for key in ("alpha", "a", "d", "theta")}
    sets = [some.samples[0] for some in (calibration.fit, calibration.heldout) if some is not None]
    rows = [(some, k) for some in sets for k, each in enumerate(some.labels["plane"]) if each == label]
    turns = [dh_chain(table["alpha"], table["a"], table["d"], table["theta"] + some.joints[k]) for some, k in rows]
    return turns, [float(some.columns["reading"][k]) for some, k in rows]


def off_axis(calibration, label, normal):
    """What a plunger that stands off its axis, as the fit has it, adds to each residual, mm."""
    at = dict(zip(calibration.fit.names, calibration.result.x, strict=True))
    x, y = -0.01 * at["trusted_plunger2"], 0.01 * at["trusted_plunger1"]  # of an axis along z
    across = np.array([x, y, -(x**2 + y**2) / 2])
    turns, readings = turned(calibration, label)
    return np.array([r * float(normal @ turn[:3, :3] @ across) for turn, r in zip(turns, readings, strict=True)])


def test_tilts_by_numpy_alone(calibration):
    places = Touches.of(calibration).places("floor")
    turns, _ = turned(calibration, "floor")
    tilts = [math.degrees(math.acos(abs(turn[2, 2]))) for turn in turns]
    np.testing.assert_allclose(np.sort(places.tilts), np.sort(tilts), atol=0.01)


def test_the_map_agrees_with_the_figure_beside_it(calibration):
    workspace = Workspace.of(calibration)
    rms = math.sqrt((workspace.error**2).mean())
    assert rms == pytest.approx(calibration.tip_std[1], rel=0.05)
    squares = in_squares(np.array([[0.0, 0.0], [0.1, 0.1], [10.0, 5.0]]), np.array([3.0, -4.0, 1.0]), 5)
    np.testing.assert_allclose(squares.values, [-0.5, 1.0])
    np.testing.assert_allclose([squares.side, squares.x[1], squares.y[1]], [2.0, 8.0, 4.0], atol=1e-6)


@pytest.fixture
def hostile(tmp_path):
    """A problem whose names and labels are written by someone who means ill."""
    folder = tmp_path / """<img src=x onerror=alert(1)> "it's" &amp;"""
    folder.mkdir()
    source = (HSR / "problem.py").read_text(encoding="utf-8")
    name = "</title></style><script>alert('robot')</script>" + "x" * 200
    (folder / "problem.py").write_text(source.replace('"HSR-JR680"', repr(name)), encoding="utf-8")
    samples = (HSR / "samples.csv").read_text(encoding="utf-8")
    labels = {"floor": "<script>alert('floor')</script>", "wall": "--> ]]> &lt; \u202e '", "side": "s" * 300}
    for old, new in labels.items():
        samples = samples.replace(f",{old}\n", f",{new}\n")
    (folder / "samples.csv").write_text(samples, encoding="utf-8")
    return folder, name, labels


def test_hostile_names_are_text(hostile, tmp_path, capsys):
    folder, name, labels = hostile
    arguments = ["calibrate", str(folder), "--method", "lm", "--no-reference", "--out", str(tmp_path / "o")]
    assert main(arguments) == 0, capsys.readouterr().err
    page = (tmp_path / "o" / "report.html").read_text(encoding="utf-8")
    read = assert_valid(page)
    assert read.all("h1")[0][1] == name
    faces = [row[0] for row in tables(page)["faces"][1:]]
    assert faces[0] == labels["floor"]
    assert "\u202e" not in page
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", page, re.S)
    three, code, data, fold = map(html.unescape, scripts)  # a name that ends one would make more
    assert gzip.decompress(base64.b64decode(three)) == static("three.module.min.js")
    assert (code.strip(), fold.strip()) == (static("space.js").decode().strip(), static("fold.js").decode().strip())
    names = [solid["name"] for solid in json.loads(data)["solids"]]
    assert labels["floor"] in names
    assert len(faces[2]) <= 60
    assert shlex.split(read.all("pre")[0][1]) == ["casacal", *arguments]


def test_escaping():
    assert tag("p", "<&>\"'", at={"title": "\"'<"}) == '<p title="&#34;&#39;&lt;">&lt;&amp;&gt;&#34;&#39;</p>\n'
    assert tag("p", tag("b", "x"), None) == "<p><b>x</b>\n</p>\n"
    assert tag("p", "a\x00b\ud800c\x1b") == "<p>a\ufffdb\ufffdc\ufffd</p>\n"


@pytest.fixture(scope="module")
def tracked(hsr):
    """The same arm before a tracker: three residuals per row, no faces."""
    rng = np.random.default_rng(5)
    limits = [(axis.lower, axis.upper) for axis in hsr.problem.robot.axes]
    joints = rng.uniform(*np.array(limits).T, size=(40, 6))
    value = {name: nominal for name, _, nominal, _ in casacal.bind(hsr.problem, hsr.problem.read(HSR / "samples.csv"))
             .parameters()}  # fmt: skip
    table = {key: np.array([value[f"{key}{i}"] for i in range(1, 7)]) for key in ("alpha", "a", "d", "theta")}
    table["a"][1] += 0.5
    tips = [dh_chain(table["alpha"], table["a"], table["d"], table["theta"] + q)[:3, 3] for q in joints]
    seen = np.array(tips) + [100, 200, 300] + 0.05 * rng.normal(size=(40, 3))
    problem = Problem(hsr.problem.robot, TrackedPoint(noise_std=0.05))
    columns = dict(zip("xyz", seen.T, strict=True))
    return problem, Samples(joints, columns, {}, tuple(range(2, 42)), {}, "tracker.csv", "0" * 64)


@pytest.mark.long
def test_a_tracker_has_coordinates_in_place_of_faces(tracked, hsr):
    problem, samples = tracked
    page = of(calibrate(problem, samples, method="lm", holdout=0.2, reference=False), hsr)
    read = assert_valid(page)
    assert "faces" not in tables(page)
    assert [row[0] for row in tables(page)["columns"][1:]] == ["x", "y", "z"]
    assert read.by_class("verdict")[0].startswith("Calibrated: ")
    assert len(DOTS.findall(page.split('<svg id="rows-after"')[1].partition("</svg>")[0])) == 120
    assert "No second solver was run" in read.text_of("reference")
    assert "Made from Python" in read.text_of("provenance")


@pytest.mark.long
def test_one_plane_without_labels_and_without_any_prior_is_unbounded(hsr, corner_simulation):
    problem = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, plane=Plane()))
    few = corner_simulation.samples
    keep = [i for i, label in enumerate(few.labels["plane"]) if label == "floor"]
    samples = few.take(keep)
    samples = Samples(samples.joints, samples.columns, {}, samples.lines, {}, samples.file, samples.sha256)
    flat = problem.with_prior({"d": math.inf, "theta": math.inf})
    read = assert_valid(of(calibrate(flat, samples, method="lm", reference=False), hsr))
    (said,) = read.by_class("verdict")[:1]
    assert said.startswith("Do not use this result: neither the samples nor a prior hold 4 combinations of parameters")
    assert "Not stated" in read.text_of("expected")
    assert "mm" not in read.text_of("expected")


def test_gross_rows_are_named(hsr):
    samples = hsr.problem.read(HSR / "samples.csv")
    readings = samples.columns["reading"].copy()
    readings[[7, 50]] += 2.0
    bad = Samples(samples.joints, {"reading": readings}, dict(samples.labels), samples.lines, {}, "s.csv", "0" * 64)
    lines = {str(samples.lines[i]) for i in (7, 50)}
    plain = of(calibrate(hsr.problem, bad, method="lm", reference=False, outliers="keep"), hsr)
    assert "--loss huber" in Page(plain).text_of("outliers")
    calibration = calibrate(hsr.problem, bad, method="lm", loss=huber())
    page = of(calibration, hsr)
    assert {row[0] for row in tables(page)["worst-rows"][1:3]} == lines
    assert float(tables(page)["worst-rows"][1][5]) < 0.1
    beyond = page.split('<svg id="rows-after"')[1].partition("</svg>")[0].split('h.1" class="dot beyond"')
    assert len(beyond) == 2
    assert len(DOTS.findall(beyond[0].rpartition('d="')[2] + "h.1")) == 2
    assert lines <= set(re.findall(r"\d+", Page(page).text_of("outliers").partition("lines ")[2]))


@pytest.mark.long
def test_rows_that_were_set_aside_are_counted_as_such(hsr):
    """Counts are those of the rows that were changed; the noise is the one that the column is made of."""
    samples = hsr.problem.read(HSR / "samples.csv")
    readings = samples.columns["reading"].copy()
    readings += np.random.default_rng(0).normal(0, 0.1, len(readings))
    readings[7] += 6.9
    bad = Samples(samples.joints, {"reading": readings}, dict(samples.labels), samples.lines, {}, "s.csv", "0" * 64)
    calibration = calibrate(hsr.problem, bad, method="lm", reference=False, discrepancy="none")
    page = of(calibration, hsr)
    assert "120 rows, of which 119 were fitted and 0 held out to judge the fit; 1 set aside" in Page(page).text_of(
        "measured"
    )
    assert facts(page, "subject")["Rows"] == "119 fitted, 0 held out, 1 set aside"
    assert sum(int(cells[1]) for cells in tables(page)["faces"][1:]) == 119
    listed = Page(page).text_of("outliers")
    assert f"1 row was set aside before the fit and is not listed here: line {samples.lines[7]}." in listed
    assert "times the noise as found" in listed
    assert "stated noise" not in listed
    (head, *rows) = tables(page)["worst-rows"]
    assert head[-1] == "Times noise as found"
    size = float(rows[0][head.index("Residual, mm")]) / float(rows[0][-1])
    assert abs(size) == pytest.approx(0.1, rel=0.15)  # what was added, ten times what was stated
    assert "dark line is what the noise as found predicts" in Page(page).text_of("residuals")


@pytest.mark.long
def test_many_rows_and_many_faces_do_not_make_a_large_page(hsr, page):
    samples = hsr.problem.read(HSR / "samples.csv")
    times = 200
    joints = np.tile(samples.joints, (times, 1))
    readings = np.tile(samples.columns["reading"], times) + 0.01 * np.random.default_rng(2).normal(size=len(joints))
    labels = {"plane": tuple(samples.labels["plane"]) * times}
    many = Samples(joints, {"reading": readings}, labels, range(2, 2 + len(joints)), {}, "many.csv", "0" * 64)
    large = of(calibrate(hsr.problem, many, method="lm", holdout=0.5, reference=False), hsr)
    assert_valid(large)
    assert len(large) < 2 * len(page)
    assert "each square is their mean" in large
    assert "24,000 rows" in Page(large).text_of("measured")


def test_scales_and_ticks():
    assert [words for _, words in ticks(-0.02, 0.02)] == ["−0.02", "−0.01", "0", "0.01", "0.02"]
    assert nice_ceiling(0.0123) == pytest.approx(0.015)
    panel = Panel((0.0, 10.0), (-1.0, 1.0))
    assert float(panel.across(0.0)) == panel.left
    assert float(panel.down(1.0)) == panel.top
    assert float(panel.down(-1.0)) == panel.height - panel.bottom
    square = Panel.square((0.0, 100.0), (0.0, 1000.0))
    assert float(square.across(1.0) - square.across(0.0)) == pytest.approx(float(square.down(0.0) - square.down(1.0)))
    values = np.array([0.0, -5.0, 5.0, np.inf, 0.1])
    parts = {colour: rows.tolist() for colour, rows in Scale.of_signs(values).parts(values)}
    assert [rows for rows in parts.values() if rows] == [[1], [0, 4], [2], [3]]


def test_a_page_that_cannot_be_written_is_one_line(tmp_path, capsys):
    target = tmp_path / "file"
    target.write_text("here")
    shutil.copy(HSR / "samples.csv", tmp_path / "s.csv")
    arguments = ["calibrate", str(HSR), str(tmp_path / "s.csv"), "--method", "lm", "--no-reference"]
    assert main([*arguments, "--out", str(target)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
