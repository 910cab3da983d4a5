"""Draws the pictures of the gallery and of the front page: python docs/pictures.py."""

from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

from casacal import Robot, bind, calibrate, load_problem, simulate
from casacal.model.links import Links
from casacal.uncertainty.tip_error import without_rigid, workspace_joints

HERE, PROBLEMS = Path(__file__).parent / "pictures", Path(__file__).parent.parent / "problems"
ARM, FACE, TIP = "#30518f", "#9fb4d8", "#c0392b"


def save(figure: plt.Figure, name: str) -> None:
    """Write a picture and forget it."""
    figure.savefig(HERE / f"{name}.png", dpi=90, bbox_inches="tight")
    plt.close(figure)


def space(size: float, centre: tuple[float, float, float] = (0, 0, 300)) -> plt.Axes:
    """Axes in space, mm, to one scale."""
    axes = plt.figure(figsize=(4.2, 4.2)).add_subplot(projection="3d")
    for set_limits, at in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), centre, strict=True):
        set_limits(at - size / 2, at + size / 2)
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(18, -58)
    axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm")
    return axes


def chain_of(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Places along an arm (k, 3; mm), the base first."""
    places = [np.zeros(3), *(np.array(each).ravel() for each in Links.of(robot).carried(ca.DM(q)))]
    return np.array(places)


def stick(axes: plt.Axes, places: np.ndarray, colour: str = ARM, *, light: bool = False) -> None:
    """One posture."""
    axes.plot(*places.T, color=colour, lw=1.5 if light else 4, alpha=0.35 if light else 1, solid_capstyle="round")
    axes.plot(*places[-1:].T, "o", color=TIP, ms=3 if light else 6)


def dial() -> None:
    """Touches on plates and a gauge block."""
    source = load_problem(PROBLEMS / "ur5")
    bound = bind(source.problem, source.problem.read(source.samples))
    joints, axes = bound.samples[0].joints, space(1100)
    tips = bound.tips(bound.x0, joints)
    for face in source.cell.faces:
        normal, centre = np.array(face.normal, float), np.array(face.centre, float)
        across = np.linalg.svd(normal[None])[2][1:] * np.array(face.size)[:, None] / 2
        corners = centre + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) @ across
        axes.plot(*corners.T, color=FACE, lw=1.5)
    arms = [np.vstack([chain_of(source.problem.robot, joints[k]), tips[k]]) for k in range(0, len(joints), 9)]
    for k, places in enumerate([each for each in arms if each[:-2, 2].min() > -1][:4]):
        stick(axes, places, light=k > 0)
    axes.plot(*tips.T, ".", color=TIP, ms=3)
    save(axes.figure, "dial")


def post() -> None:
    """A probe around a post."""
    turn, axes = np.linspace(0, 2 * np.pi, 60), space(900, (250, 30, 350))
    for z in np.linspace(0, 500, 6):
        axes.plot(480 + 80 * np.cos(turn), 60 + 80 * np.sin(turn), z, color=FACE, lw=1)
    source = load_problem(PROBLEMS / "ur5")
    bound = bind(source.problem, source.problem.read(source.samples))
    joints = workspace_joints(source.problem.robot, poses=20_000)
    poses = bound.poses(bound.x0, joints)
    apart = np.linalg.norm(poses[:, :3, 3] - [360.0, 60.0, 330.0], axis=1) + 100 * np.abs(poses[:, 0, 2] - 1)
    q = next(joints[k] for k in np.argsort(apart) if chain_of(source.problem.robot, joints[k])[:, 2].min() > -1)
    flange = bound.poses(bound.x0, q[None])[0]
    stick(axes, np.vstack([chain_of(source.problem.robot, q), flange[:3, 3] + 60 * flange[:3, 2]]))
    save(axes.figure, "post")


def series() -> None:
    """Errors of three arms out of one series, and their mean."""
    rng = np.random.default_rng(3)
    mean = rng.normal(size=8) * 0.7 * np.sqrt(0.75)
    arms = mean + rng.normal(size=(3, 8)) * 0.7 * 0.5
    figure, axes = plt.subplots(figsize=(4.6, 2.6))
    axes.axhline(0, color="grey", lw=0.8)
    for k, arm in enumerate(arms):
        axes.plot(np.arange(8) + 0.15 * (k - 1), arm, "o", color=ARM, alpha=0.5, label="arms" if k == 0 else None)
    axes.plot(np.arange(8), mean, "_", color=TIP, ms=22, mew=2, label="mean of the series")
    axes.set(
        xticks=range(8), xticklabels=["a1", "a2", "a3", "a4", "d1", "d4", "d5", "d6"], ylabel="off the drawing, mm"
    )
    axes.legend(frameon=False)
    save(figure, "series")


def workspace() -> None:
    """True tip errors of a simulated arm over its workspace, before and after."""
    source = load_problem(PROBLEMS / "ur5")
    made = simulate(source.problem, source.cell, samples=120, seed=4)
    found = calibrate(source, made.samples, reference=False)
    joints = workspace_joints(source.problem.robot, poses=700)
    true, fit = made.true_tips(joints), found.fit
    figure, both = plt.subplots(1, 2, figsize=(7.4, 3), sharey=True, layout="constrained")
    for axes, x, when in zip(both, (fit.x0, found.result.x), ("as drawn", "calibrated"), strict=True):
        apart = without_rigid((fit.tips(x, joints) - true).ravel(), true)
        miss = np.linalg.norm(apart.reshape(-1, 3), axis=1)
        spots = axes.scatter(
            np.hypot(true[:, 0], true[:, 1]), true[:, 2], c=miss, s=14, cmap="viridis", norm="log", vmin=0.01, vmax=6
        )
        axes.set(title=f"{when}: {np.sqrt((miss**2).mean()):.2g} mm RMS", xlabel="distance from the first axis, mm")
    both[0].set_ylabel("height, mm")
    figure.colorbar(spots, ax=both, label="true error of the tip, mm,\napart from where the base stands")
    save(figure, "workspace")


def parameters() -> None:
    """What 120 touches say of lengths and angles: estimate, 95 % interval, prior and truth."""
    source = load_problem(PROBLEMS / "hsr_jr680")
    made = simulate(source.problem, source.cell, samples=120, seed=3)
    found = calibrate(source, made.samples, reference=False)
    fit, x, std = found.fit, found.result.x, found.result.std
    truth = dict(
        zip(bind(source.problem, made.samples).names, made.truth(bind(source.problem, made.samples)), strict=True)
    )
    figure, both = plt.subplots(1, 2, figsize=(8, 3.1), layout="constrained")
    for axes, unit, times, shown in zip(both, ("mm", "rad"), (1, 1000), ("mm", "mrad"), strict=True):
        rows = [j for j, u in enumerate(fit.units) if u == unit and fit.names[j] in truth and "." not in fit.names[j]]
        at, names = np.arange(len(rows)), [fit.names[j] for j in rows]
        prior = times * fit.prior_std[rows]
        axes.bar(at, 3.92 * prior, bottom=-1.96 * prior, color=FACE, alpha=0.5, label="what the prior allows")
        axes.errorbar(at, times * x[rows], 1.96 * times * std[rows], fmt="o", color=ARM, ms=4, label="calibrated, 95 %")
        axes.plot(at, [times * truth[name] for name in names], "x", color=TIP, label="true")
        axes.set_xticks(at, names, rotation=90)
        axes.set_ylabel(f"off the drawing, {shown}")
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    save(figure, "parameters")


def residuals() -> None:
    """`plot_residuals` of the example."""
    figure, axes = plt.subplots(figsize=(7.4, 2.8), layout="constrained")
    calibrate(load_problem(PROBLEMS / "hsr_jr680"), reference=False).plot_residuals(axes)
    save(figure, "residuals")


def flat(axes: plt.Axes, *places: np.ndarray, colour: str = ARM, width: float = 4) -> None:
    """Links between places (2, mm)."""
    axes.plot(*np.array(places).T, "-o", color=colour, lw=width, ms=width + 1, solid_capstyle="round")


def up(length: float, degrees: float) -> np.ndarray:
    """A link of that length and elevation (2, mm)."""
    return length * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])


def three_link() -> None:
    """The arm of docs/own_problem.md before its wall."""
    figure, axes = plt.subplots(figsize=(4.6, 2.6), layout="constrained")
    for k, turns in enumerate(((20, -30, 35), (-25, 20, 20), (30, 20, -40))):
        angles = np.cumsum(turns)
        places = np.cumsum([np.zeros(2), *(up(a, d) for a, d in zip((400, 300, 200), angles, strict=True))], axis=0)
        axes.plot(
            *places.T, "-o", color=ARM, lw=4 if k == 0 else 1.5, ms=5 if k == 0 else 3, alpha=1 if k == 0 else 0.4
        )
        beam = up(1.0, angles[-1])
        ends = np.array([places[-1], places[-1] + (1200 - places[-1][0]) / beam[0] * beam])
        axes.plot(*ends.T, "--", color=TIP, lw=1)
    axes.axvline(1200, color=FACE, lw=5)
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    save(figure, "three_link")


def closed_chains() -> None:
    """A five-bar, a palletiser and a Delta."""
    figure = plt.figure(figsize=(9, 3), layout="constrained")
    bar, pallet, delta = (figure.add_subplot(1, 3, k, projection="3d" if k == 3 else None) for k in (1, 2, 3))
    left, right = np.array([-59.0, 0.0]), np.array([59.0, 0.0])
    tip = position_of("five_bar", np.radians([95, 88]))
    flat(bar, left, left + up(90, 95), tip[:2])
    flat(bar, right, right + up(90, 88), tip[:2])
    bar.plot(*tip[:2], "o", color=TIP, ms=8)
    shoulder, elbow = np.array([13.2, 106.6]), np.array([13.2, 106.6]) + up(142.07, 65)
    end = elbow + up(158.81, -35)
    flat(pallet, (0, 0), (0, 106.6), shoulder, elbow, end, end + np.array([56.55, 0]))
    flat(pallet, shoulder, shoulder - up(45, -35), elbow - up(45, -35), elbow, colour="#8f5130", width=2)
    pallet.plot(*(end + np.array([56.55, 0])), "o", color=TIP, ms=8)
    q, middle = np.radians([25.0, 5.0, 40.0]), position_of("delta", np.radians([25.0, 5.0, 40.0]))
    for turn, angle in zip(np.radians([-90, 30, 150]), q, strict=True):
        out, top = np.array([np.cos(turn), np.sin(turn), 0]), np.array([0, 0, 1500.0])
        knee = 163.7 * out + top + 524 * (np.cos(angle) * out - np.sin(angle) * np.array([0, 0, 1]))
        delta.plot(*np.array([163.7 * out + top, knee, middle + 43.9 * out]).T, "-o", color=ARM, lw=3, ms=4)
    corners = np.array([middle + 43.9 * np.array([np.cos(t), np.sin(t), 0]) for t in np.radians([-90, 30, 150, -90])])
    delta.plot(*corners.T, color=TIP, lw=3)
    delta.set_box_aspect((1, 1, 1))
    for axes, name in ((bar, "five-bar"), (pallet, "palletiser"), (delta, "Delta")):
        axes.set_title(name, fontsize="medium")
        axes.set(xlabel="mm", aspect="equal")
    save(figure, "closed_chains")


def position_of(name: str, q: np.ndarray) -> np.ndarray:
    """Flange (3, mm) of the drawn arm of a problem."""
    robot = load_problem(PROBLEMS / name).problem.robot
    return np.array(ca.DM(robot.traced.at_drawn(ca.DM(q))))[:3, 3]


def one_row() -> None:
    """How the graph of one row is made."""
    figure, axes = plt.subplots(figsize=(7.4, 1.5), layout="constrained")
    steps = [
        "z, c, d\nunknowns, row",
        "p, q\nvalues, joints",
        "pose\n4 x 4",
        "tip\n3",
        "residual\nm",
        "jacobian\nm x nz",
    ]
    for k, words in enumerate(steps):
        box = {"boxstyle": "round,pad=0.5", "fc": FACE, "ec": ARM, "alpha": 0.6}
        axes.text(k, 0, words, ha="center", va="center", bbox=box, fontsize=9)
        if k:
            axes.annotate("", (k - 0.36, 0), (k - 0.62, 0), arrowprops={"arrowstyle": "->", "color": ARM})
    axes.set(xlim=(-0.5, len(steps) - 0.5), ylim=(-1, 1))
    axes.axis("off")
    save(figure, "one_row")


PICTURES = (dial, post, series, workspace, parameters, residuals, three_link, closed_chains, one_row)

if __name__ == "__main__":
    HERE.mkdir(exist_ok=True)
    for draw in PICTURES:
        draw()
