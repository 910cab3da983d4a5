"""What a plane can and cannot see: the seven set-ups of a contact-only HSR-JR680, kind by kind."""

import json
import math

import numpy as np
import pytest
from conftest import ROOT

from casacal import Cell, DialOnPlane, Face, Problem, bind, calibrate, corner, load_problem, plate, simulate
from casacal.cli.main import main
from casacal.data.samples import write_samples
from casacal.linalg import posterior_covariance
from casacal.planning.cures import cure_for, cures
from casacal.uncertainty.identifiability import correlated_pairs, identifiability, known_from, prior_scale, sparse_basis
from casacal.uncertainty.tip_error import classical_accuracy, workspace_joints

CENTRE = (1350.0, 0.0, 700.0)
FLAT = plate((1350.0, 0.0, 500.0))
INCLINED = plate((1350.0, 0.0, 500.0), normal=(-0.4, 0.3, 0.8))
CORNER = corner(CENTRE)


def facets():
    """Twelve small faces around the corner's centre, none facing away from the base."""
    rng = np.random.default_rng(0)
    faces = []
    for i in range(12):
        normal = rng.normal(size=3)
        normal[0], normal[2] = -abs(normal[0]), abs(normal[2])
        normal /= np.linalg.norm(normal)
        faces.append(Face(f"facet{i}", tuple(np.array(CENTRE) - 200 * normal), tuple(normal), (300, 300)))
    return tuple(faces)


# faces, largest tilt, rank, unknowns, (invisible, rigid, scale, blind), order of magnitude of the condition
TABLE = {
    "1 horizontal, tool normal": (FLAT, 0, 6, 27, (5, 2, 1, 13), 4e3),
    "1 horizontal, tilt 15": (FLAT, 15, 17, 27, (5, 2, 1, 2), 1.5e5),
    "1 inclined, tilt 30": (INCLINED, 30, 19, 27, (5, 2, 1, 0), 8e3),
    "2 orthogonal, tilt 30": (CORNER[:2], 30, 22, 30, (5, 2, 1, 0), 8e3),
    "3 orthogonal, tool normal": (CORNER, 0, 17, 33, (5, 2, 1, 8), 3e3),
    "3 orthogonal, tilt 30": (CORNER, 30, 25, 33, (5, 2, 1, 0), 7e2),
    "12 facets, tool normal": (facets(), 0, 44, 60, (5, 2, 1, 8), 4e3),
}


def judge(problem, faces, tilt):
    # an exact contact of the nominal arm, as the table is defined
    cell = Cell(faces=faces, tilt=math.radians(tilt), error_scale=0.0, repeatability=0.0)
    bound = bind(problem, simulate(problem, cell, seed=1).samples)
    joints = workspace_joints(problem.robot)
    return identifiability(bound, bound.tip_jacobian(bound.x0, joints), bound.tips(bound.x0, joints))


@pytest.mark.parametrize("row", TABLE.values(), ids=TABLE)
def test_rank_and_null_space_by_kind(hsr, row):
    faces, tilt, rank, unknowns, kinds, condition = row
    contact = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, reading=False))
    found = judge(contact, faces, tilt)
    assert (found.rank, found.unknowns) == (rank, unknowns)
    assert tuple(found.count(kind) for kind in ("invisible", "rigid", "scale", "blind")) == kinds
    assert condition / 5 < found.condition < condition * 5


def test_null_directions_are_named_by_the_unknowns_that_take_part(hsr):
    contact = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, reading=False))
    found = judge(contact, CORNER, 30)
    said = {direction.words.split(":")[0] for direction in found.null}
    assert "alpha6 changes alone" in said
    assert "theta6 changes alone" in said
    assert said & {"d2, d3 change together", "d3, d2 change together"}


def test_a_dial_turns_null_directions_into_weak_ones(hsr):
    found = judge(hsr.problem, FLAT, 15)
    assert [found.count(kind) for kind in ("invisible", "rigid", "scale")] == [3, 2, 0]
    # a1 and d2 + d3 move tips along a horizontal plate: null where the fitted plate is exactly horizontal, and with
    # it 1e-9 of the largest singular value, at the edge of rank, where rounding tilts it
    blind = [direction for direction in found.null if direction.kind == "blind"]
    words = [direction.words.split(" change")[0] for direction in blind]
    assert len(words) <= 2
    assert {name for each in words for name in each.split(", ")} <= {"a1", "d2", "d3"}
    assert len(found.weak) >= 5
    # wherever rounding puts them: what a dial leaves without any reading is those two, and what it makes weak is more
    faint = [direction for direction in found.weak if direction.singular_value < 1e-3]
    assert len(blind) + len(faint) == 2
    assert all(direction.singular_value < 1 for direction in found.weak)


def test_a_sparse_basis_spans_the_same_space():
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(7, 3)))[0]
    sparse = sparse_basis(basis)
    assert np.linalg.matrix_rank(np.hstack([basis, sparse]), tol=1e-9) == 3
    assert (np.abs(sparse) < 1e-12).sum() >= 6


def test_what_determined_a_parameter():
    found = [known_from(std, 1.0) for std in (0.1, 0.6, 0.99, math.inf)]
    assert found == ["samples", "samples and prior", "prior alone", "prior alone"]
    assert known_from(3.0, math.inf) == "samples"


@pytest.mark.long_unless("3 orthogonal, tilt 30")
@pytest.mark.parametrize("name", ["1 horizontal, tool normal", "3 orthogonal, tool normal", "3 orthogonal, tilt 30"])
def test_result_json_holds_the_table(name, tmp_path, capsys):
    faces, tilt, rank, unknowns, expected, _ = TABLE[name]
    problem = tmp_path / "problem.py"
    problem.write_text(
        (ROOT / "problems" / "hsr_jr680" / "problem.py").read_text()
        + "problem = Problem(robot, DialOnPlane(noise_std=0.01, reading=False))\n"
    )
    source = load_problem(problem)
    cell = Cell(faces=faces, tilt=math.radians(tilt), error_scale=0.0, repeatability=0.0)
    write_samples(
        tmp_path / "s.csv", source.problem.layout(), simulate(source.problem, cell, seed=1).samples, ["exact"]
    )
    typed = ["calibrate", str(problem), str(tmp_path / "s.csv"), "--no-reference", "--method", "lm", "--json"]
    assert main(typed) == 1  # an arm exactly as drawn is better than any estimate of it
    found = json.loads(capsys.readouterr().out)["identifiability"]
    # seven decimals of a degree in the file are a contact missed by a few nanometres: still null at 1e-9
    assert (found["rank"], found["unknowns"]) == (rank, unknowns)
    kinds = [entry["kind"] for entry in found["null"]]
    assert [kinds.count(kind) for kind in ("invisible", "rigid", "scale", "blind")] == list(expected)
    samples = source.problem.read(tmp_path / "s.csv")
    figures = calibrate(source.problem, samples, method="lm", reference=False).unjudged
    null = figures.identifiability.null
    assert [direction.kind for direction in null] == kinds
    for direction, cure in zip(null, figures.advice, strict=False):
        if direction.kind in ("invisible", "rigid"):
            assert cure == "none needed"
        elif direction.kind == "scale":
            assert "100 mm step" in cure
            assert direction.tip_mm > 0.1


def test_tilt_is_the_cure_for_a_normal_tool_and_does_what_it_says(hsr):
    contact = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, reading=False))
    cell = Cell(faces=CORNER, tilt=0.0, error_scale=0.0, repeatability=0.0)
    bound = bind(contact, simulate(contact, cell, seed=1).samples)
    joints = workspace_joints(contact.robot)
    found = identifiability(bound, bound.tip_jacobian(bound.x0, joints), bound.tips(bound.x0, joints))
    offers, now = cures(bound, bound.x0), posterior_covariance(bound.information(bound.x0), bound.prior_information)
    (tilted,) = (cure for cure in offers if "tilted by up to 30 degrees" in cure.words)
    assert tilted.recommended
    blind = [d for d in found.null if d.kind == "blind" and d.tip_mm > 0.1]
    assert blind
    for direction in blind:
        assert cure_for(bound, now, offers, direction).removesuffix(" (in part)") in {cure.words for cure in offers}
        assert cure_for(bound, now, [tilted], direction).startswith(tilted.words)
    # the advice, taken, removes the blindness: the fourth row of the table against the fifth
    assert judge(contact, CORNER, 30).count("blind") == 0


def test_structural_directions_stay_null_elsewhere(hsr):
    found = judge(hsr.problem, CORNER, 30)
    structural = {d.words.split(" change")[0] for d in found.null if d.structural}
    assert "alpha6" in structural
    assert not any("d2" in d.words and d.structural for d in found.null)  # once alpha2 is off, the axes cross


def test_correlated_pairs_are_the_strongest_first():
    covariance = np.array([[1.0, 0.98, 0.1], [0.98, 1.0, -0.96], [0.1, -0.96, 1.0]])
    assert correlated_pairs(covariance, ["a", "b", "c"]) == [("a", "b", 0.98), ("b", "c", -0.96)]


@pytest.mark.parametrize("std", [1e-3, 1.0, 1e6, 1e9, np.inf])
def test_what_the_samples_tell_alone_does_not_depend_on_the_prior(hsr, std):
    """Neither the bound without a prior nor rank and null space, which are the rows' own."""
    samples = hsr.problem.read(hsr.samples)
    usual = bind(hsr.problem, samples)
    other = bind(hsr.problem.with_prior({"a": std}), samples)
    assert classical_accuracy(other, other.x0) == pytest.approx(classical_accuracy(usual, usual.x0), rel=1e-9)
    joints = workspace_joints(hsr.problem.robot, poses=40)
    one, two = (identifiability(each, each.tip_jacobian(each.x0, joints), each.tips(each.x0, joints))
                for each in (usual, other))  # fmt: skip
    assert one.rank == two.rank
    assert [direction.kind for direction in one.null] == [direction.kind for direction in two.null]
    assert [direction.words for direction in one.null] == [direction.words for direction in two.null]
    null = np.array([direction.direction for direction in two.null]).T
    seen = other.jacobian(other.x0) * prior_scale(other)
    assert np.abs(seen @ null).max(initial=0.0) <= 1e-6 * np.linalg.norm(seen, axis=0).max()
