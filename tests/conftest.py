"""Shared fixtures: the problems of this project, a simulated corner, and the real data where they are present."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from casacal import bind, calibrate, load_problem, simulate
from casacal.calibration import Calibration
from casacal.fit import BoundProblem
from casacal.model import ProblemFile
from casacal.simulation import Simulation
from casacal.threads import one_thread_each

ROOT = Path(__file__).parent.parent


def pytest_configure(config: pytest.Config) -> None:
    """Give matplotlib a folder of its own, and linear algebra one thread, which workers and commands inherit.

    The user's may hold settings, or a list of fonts that an interrupted installation left half empty: matplotlib then
    complains on standard error, and tests that say what stands there fail for no fault of this project.
    """
    if hasattr(config, "workerinput"):
        return
    one_thread_each()  # workers and commands share the processors as it is: threads would wait for one another
    folder = tempfile.TemporaryDirectory(prefix="casacal-matplotlib-", ignore_cleanup_errors=True)
    config.add_cleanup(folder.cleanup)
    os.environ["MPLCONFIGDIR"] = folder.name
    # hundreds of commands start anew, and where nobody keeps bytecode each would compile all that it imports
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = str(Path(folder.name) / "bytecode")
    subprocess.run([sys.executable, "-c", "import matplotlib.font_manager"], check=True)


def pytest_itemcollected(item: pytest.Item) -> None:
    """Of a test marked `long_unless(case, ...)`, only those cases are quick."""
    unless = item.get_closest_marker("long_unless")
    if unless is not None and item.callspec.id not in unless.args:  # type: ignore[attr-defined]
        item.add_marker(pytest.mark.long)


@pytest.fixture(scope="session")
def hsr() -> ProblemFile:
    return load_problem(ROOT / "problems" / "hsr_jr680")


@pytest.fixture(scope="session")
def corner_simulation(hsr: ProblemFile) -> Simulation:
    return simulate(hsr.problem, hsr.cell, seed=3)


@pytest.fixture(scope="session")
def corner_bound(hsr: ProblemFile, corner_simulation: Simulation) -> BoundProblem:
    return bind(hsr.problem, corner_simulation.samples)


@pytest.fixture(scope="session")
def corner_calibration(hsr: ProblemFile, corner_simulation: Simulation) -> Calibration:
    return calibrate(hsr, corner_simulation.samples)


@pytest.fixture
def set_ups_of_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """`plan` compares set-ups by a sixth of the candidates, where these figures are not what is asked about."""
    monkeypatch.setattr("casacal.planning.set_ups.POOL", 100)


@pytest.fixture(scope="session")
def motoman_data() -> Path:
    """Folder of the real contacts; name it in CASACAL_MOTOMAN, or keep it beside the checkout."""
    folder = Path(os.environ.get("CASACAL_MOTOMAN", ROOT.parent / "shared" / "data" / "motoman"))
    if not (folder / "contacts.csv").is_file():
        pytest.skip(f"the Motoman measurements are not at {folder}; set CASACAL_MOTOMAN to their folder")
    return folder
