"""The page: its sections in the order in which someone decides, checks and files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from casacal.calibration.calibration import Calibration
from casacal.calibration.page.markup import tag
from casacal.calibration.page.sections.beside import beside_section
from casacal.calibration.page.sections.expected import expected_section
from casacal.calibration.page.sections.measured import measured_section
from casacal.calibration.page.sections.outliers import outliers_section
from casacal.calibration.page.sections.parameters import parameters_section
from casacal.calibration.page.sections.provenance import heading, provenance_section
from casacal.calibration.page.sections.reference import reference_section
from casacal.calibration.page.sections.residuals import residuals_section
from casacal.calibration.page.sections.unseen import unseen_section
from casacal.calibration.page.sections.verdict import verdict_section
from casacal.calibration.page.shell import whole_page
from casacal.calibration.page.touches import Touches
from casacal.uncertainty.expectation import Box


def report_page(
    calibration: Calibration, document: Mapping[str, Any], *, command: str | None = None, box: Box | None = None
) -> str:
    """HTML of the report: one page that needs no other file, no network and no script.

    Args:
        calibration: whose rows and workspace are drawn.
        document: its result.json, whose numbers the page shows; see
            `casacal.calibration.result_json.calibration_document`.
        command: the command line that reproduces it, as typed; None when there was none.
        box: where the arm will work, mm in the base frame, or None.

    """
    each = Touches.of_each(calibration)
    main = tag(
        "main",
        heading(calibration, document),
        verdict_section(calibration, document),
        measured_section(each, document),
        residuals_section(each, document),
        expected_section(each, document, box),
        parameters_section(calibration, document),
        unseen_section(document),
        beside_section(document),
        reference_section(calibration, document),
        outliers_section(each, document),
        provenance_section(document, command),
    )
    return whole_page(f"Calibration of {calibration.fit.problem.robot.name} ({document['problem']['name']})", main)
