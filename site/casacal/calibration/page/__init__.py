"""report.html: one page about a calibration, to open offline, print and file; `page` puts its sections in order."""

from __future__ import annotations

from casacal.calibration.page.page import report_page as report_page
