"""`casacal predict`: predict poses of the calibrated arm."""

from __future__ import annotations

import argparse

from casacal.cli.common import DONE, FORCE, INSTRUMENT, JSON, RESULT, add, add_frame, read_arm
from casacal.cli.terminal import answer
from casacal.wording import counted, listed

HELP = "predict poses of the calibrated arm"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal predict`."""
    parser.description = (
        "Write the pose x_mm,y_mm,z_mm,qw,qx,qy,qz of a calibrated arm at each row of joint values, in the base frame. "
        "The flange is what robot.pose of the problem gives; the tip is where the instrument touches, including tool "
        "and, where JOINTS has that column, the reading. Exit 1, and no file, for a result that must not be "
        "used, unless --force is given."
    )
    add(parser, *RESULT)
    add(parser, *INSTRUMENT)
    add(parser, "JOINTS", "CSV with the joint columns of a samples file, and those that tell an effect (torques)")
    add(parser, "--out FILE", "CSV of poses", required=True)
    add_frame(parser, "poses of the flange or of the tip")
    add(parser, "--std", "add a column std_mm: standard deviation of the position, apart from the position of the base")
    add(parser, "--nominal", "use the arm as drawn, not as calibrated")
    add(parser, *FORCE)
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Predict as the options say; returns 0."""
    from casacal.deployment.arm import column_notes
    from casacal.deployment.predict import joints_from, predict, write_prediction

    result = read_arm(options, options.joints)
    joints = joints_from(options.joints, result.source)
    nominal = options.nominal
    prediction = predict(result, joints, frame=options.frame, nominal=nominal, std=options.std, force=options.force)
    said = [] if nominal else column_notes(result, prediction.missing, prediction.beyond)
    care = [] if nominal else [words for words in (result.caution, result.mirror_words) if words is not None]
    write_prediction(
        options.out, prediction, ["Of the arm as drawn, not as calibrated."] if nominal else [*care, *said]
    )
    if prediction.unseen:
        said.append(
            f"warning: the calibration saw no session {listed(prediction.unseen)}, so where the dial's zero then "
            "stood is known by its prior alone (--std shows it)"
        )
    if result.denial is not None and not nominal:
        said.append(result.denial)
    said += care
    found = {
        "unseen": list(prediction.unseen),
        "missing": {words: list(names) for words, names in prediction.missing.items()},
        "beyond": list(prediction.beyond),
        "poses": len(prediction),
        "frame": options.frame,
        "nominal": nominal,
        "verdict": result.verdict,
        "written": [options.out],
    }
    answer(options, found, f"Written: {options.out} ({counted(len(prediction), 'pose')} of the {options.frame})", *said)
    return DONE
