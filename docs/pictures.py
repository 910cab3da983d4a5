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


if __name__ == "__main__":
    HERE.mkdir(exist_ok=True)
    for draw in (dial, post, series, workspace):
        draw()
