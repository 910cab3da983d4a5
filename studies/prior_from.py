"""Is an earlier result a good prior? Arms of which one joint slipped, calibrated from forty touches since.

A true arm is drawn, touched 120 times and calibrated. Then the zero of one of the joints 2 to 5 slips by 1 to 10 mrad.
Forty fresh touches of faces that were not moved are calibrated with the earlier result as the prior, that joint
loosened. Intervals of the parameters and the expected tip error are held against the truth, which nothing here sees.

    casacal study studies/prior_from.py [--quick] [--out DIR]
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from casacal import bind, calibrate, load_problem, simulate
from casacal.model import ProblemFile
from casacal.simulation.simulate import default_cell, simulate_one
from casacal.simulation.touches import Draw
from casacal.study import Run
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints
from studies import reporting
from studies.reporting import script

WITHIN = 1.96  # standard deviations of a 95 % interval
KINDS: dict[str, dict[str, Any]] = {
    "geometry alone, noise as stated": {"discrepancy": "none", "noise": "stated"},
    "with effects, noise as found": {},
}


@dataclasses.dataclass
class Found:
    """Of some arms: parameters in their intervals, tip errors and those that were expected, results that were refused.

    refused: with the joint loosened. caught: with nothing loosened, as all must be. never: arms whose first calibration
    was refused, so that there is no earlier result.
    """

    inside: int = 0
    parameters: int = 0
    errors: list[float] = dataclasses.field(default_factory=list)
    expected: list[float] = dataclasses.field(default_factory=list)
    refused: int = 0
    caught: int = 0
    never: int = 0


def add_arm(found: Found, source: ProblemFile, seed: int, options: dict[str, Any]) -> None:
    """Draw an arm, calibrate it, let a joint slip, and calibrate again."""
    cell = source.cell or default_cell(source.problem)
    made = simulate(source.problem, cell, samples=120, seed=seed)
    first = calibrate(source.problem, made.samples, reference=False, **options)
    if not first.success:  # no earlier result: an arm that was drawn much nearer to its drawing than its priors say
        found.never += 1
        return
    rng = np.random.default_rng(seed)
    joint, shift = int(rng.integers(1, 5)), float(rng.choice([-1, 1]) * rng.uniform(1e-3, 1e-2))
    rows = simulate_one(source.problem, cell, 40, Draw(seed, session=1)).samples
    rows = dataclasses.replace(rows, joints=rows.joints - shift * np.eye(rows.joints.shape[1])[joint], file="since.csv")
    given = {"prior": first, "standing": ["plane"], "reference": False, **options}
    found.caught += not calibrate(source.problem, rows, **given).success
    since = calibrate(source.problem, rows, loosen=[f"joint{joint + 1}"], **given)
    if not since.success:
        found.refused += 1
        return
    joints = workspace_joints(source.problem.robot)
    tips = made.true_tips(joints + shift * np.eye(joints.shape[1])[joint])
    off = since.predict(joints, frame="tip").positions - tips
    found.errors.append(tip_rms(without_rigid(off.ravel(), tips)))
    found.expected.append(since.tip_std[1])
    bound = bind(source.problem.without_terms, made.samples)
    truth = dict(zip(bound.names, made.truth(bound), strict=True))
    truth[f"theta{joint + 1}"] += shift
    for name, x, std in zip(since.fit.names, since.x, since.std, strict=True):
        if name in truth and not name.startswith("plane"):
            found.parameters += 1
            found.inside += abs(x - truth[name]) < WITHIN * std


def picture(found: Mapping[str, Found], out: Path) -> None:
    """What the tip errs by against what was expected, arm by arm."""
    made = reporting.figure(9, 4)
    for axes, (words, each) in zip(made.subplots(1, len(found), sharex=True, sharey=True), found.items(), strict=True):
        axes.loglog(each.expected, each.errors, ".", ms=4)
        ends = [0.5 * min(each.expected, default=0.1), 2 * max(each.expected, default=1.0)]
        axes.loglog(ends, ends, lw=0.8, color="0.5")
        axes.set_title(words, fontsize=9)
        axes.set_xlabel("expected tip error, mm RMS")
    made.axes[0].set_ylabel("tip error, mm RMS")
    reporting.save(made, out / "expected.png")


def report(run: Run) -> list[str]:
    """Coverage, tip errors against what was expected, and how often a slip that nobody loosened is caught."""
    run.out.mkdir(parents=True, exist_ok=True)
    source, arms = load_problem(reporting.PROBLEMS / "hsr_jr680"), 2 if run.quick else 100
    rows, every = [], dict[str, Found]()
    for words, options in KINDS.items():
        found = every[words] = Found()
        for seed in range(1, arms + 1):
            add_arm(found, source, seed, options)
        error, expected = (float(np.sqrt(np.mean(np.square(each)))) for each in (found.errors, found.expected))
        covered = f"{100 * found.inside / found.parameters:.1f}"
        figures = (covered, f"{error:.3f}", f"{expected:.3f}", f"{error / expected:.2f}")
        begun = arms - found.never
        rows.append((words, begun, *figures, found.refused, f"{found.caught} of {begun}"))
    picture(every, run.out)
    head = ("fit", "arms", "inside 95 %, %", "tip error, mm", "expected, mm", "ratio", "refused", "slip caught")
    return [
        "# Is an earlier result a good prior?",
        "",
        f"HSR-JR680, {arms} true arms, each calibrated from 120 touches of three faces with a 0.01 mm dial.",
        "Then one of the joints 2 to 5 slips by 1 to 10 mrad, and 40 touches of the same faces are calibrated with",
        "the earlier result as the prior, that joint loosened. Inside: parameters whose 95 % interval holds the",
        "truth. Tip errors are RMS over arms and workspace. Refused: of these results. Slip caught: results without",
        "anything loosened that were refused, as all should be. Arms whose first calibration was refused are left out.",
        "",
        *reporting.table(head, rows),
        "",
        "![What the tip errs by against what was expected](expected.png)",
    ]


if __name__ == "__main__":
    script(__file__)
