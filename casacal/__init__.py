"""casacal: calibrate a robot arm with a dial indicator and a flat face.

Here stands what a first problem and its calibration need; the rest is public in the chapters (`casacal.fit`,
`casacal.study`, ...). `__init__.pyi` lists both. Each is imported when first used.
"""

import warnings
from typing import Any

from casacal.public import homes, on_demand

_HOMES = homes(__name__)
_public = on_demand(__name__, _HOMES)
__all__ = sorted(name for name, home in _HOMES.items() if home and name != "__version__")


def __getattr__(name: str) -> Any:
    if name not in _HOMES and not name.startswith("_"):  # earlier public names, for one version
        for chapter in (chapter for chapter, home in _HOMES.items() if not home):
            if name in getattr(_public(chapter), "__all__", ()):
                message = f"casacal.{name} is now casacal.{chapter}.{name}"
                warnings.warn(message, DeprecationWarning, stacklevel=2)
                return getattr(_public(chapter), name)
    return _public(name)


def __dir__() -> list[str]:
    return sorted(_HOMES)
