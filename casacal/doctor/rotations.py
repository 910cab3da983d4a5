"""What the numbers of an orientation may mean."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.doctor.pendant_rows import ANGLES

SEQUENCES = {"fixed-xyz": "xyz", "zyx": "ZYX", "zyz": "ZYZ", "xyz": "XYZ"}
"""Three angles in the order of their columns: turns about fixed axes (small letters), or each about the axis that
those before it have moved (capitals)."""
MEANINGS = {
    "quaternion": "unit quaternion",
    "fixed-xyz": "turns about the fixed x, then y, then z (FANUC and Yaskawa W P R, Mitsubishi A B C)",
    "zyx": "turns about z, then the moved y, then the moved x (KUKA A B C)",
    "zyz": "turns about z, then the moved y, then the moved z (Kawasaki O A T, Comau)",
    "xyz": "turns about x, then the moved y, then the moved z (Staubli)",
    "rotation-vector": "axis times angle (Universal Robots)",
}


def rotations_of(numbers: Array) -> dict[tuple[str, str], Array]:
    """Rotation matrices (N, 3, 3) that orientations (N, 4) or (N, 3) may mean, by convention and unit ("" for none)."""
    if numbers.shape[1] == 4:
        return {("quaternion", ""): rotations_as(numbers, "quaternion")}
    names = (*SEQUENCES, "rotation-vector")
    return {(name, unit): rotations_as(numbers, name, unit) for unit in ANGLES for name in names}


def rotations_as(numbers: Array, name: str, unit: str = "") -> Array:
    """Rotation matrices (N, 3, 3) that orientations mean in one convention and unit."""
    from scipy.spatial.transform import Rotation

    if name == "quaternion":
        return np.asarray(Rotation.from_quat(np.roll(numbers, -1, axis=1)).as_matrix())
    angles = numbers * ANGLES[unit]
    if name == "rotation-vector":
        return np.asarray(Rotation.from_rotvec(angles).as_matrix())
    return np.asarray(Rotation.from_euler(SEQUENCES[name], angles).as_matrix())


def angle_between(one: Array, other: Array) -> Array:
    """Angles (...; rad) between rotations (..., 3, 3), exact for small ones too."""
    chord = np.linalg.norm(one - other, axis=(-2, -1)) / (2 * np.sqrt(2))
    return np.asarray(2 * np.arcsin(np.minimum(chord, 1.0)))
