"""A verification as a section of the calibration's own report, after its verdict; one that stands there is replaced."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from casacal.errors import CasacalError
from casacal.verification.figures import Figures
from casacal.verification.page import section_of_report

BEFORE = '<section id="measured"'
"""Where the section is put."""

STANDING = re.compile(r'<section id="verified".*?</section>\n*', re.DOTALL)

REPORT = "report.html"


def with_section(path: Path, document: Mapping[str, Any], found: Figures) -> str:
    """The text of a calibration's report with the section of a verification.

    Args:
        path: the report, as `casacal calibrate` wrote it.
        document: the result.json that the report is of.
        found: the verification.

    Raises CasacalError where there is no such report, or it is of another calibration.

    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise CasacalError(
            f"There is no report '{path}' to write into", "Write a page of its own: --report FILE"
        ) from None
    marks = [str(document.get(part, {}).get("sha256", "")) for part in ("problem", "data")]
    if "<title>Calibration of" not in text or text.count(BEFORE) != 1 or not all(mark in text for mark in marks):
        raise CasacalError(f"'{path}' is not the report of this result", "Write a page of its own: --report FILE")
    bare = STANDING.sub("", text)
    return bare.replace(BEFORE, f"{section_of_report(found)}\n{BEFORE}")
