"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.planning.clearance import Clearance as Clearance
from casacal.planning.plan import Plan as Plan
from casacal.planning.route import Route as Route
from casacal.planning.route import read_route as read_route
