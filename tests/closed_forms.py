"""Flange positions of the closed chains in problems/, by circles and spheres; nothing here imports casacal."""

import numpy as np


def circles(one, other, r_one, r_other):
    """The point (2,) that two circles share, on the left of the way from the first centre to the second."""
    way = other - one
    apart = np.hypot(*way)
    along = (r_one**2 - r_other**2 + apart**2) / (2 * apart)
    across = np.sqrt(r_one**2 - along**2)
    return one + (along * way + across * np.array([-way[1], way[0]])) / apart


def spheres(centres, radii):
    """The lower of the two points (3,) that three spheres share."""
    ex = centres[1] - centres[0]
    d = np.linalg.norm(ex)
    ex = ex / d
    third = centres[2] - centres[0]
    i = ex @ third
    ey = (third - i * ex) / np.linalg.norm(third - i * ex)
    ez, j = np.cross(ex, ey), ey @ third
    x = (radii[0] ** 2 - radii[1] ** 2 + d**2) / (2 * d)
    y = (radii[0] ** 2 - radii[2] ** 2 + i**2 + j**2 - 2 * i * x) / (2 * j)
    z = np.sqrt(radii[0] ** 2 - x**2 - y**2)
    return min((centres[0] + x * ex + y * ey + side * z * ez for side in (1, -1)), key=lambda place: place[2])


def polar(length, angle):
    return length * np.array([np.cos(angle), np.sin(angle)])


def five_bar(p, q):
    """base, two cranks, two rods, two zeros; the tip is before both motors."""
    base, *cranks, rod_left, rod_right, zero_left, zero_right = p
    left = polar(cranks[0], q[0] + zero_left) - np.array([base / 2, 0])
    right = polar(cranks[1], q[1] + zero_right) + np.array([base / 2, 0])
    return np.array([*circles(left, right, rod_left, rod_right), 0.0])


def delta(p, q):
    """Three each of base, azimuth, arm, rod and offset; motors 1500 mm high."""
    base, azimuth, arm, rod, offset = np.reshape(p, (5, 3))
    reach = base + arm * np.cos(q + offset) - 76 / np.sqrt(3)  # rods as if they met in the middle of the platform
    return np.array([0, 0, 1500]) + spheres(
        np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), -arm * np.sin(q + offset)]), rod
    )


def palletiser(p, q):
    """shoulder, upper, forearm, crank, rod, lever, two zeros."""
    shoulder, upper, forearm, crank, rod, lever, zero_upper, zero_crank = p
    elbow, pin = polar(upper, q[1] + zero_upper), polar(-crank, -(q[2] + zero_crank))
    end = circles(pin, elbow, rod, lever)  # of the lever, behind the elbow
    wrist = elbow + forearm * (elbow - end) / lever
    out = shoulder + 56.55 + wrist[0]
    return np.array([out * np.cos(q[0]), out * np.sin(q[0]), 106.6 + wrist[1]])


FORMS = {"five_bar": five_bar, "delta": delta, "palletiser": palletiser}
