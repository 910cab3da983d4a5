"""`casacal predict`: predict poses of the calibrated arm."""

from __future__ import annotations

import argparse

from casacal.cli.common import DONE, add, add_instrument, add_json, add_result, made_from, spare
from casacal.cli.terminal import say_json, say_paragraph

HELP = "predict poses of the calibrated arm"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal predict` takes."""
    parser.description = (
        "Write the pose x_mm,y_mm,z_mm,qw,qx,qy,qz of a calibrated arm at each row of joint values, in the base frame. "
        "The flange is what robot.pose of the problem gives; the tip is where the instrument touches, including tool "
        "and, where JOINTS has that column, the reading."
    )
    add_result(parser)
    add_instrument(parser, "instrument whose tip is meant; default: the first")
    add(parser, "JOINTS", "CSV with the joint columns of a samples file")
    add(parser, "--out FILE", "CSV of poses", required=True)
    add(
        parser,
        "--frame",
        "poses of the flange or of the tip; default: flange",
        default="flange",
        choices=("flange", "tip"),
    )
    add(parser, "--std", "add a column std_mm: standard deviation of the position, apart from the position of the base")
    add(parser, "--nominal", "use the arm as drawn, not as calibrated")
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Predict as the options say; returns 0."""
    from casacal.compensation.arm import denial
    from casacal.compensation.predict import predict, read_joints, write_prediction
    from casacal.compensation.result_file import caution, read_result, verdict_part
    from casacal.compensation.seen_by import seen_by

    spare([options.out], options.result, options.joints)
    result = seen_by(read_result(options.result), options.instrument)
    spare([options.out], *made_from(result))
    joints = read_joints(options.joints, result.source)
    prediction = predict(result, joints, frame=options.frame, nominal=options.nominal, std=options.std)
    write_prediction(options.out, prediction)
    count = len(prediction.positions)
    if options.json:
        said = {"poses": count, "frame": options.frame, "nominal": options.nominal, "verdict": verdict_part(result)}
        say_json({**said, "written": [options.out]})
    else:
        say_paragraph(f"Written: {options.out} ({count} {'pose' if count == 1 else 'poses'} of the {options.frame})")
        if (words := denial(result) or caution(result)) is not None and not options.nominal:
            say_paragraph(words)
    return DONE
