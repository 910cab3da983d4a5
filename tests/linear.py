"""A linear problem, as a matrix and as symbols, whose posterior is known in closed form."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from casacal import Instrument, Parameter, Problem, Robot, bind
from casacal.data.samples import Samples
from casacal.fit.least_squares import LeastSquares
from casacal.model.kinematics import translate_z


class Matrix(LeastSquares):
    """The residual A x - b."""

    def __init__(self, a, b, x0, prior_std, start_std=None, datum=None):
        self.a, self.b, self.x0, self.prior_std = a, b, x0, prior_std
        self.start_std = prior_std if start_std is None else start_std
        self.names = tuple(f"x{j}" for j in range(len(x0)))
        self.units = ("mm",) * len(x0)
        self.datum = np.zeros(len(x0), dtype=bool) if datum is None else datum

    rows = property(lambda self: len(self.b))

    def residual(self, x):
        return self.a @ x - self.b

    def jacobian(self, x):
        return self.a.copy()

    def row(self, k, states):
        return states @ self.a[k] - self.b[k]

    def row_jacobian(self, k, x):
        return float(self.a[k] @ x - self.b[k]), self.a[k].copy()


@dataclass(frozen=True)
class Weighing(Instrument):
    """Reads y = sum a_i b_i: the same linear problem, declared with symbols."""

    b: Parameter
    noise_std: float
    unknowns = property(lambda self: {"b": self.b})
    residual_std = property(lambda self: self.noise_std)

    @property
    def columns(self):
        return {f"a{i + 1}": "number" for i in range(self.b.size)} | {"y": "number"}

    def residual(self, pose, p, row):
        return sum(getattr(row, f"a{i + 1}") * p.b[i] for i in range(self.b.size)) - row.y


def random_linear(seed, rows=30, n=5):
    """A (rows, n), y (rows,), nominal (n,), prior std (n,), noise std."""
    rng = np.random.default_rng(seed)
    a, prior = rng.normal(size=(rows, n)), rng.uniform(0.3, 3.0, n)
    nominal = rng.normal(size=n)
    noise = 0.2
    truth = nominal + prior * rng.normal(size=n)
    return a, a @ truth + noise * rng.normal(size=rows), nominal, prior, noise


def as_symbols(a, y, nominal, prior, noise):
    """The problem bound through CasADi; x is the deviation from nominal."""
    robot = Robot("slide", "P", lambda p, q: translate_z(q[0]), {})
    problem = Problem(robot, Weighing(Parameter(tuple(nominal), prior_std=tuple(prior)), noise))
    frame = pd.DataFrame(a, columns=[f"a{i + 1}" for i in range(a.shape[1])]).assign(y=y, q1_mm=0.0)
    return bind(problem, Samples.from_frame(frame, problem.layout()))
