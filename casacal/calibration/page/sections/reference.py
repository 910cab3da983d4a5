"""Whether a solver that shares nothing with the method but the objective found the same minimum."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from casacal.calibration.calibration import Calibration
from casacal.calibration.page.markup import Markup, paragraph, section
from casacal.calibration.page.table import facts


def reference_section(calibration: Calibration, document: Mapping[str, Any]) -> Markup:
    """The verdict on the minimum, and its figures."""
    reference, title = calibration.reference, "Agreement with the reference"
    if reference is None:
        why = "IPOPT knows no robust loss" if calibration.result.loss else "it was switched off, or not asked for"
        return section("reference", title, paragraph(f"No second solver was run: {why}."))
    found = document["reference"]
    agrees = reference.agrees
    words = (
        f"{reference.solver.upper()} solved the same objective in another parametrisation and "
        + ("found the same minimum" if agrees else "DID NOT find the same minimum")
        + f": the costs differ by {abs(reference.gap):.1e} (limit {reference.limit:.0e})."
    )
    pairs = [
        (f"Cost, {calibration.method}", f"{document['cost']:.10g}"),
        (f"Cost, {reference.solver}", f"{found['cost']:.10g}"),
        ("Relative gap", f"{found['relative_gap']:.1e}"),
        ("Largest gradient left (KKT)", f"{found['kkt']:.1e}"),
        ("Iterations", str(found["iterations"])),
        ("Status", reference.result.message),
    ]
    return section(
        "reference", title, paragraph(words, style="calm" if agrees else "alarm"), facts("reference-facts", pairs)
    )
