"""Nonlinear regressions with certified answers: NIST's Statistical Reference Datasets, 27 sets, two starts each.

Data, starts and certified values: National Institute of Standards and Technology, StRD, nonlinear least squares,
https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml (public domain), in nist_strd.json. The models are written here.
"""

import json
from pathlib import Path

import casadi as ca
import numpy as np

from casacal.fit import LeastSquares

SETS = json.loads(Path(__file__).with_name("nist_strd.json").read_text(encoding="utf-8"))


def cubic_over_cubic(b, x):
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def three_exponentials(b, x):
    return b[0] * ca.exp(-b[1] * x) + b[2] * ca.exp(-b[3] * x) + b[4] * ca.exp(-b[5] * x)


def decay_and_two_peaks(b, x):
    peaks = b[2] * ca.exp(-((x - b[3]) ** 2) / b[4] ** 2) + b[5] * ca.exp(-((x - b[6]) ** 2) / b[7] ** 2)
    return b[0] * ca.exp(-b[1] * x) + peaks


def waves(b, x):
    year, other, third = (2 * np.pi * x / period for period in (12, b[3], b[6]))
    known = b[0] + b[1] * ca.cos(year) + b[2] * ca.sin(year)
    return known + b[4] * ca.cos(other) + b[5] * ca.sin(other) + b[7] * ca.cos(third) + b[8] * ca.sin(third)


def decay_over_line(b, x):
    return ca.exp(-b[0] * x) / (b[1] + b[2] * x)


MODELS = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": lambda b, x: b[0] * (1 - ca.exp(-b[1] * x)),
    "Chwirut1": decay_over_line,
    "Chwirut2": decay_over_line,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": waves,
    "Eckerle4": lambda b, x: b[0] / b[1] * ca.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": decay_and_two_peaks,
    "Gauss2": decay_and_two_peaks,
    "Gauss3": decay_and_two_peaks,
    "Hahn1": cubic_over_cubic,
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Lanczos1": three_exponentials,
    "Lanczos2": three_exponentials,
    "Lanczos3": three_exponentials,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * ca.exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * ca.exp(-x * b[3]) + b[2] * ca.exp(-x * b[4]),
    "Misra1a": lambda b, x: b[0] * (1 - ca.exp(-b[1] * x)),
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Nelson": lambda b, x1, x2: b[0] - b[1] * x1 * ca.exp(-b[2] * x2),  # of log y
    "Rat42": lambda b, x: b[0] / (1 + ca.exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + ca.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - ca.atan(b[2] / (x - b[3])) / np.pi,
    "Thurber": cubic_over_cubic,
}


class Regression(LeastSquares):
    """A set from one of its starts, no prior: rows are weighted by the certified residual standard deviation.

    How large an unknown may be is what a user would say who knows only the start: its own size.
    """

    def __init__(self, name, start):
        data = SETS[name]
        self.certified, self.certified_std = np.array(data["certified"]), np.array(data["std"])
        n = self.certified.size
        self.names, self.units = tuple(f"b{k + 1}" for k in range(n)), ("",) * n
        self.x0 = np.array(data["starts"][start], dtype=float)
        self.prior_std, self.start_std = np.full(n, np.inf), np.abs(self.x0)
        self.datum = np.zeros(n, dtype=bool)
        y = np.log(data["y"]) if name == "Nelson" else np.array(data["y"])
        self.weight = np.sqrt((y.size - n) / data["sum_of_squares"])
        b, x = ca.SX.sym("b", n), [np.array(column) for key, column in data.items() if key.startswith("x")]
        e = self.weight * (MODELS[name](ca.vertsplit(b), *(ca.DM(column) for column in x)) - y)
        self._both = ca.Function("both", [b], [ca.densify(e), ca.densify(ca.jacobian(e, b))])

    @property
    def rows(self):
        return self._both.numel_out(0)

    def residual(self, x):
        return np.asarray(self._both(x)[0]).ravel()

    def jacobian(self, x):
        return np.asarray(self._both(x)[1])

    def row(self, k, states):
        return np.array([self.residual(x)[k] for x in states])

    def row_jacobian(self, k, x):
        e, slopes = self._both(x)
        return float(e[k]), np.asarray(slopes)[k]

    def digits(self, x):
        """Digits of the estimate that agree with the certified ones, of the worst unknown; 11 are certified."""
        with np.errstate(divide="ignore"):
            right = -np.log10(np.abs(x - self.certified) / np.abs(self.certified))
        return float(np.clip(np.nan_to_num(right, nan=0.0), 0, 11).min())
