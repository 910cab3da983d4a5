"""Simulated samples as files, and the truth behind them beside, in the shape of a result.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from casacal.calibration.result_json import closing, geometry, head_of, rows_file, rows_of, spreads
from casacal.data.samples import Samples, write_samples
from casacal.errors import CasacalError
from casacal.files import sealed, side_by_side, write_json
from casacal.fit.arm_alone import arm_alone
from casacal.fit.bound_problem import BoundProblem, bind
from casacal.fit.least_squares import Result, Status
from casacal.model.problem_file import ProblemFile
from casacal.public import __version__
from casacal.simulation.simulate import Simulation


def write_simulation(
    simulation: Simulation, source: ProblemFile, path: Path, kept: tuple[Path, Samples] | None = None
) -> list[Path]:
    """Write simulated samples, and the truth as x.truth.json beside x.csv, all or nothing; returns the paths.

    kept: rows of the same simulation that are not for fitting, and the file for them in the same folder.
    """
    measured, truth_path = simulation.measured, path.with_suffix(".truth.json")
    targets = sample_paths(path, source.problem.names)
    if path.exists() and not path.is_file():
        raise CasacalError(f"'{path}' is no file, and the truth goes beside it", "Name a file, such as x.csv")
    comments = [f"simulated by casacal {__version__} for {source.name}, seed {simulation.seed}: not a measurement"]
    further = [] if kept is None else [kept]
    with side_by_side([truth_path, *(place for place, _ in further), *targets]) as (answer, *places):
        for place, (_, rows) in zip(places, further, strict=False):
            write_samples(place, source.problem.layout(), rows, comments)
        written = []
        for i, (place, some) in enumerate(zip(places[len(further) :], measured.sets, strict=True)):
            write_samples(place, source.problem.layout(i), some, comments)
            written.append(replace(source.problem.read(place, i), file=str(targets[i])))
        document = truth_document(simulation, source, bind(source.problem.without_terms, *written), path.parent)
        document["data"]["file"] = " and ".join(target.name for target in targets)
        write_json(answer, sealed(document))
    return [*targets, *(place for place, _ in further), truth_path]


def sample_paths(path: Path, names: Sequence[str]) -> list[Path]:
    """Where the samples of each instrument go: x.csv of an only one, x-dial.csv and so on of several."""
    return [path] if len(names) == 1 else [path.with_name(f"{path.stem}-{name}{path.suffix}") for name in names]


def truth_document(simulation: Simulation, source: ProblemFile, bound: BoundProblem, folder: Path) -> dict[str, Any]:
    """The truth behind simulated samples, in the shape of result.json, but for a verdict, fitted rows and the seal."""
    x, samples = simulation.truth(bound), bound.measured
    truth = Result("truth", bound, x, Status.TRUTH, {}, steps=0, residual_rows=0, jacobian_rows=0)
    rows = rows_of(bound, x, np.zeros(bound.unknowns), ["simulation"] * bound.unknowns)
    names = arm_alone(bound, x)[0].names
    return {
        **head_of(source, truth, simulation.seed, bound.backend, folder),
        "data": {**rows_file(samples, folder), "heldout": 0},
        "cost": truth.cost,
        "parameters": [{**row, "known_from": "simulation"} for row in rows],
        **geometry(bound, x),
        "metrics": None,
        "identifiability": None,
        **spreads(np.zeros((len(names), len(names))), names, bound),
        "reference": None,
        **closing(truth, {"build": 0.0, "solve": 0.0, "total": 0.0}),
    }
