"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.simulation.cell import Disturbances as Disturbances
from casacal.simulation.simulate import Simulation as Simulation
from casacal.simulation.trials import Simulated as Simulated
