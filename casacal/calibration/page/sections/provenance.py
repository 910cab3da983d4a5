"""What the page is about, and what is needed to reproduce it: files, hashes, command, versions, timings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from casacal.calibration.calibration import Calibration
from casacal.calibration.page.markup import Markup, paragraph, section, tag
from casacal.calibration.page.numbers import left_out_rows
from casacal.calibration.page.table import facts


def heading(calibration: Calibration, document: Mapping[str, Any]) -> Markup:
    """Title, robot, data, method and status."""
    data = document["data"]
    fit = calibration.fit
    counts = [f"{data['fitted']:,} fitted", f"{data['heldout']:,} held out", *left_out_rows(data)]
    return tag(
        "header",
        paragraph("Calibration report", style="kind"),
        tag("h1", fit.problem.robot.name),
        facts(
            "subject",
            [
                ("Problem", document["problem"]["name"]),
                ("Data", data["file"]),
                ("SHA-256 of the data", tag("code", data["sha256"])),
                ("Method", document["method"]),
                ("Rows", ", ".join(counts)),
                ("Unknowns", f"{fit.unknowns:,}"),
                ("Status", document["status"]),
            ],
        ),
    )


def provenance_section(document: Mapping[str, Any], command: str | None) -> Markup:
    """Command, hashes, versions, and the timings, which alone differ when it is run again."""
    evaluations, versions = document["evaluations"], document["versions"]
    pairs = [
        ("Problem file", document["problem"]["path"]),
        ("SHA-256 of the problem", tag("code", document["problem"]["sha256"])),
        ("Data file", document["data"]["file"]),
        ("SHA-256 of the data", tag("code", document["data"]["sha256"])),
        ("Seed", str(document["seed"])),
        ("Rows evaluated", f"{evaluations['residual_rows']:,} residuals, {evaluations['jacobian_rows']:,} derivatives"),
        ("Back end", document["backend"]),
        ("Versions", ", ".join(f"{name} {version}" for name, version in versions.items())),
    ]
    made = (
        paragraph("Made from Python with casacal.calibrate; seed and method are above.")
        if command is None
        else tag("pre", tag("code", command))
    )
    return section(
        "provenance",
        "How to reproduce this page",
        paragraph(
            "On the same machine, the same files, command and versions reproduce this page byte for byte, apart from "
            "the last line."
        ),
        made,
        facts("provenance-facts", pairs),
        timings(document["seconds"]),
    )


def timings(seconds: Mapping[str, float]) -> Markup:
    """The one line that differs between two runs."""
    parts = ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items())
    return paragraph(f"Time taken: {parts}.", style="timings")
