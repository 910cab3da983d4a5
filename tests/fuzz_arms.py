"""Well-formed files about arms (URDF, DH tables, results, joints, targets, pendant rows), and who reads them."""

from pathlib import Path

import numpy as np
from conftest import ROOT
from oracles import dh_chain, rot_z
from scipy.spatial.transform import Rotation

from casacal import Robot, calibrate, load, load_problem
from casacal.deployment.compensate import read_targets
from casacal.deployment.export import dh_text
from casacal.deployment.predict import joints_from
from casacal.doctor import read_pendant_rows

HSR = ROOT / "problems" / "hsr_jr680"
NUMBERS = (
    b"1e999",
    b"nan",
    b"-inf",
    b"1e308",
    b"0",
    b"-",
    b"",
    b"1_0",
    b"0x1",
    b"\xff",
    b"\x00",
    b"999999999999999999",
)
URDF_TOKENS = (
    *NUMBERS, b"<axis xyz='0 0 0'/>", b"<Axis", b"<joint", b"</joint>", b"<link name='a'/>", b"<mimic joint='j1'/>",
    b"<!DOCTYPE r [<!ENTITY a 'b'>]>", b"&a;", b"<!--", b"]]>", b"<?xml version='1.0' encoding='x'?>", b"xacro:",
    b"type='floating'", b"rpy='180 0 0'", b"xyz='500 0 0'", b"<limit/>", b"<origin/>", b"name=''", b"<robot>",
)  # fmt: skip
TABLE_TOKENS = (
    *NUMBERS, b"#", b"# convention: modified\n", b"convention", b"joint", b"alpha_deg", b"parallel", b"prismatic", b",",
    b";", b"\n", b"\r", b'"', b"[", b"]", b"=", b"{", b"}", b"'", b'"""', b"true", b"1 2", b"1,5", b"beta", b"\xc3\xa4",
)  # fmt: skip
RESULT_TOKENS = (
    *NUMBERS, b"null", b"true", b"[", b"]", b"{", b"}", b'"', b",", b":", b'"schema": 99', b'"arm": {}', b'"name"',
    b"NaN", b"Infinity", b"1e400", b"[" * 3000, b'{"a":' * 500, b"\\ud800", b'"../../etc/passwd"', b"-1", b"[[]]",
)  # fmt: skip


def urdf_files(folder: Path) -> list[Path]:
    """URDFs of two arms."""
    from fuzz_seeds import URDF

    paths = [folder / "one.urdf", folder / "two.urdf"]
    paths[0].write_text(URDF)
    paths[1].write_text(URDF.replace('type="fixed"', 'type="prismatic"').replace(
        "</joint>\n</robot>", '<axis xyz="0 0 1"/><limit lower="0" upper="0.2"/></joint>\n</robot>'))  # fmt: skip
    return paths


def dh_files(folder: Path) -> list[Path]:
    """DH tables in CSV and TOML."""
    found = calibrate(HSR, method="lm", reference=False)
    (folder / "arm.csv").write_text(found.export("dh"))
    (folder / "arm.toml").write_text(dh_text(found.arm, toml=True))
    return [folder / "arm.csv", folder / "arm.toml"]


def result_files(folder: Path) -> list[Path]:
    """Results of a DH arm and of one whose pose and instrument are a user's own."""
    paths = []
    for name in ("ur5", "adept_cobra600", "hsr_jr680"):
        calibrate(ROOT / "problems" / name, method="lm", reference=False).save(folder / name)
        paths.append((folder / name / "result.json").rename(folder / f"{name}.json"))
    return paths


def joint_files(folder: Path) -> list[Path]:
    """Joint values, in degrees and radians."""
    q = np.random.default_rng(0).uniform(-1, 1, (12, 6))
    header = ",".join(f"q{i}_rad" for i in range(1, 7))
    lines = [",".join(f"{value:.6f}" for value in row) for row in q]
    (folder / "q.csv").write_text("\n".join([header, *lines]) + "\n")
    (folder / "deg.csv").write_text("\n".join([header.replace("rad", "deg"), *lines]).replace(",", ";") + "\n")
    return [folder / "q.csv", folder / "deg.csv"]


def target_files(folder: Path) -> list[Path]:
    """Targets as joint values and as poses."""
    poses = folder / "poses.csv"
    rows = [f"{k}00,200,300,1,0,0,0" for k in range(4, 12)]
    poses.write_text("\n".join(["x_mm,y_mm,z_mm,qw,qx,qy,qz", *rows]) + "\n")
    return [*joint_files(folder), poses]


def pendant_files(folder: Path) -> list[Path]:
    """What a pendant shows of an arm."""
    robot = load_problem(HSR).problem.robot.arm
    lines = ["q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad"]
    for q in np.random.default_rng(1).uniform(-0.8, 0.8, (5, 6)):
        pose = dh_chain(robot.alpha, robot.a, robot.d, np.array(robot.theta) + q) @ rot_z(0.0)
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        lines.append(",".join(f"{value:.4f}" for value in (*np.degrees(q), *pose[:3, 3], *turn)))
    (folder / "pendant.csv").write_text("\n".join(lines) + "\n")
    return [folder / "pendant.csv"]


def read_arm(path: Path) -> object:
    """An arm, and its pose at zero."""
    robot = Robot.from_urdf(path) if path.suffix == ".urdf" else Robot.from_dh_file(path)
    return robot.traced


def use_result(path: Path) -> None:
    """All that is asked of a result."""
    saved = load(path)
    _ = repr(saved), saved.success, saved.message, saved.cost, saved.parameters, saved.metrics
    q = np.zeros((2, len(saved.arm.source.problem.robot.axes)))
    for frame in ("flange", "tip"):
        saved.predict(q, frame=frame, std=True)
    saved.compensate(q)
    for form in ("zeros", "c"):
        saved.export(form)


def read_joint_values(path: Path) -> object:
    """Joint values for a prediction."""
    return joints_from(path, load_problem(HSR))


def read_target_poses(path: Path) -> object:
    """Targets of a compensation."""
    return read_targets(path, load_problem(HSR))


def read_pendant(path: Path) -> object:
    """Rows of a pendant."""
    return read_pendant_rows(path, [True] * 6)
