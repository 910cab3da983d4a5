"""The command line's arguments: names, units and help; what they do is in `cli`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import NoReturn, TypeAlias

from casacal.compensation_cli import add_compensate
from casacal.doctor_cli import add_doctor
from casacal.errors import CasacalError

METHOD_NAMES = ("lm", "sckf", "sckf-lm", "ekf", "annealing", "swarm", "evolution", "ipopt", "plane-only")
Command: TypeAlias = Callable[[argparse.Namespace], int]


class _Parser(argparse.ArgumentParser):
    """Refuses in one line, as every other refusal of casacal."""

    def error(self, message: str) -> NoReturn:
        raise CasacalError(f"{self.prog}: {message}", f"See {self.prog} --help")


def build_parser(commands_by_name: Mapping[str, Command]) -> argparse.ArgumentParser:
    """Parser whose `command` is one of the given functions; it raises CasacalError in place of printing usage."""
    parser = _Parser(prog="casacal", description="Calibrate a robot arm with a dial indicator and a flat face.")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    _add_calibrate(subparsers.add_parser("calibrate", help="fit the arm's parameters to samples"))
    _add_simulate(subparsers.add_parser("simulate", help="samples of a simulated cell, with the truth behind them"))
    _add_check(subparsers.add_parser("check", help="what is wrong with samples, before anyone trusts a fit"))
    add_doctor(subparsers.add_parser("doctor", help="a controller's conventions, from poses that its pendant shows"))
    _add_predict(subparsers.add_parser("predict", help="poses of a calibrated arm at joint values"))
    add_compensate(subparsers.add_parser("compensate", help="joint targets at which the calibrated arm hits the poses"))
    _add_study(subparsers.add_parser("study", help="many trials of many methods, recorded and reported"))
    _add_new(subparsers.add_parser("new", help="a problem folder from a DH table or a URDF"))
    _add_export(subparsers.add_parser("export", help="a calibrated arm as DH table, URDF, zero offsets or C"))
    for name, command in commands_by_name.items():
        subparsers.choices[name].set_defaults(command=command)
    return parser


def _add_calibrate(parser: argparse.ArgumentParser) -> None:
    parser.description = "Fit the arm's parameters to samples, and cross-check the minimum with IPOPT."
    parser.add_argument("problem", metavar="PROBLEM", help="a folder with a problem.py, or such a file")
    _add_samples(parser)
    parser.add_argument("--method", choices=METHOD_NAMES, default="sckf-lm", help="default: sckf-lm")
    parser.add_argument("--holdout", type=float, default=0.0, metavar="F", help="part of each plane's rows to hold out")
    parser.add_argument("--seed", type=int, default=0, metavar="K", help="of held-out rows and of random methods")
    parser.add_argument("--fix", action="append", default=[], metavar="NAMES", help="hold at nominal: alpha,a3,...")
    parser.add_argument(
        "--prior", action="append", default=[], metavar="NAME=STD", help="prior standard deviation, mm or rad, or inf"
    )
    parser.add_argument("--accuracy", type=float, metavar="MM", help="maker's accuracy: scale the arm's priors to it")
    parser.add_argument("--loss", choices=("huber", "tukey"), help="robust against gross rows; with --method lm")
    parser.add_argument(
        "--box", metavar="X0:X1,Y0:Y1,Z0:Z1", help="also say what tip error to expect inside this box, mm, base frame"
    )
    parser.add_argument("--no-reference", action="store_true", help="skip the cross-check")
    parser.add_argument(
        "--backend", choices=("auto", "c", "blocks"), help="what evaluates rows; default: CASACAL_BACKEND, else auto"
    )
    parser.add_argument(
        "--out", metavar="DIR", help="write report.html, result.json, parameters.csv and pictures there"
    )


def _add_samples(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "samples",
        metavar="SAMPLES",
        nargs="?",
        help="CSV, .xlsx, .npy, .npz; default: samples.csv beside the problem",
    )
    parser.add_argument("--readings", metavar="FILE", help="readings in a file of their own, CSV or .xlsx")
    parser.add_argument(
        "--id", default="pose", metavar="COLUMN", help="column by which they find their pose; default: pose"
    )


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    parser.description = "Let a simulated arm, drawn from the problem's prior, touch the faces of a cell."
    parser.add_argument("problem", metavar="PROBLEM", help="a folder with a problem.py, or such a file")
    parser.add_argument("--out", required=True, metavar="FILE", help="samples CSV; the truth goes to FILE.truth.json")
    parser.add_argument("--samples", type=int, default=120, metavar="N", help="default: 120")
    parser.add_argument("--seed", type=int, default=0, metavar="K")
    numbers = {
        "tilt": ("DEG", "largest angle between plunger and face normal"),
        "travel": ("MM", "range of the dial"),
        "repeatability": ("MM", "standard deviation of the reading, or of the touch without a dial"),
        "resolution": ("MM", "step of the dial's display, 0 for none"),
        "joint-std": ("RAD", "standard deviation of joint repeatability"),
        "backlash": ("RAD", "play of each joint"),
        "flatness": ("MM", "peak-to-valley form error of the faces"),
        "compliance": ("MM", "sag of the tip under gravity, RMS"),
        "outliers": ("F", "fraction of gross rows"),
        "outlier-size": ("MM", "their size"),
        "error-scale": ("X", "size of the true errors in prior standard deviations"),
    }
    for name, (unit, words) in numbers.items():
        parser.add_argument(f"--{name}", type=float, metavar=unit, help=words)


def _add_check(parser: argparse.ArgumentParser) -> None:
    parser.description = "Say what is wrong, weak or worth knowing about samples; exit 1 when a result would be wrong."
    parser.add_argument("problem", metavar="PROBLEM", help="a folder with a problem.py, or such a file")
    _add_samples(parser)


def _add_predict(parser: argparse.ArgumentParser) -> None:
    parser.description = "Write the pose x_mm,y_mm,z_mm,qw,qx,qy,qz of a calibrated arm at each row of joint values."
    parser.add_argument("result", metavar="RESULT", help="result.json of calibrate, or truth.json of simulate")
    parser.add_argument("joints", metavar="JOINTS", help="CSV with the joint columns of a samples file")
    parser.add_argument("--out", required=True, metavar="FILE", help="CSV of poses")
    parser.add_argument("--frame", choices=("flange", "tip"), default="flange", help="default: flange")
    parser.add_argument("--std", action="store_true", help="add std_mm: standard deviation up to the base frame")
    parser.add_argument("--nominal", action="store_true", help="the arm as drawn, not as calibrated")


def _add_study(parser: argparse.ArgumentParser) -> None:
    parser.description = "Run a study file and write its report; trials are recorded one by one and can be resumed."
    parser.add_argument("study", metavar="STUDY", help="a Python file such as studies/paper.py")
    parser.add_argument("--quick", action="store_true", help="the study's small form, under a minute")
    parser.add_argument("--trials", type=int, metavar="N", help="trials a setting; default: what the study says")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="local processes; default: 1")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler, such as tcp://host:8786")
    parser.add_argument("--shard", metavar="I/N", help="only the I-th of N parts of the trials, to merge later")
    parser.add_argument("--merge", nargs="+", metavar="DIR", help="run nothing: put the records of shards together")
    parser.add_argument("--resume", action="store_true", help="keep the records in DIR and make the missing ones")
    parser.add_argument("--report", action="store_true", help="run nothing: write the report from the records in DIR")
    parser.add_argument("--out", metavar="DIR", help="records and report; default: out/NAME")


def _add_new(parser: argparse.ArgumentParser) -> None:
    parser.description = "Write a problem folder for an arm that comes as a DH table or as a URDF."
    parser.add_argument("name", metavar="NAME", help="of the folder, which must not exist")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--dh", metavar="FILE", help="DH table in CSV or TOML")
    source.add_argument("--urdf", metavar="FILE", help="URDF, xacro already expanded")
    parser.add_argument("--tip", metavar="LINK", help="link that is the flange; default: the only last one")
    parser.add_argument("--base", metavar="LINK", help="link that is the base frame; default: the root")
    parser.add_argument("--out", metavar="DIR", default=".", help="where the folder goes; default: here")


def _add_export(parser: argparse.ArgumentParser) -> None:
    parser.description = "Write a calibrated arm in a form that others read."
    parser.add_argument("result", metavar="RESULT", help="result.json of calibrate, or truth.json of simulate")
    parser.add_argument(
        "--to",
        required=True,
        choices=("dh", "urdf", "zeros", "ur", "c"),
        help="DH table (CSV, or TOML by --out), URDF, zero corrections (CSV), ur_description kinematics (YAML), C99",
    )
    parser.add_argument("--out", required=True, metavar="FILE")
    parser.add_argument("--source", metavar="FILE", help="dh, urdf: file written back with only its numbers changed")
    parser.add_argument("--prefix", metavar="WORD", help="c: what functions' names begin with; default: the problem's")
