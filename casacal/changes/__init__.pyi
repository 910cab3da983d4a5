"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.changes.changed import Change as Change
