"""report.html: one page about a calibration, to open offline, print and file.

`page` puts the sections in order and `sections` words them; `touches`, `workspace` and `squares` gather what pictures
need, `drawing` and `colours` draw them; `markup` and `table` write HTML in which every text is escaped; `style` is the
style sheet.
"""

from __future__ import annotations

from casacal.calibration.page.page import report_page as report_page
