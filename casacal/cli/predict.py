"""`casacal predict`: poses of a calibrated arm at joint values."""

from __future__ import annotations

import argparse

from casacal.cli.common import DONE, add_result

HELP = "poses of a calibrated arm at joint values"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal predict` takes."""
    parser.description = "Write the pose x_mm,y_mm,z_mm,qw,qx,qy,qz of a calibrated arm at each row of joint values."
    add_result(parser)
    parser.add_argument("joints", metavar="JOINTS", help="CSV with the joint columns of a samples file")
    parser.add_argument("--out", required=True, metavar="FILE", help="CSV of poses")
    parser.add_argument("--frame", choices=("flange", "tip"), default="flange", help="default: flange")
    parser.add_argument("--std", action="store_true", help="add std_mm: standard deviation up to the base frame")
    parser.add_argument("--nominal", action="store_true", help="the arm as drawn, not as calibrated")


def run(options: argparse.Namespace) -> int:
    """Predict as the options say; returns 0."""
    from casacal.compensation.predict import predict, read_joints, write_prediction
    from casacal.compensation.result_file import read_result

    result = read_result(options.result)
    joints = read_joints(options.joints, result.source)
    prediction = predict(result, joints, frame=options.frame, nominal=options.nominal, std=options.std)
    write_prediction(options.out, prediction)
    print(f"Written: {options.out} ({len(prediction.positions)} poses of the {options.frame})")
    return DONE
