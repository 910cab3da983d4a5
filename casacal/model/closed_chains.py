"""Closed chains: passive joints that loops hold, solved for in symbols, so that all else sees an arm like any other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca

from casacal.errors import ProblemError
from casacal.model.kinematics import Expression

ALONG, THERE = 8, 4  # Newton's steps on the way from home to a posture, and then in it
GRAINS = 2.0**40  # per rad or mm: far finer than what matters, far coarser than rounding
CLOSED = 1e-6  # of a passive joint's value, and of 1 rad or mm: a loop that closes leaves steps much smaller than this


def passive(
    loop: Callable[[Expression, Expression], Any], q: Any, *, home: Sequence[float], start: Sequence[float]
) -> Expression:
    """Passive joint values (m; rad, mm) that close a loop at joint values q, as an expression of p and q.

    Newton's steps go from `home` to q on a straight line, so that the loop stays as it is assembled there. They are
    written out in elementary operations: kernels, exports and derivatives up to the third are those of any pose. Where
    the loop does not close, or only beyond a singularity, values are not numbers. Between home and q no change point
    may lie, at which a linkage folds flat and may go on in either of two ways, as a parallelogram does.

    Args:
        loop: `loop(u, q)` gives the closure errors (m; mm, rad) at passive joint values u (m), zero where it is closed.
            It may use p.
        q: joint values (n; rad, mm) that the loop depends on, symbols or floats.
        home: those (n) of a posture in which the loop closes far from singularities, best amid their range.
        start: passive joint values (m) there, nearly.

    Raises ProblemError where the numbers of errors and passive joints differ, or those of joint values.

    """
    q = q if isinstance(q, (ca.SX, ca.MX, ca.DM)) else ca.vertcat(*q)
    u, there, at = ca.SX.sym("u", len(start)), ca.SX.sym("q", len(home)), ca.DM(home)
    errors = ca.densify(ca.SX(loop(u, there)))
    for what, count, wanted, where in (
        ("closure errors", errors.numel(), len(start), "passive joints at its start"),
        ("joint values", q.numel(), len(home), "at its home"),
    ):
        if count != wanted:
            raise ProblemError(f"A loop has {count} {what} and {wanted} {where}", "Give as many")
    own = {hash(symbol) for symbol in (*u.elements(), *there.elements())}
    others = [symbol for symbol in ca.symvar(errors) if hash(symbol) not in own]  # of p
    slope, free = ca.jacobian(errors, u), [ca.vertcat(*others)] if others else []
    step = ca.Function("step", [u, there, *free], [ca.solve(slope, errors)])
    side = ca.Function("side", [u, there, *free], [ca.det(slope)])
    root: Expression = ca.DM(start)
    for k in range(1, ALONG + THERE + 1):
        root = root - step(root, at + min(k / ALONG, 1.0) * (q - at), *free)
    # A floor counts as a constant. One step from a constant root has the implicit function's first derivative, and two
    # have the second and the third.
    root = ca.floor(root * GRAINS) / GRAINS
    last = step(root, q, *free)
    root = root - last
    root = root - step(root, q, *free)
    is_closed = ca.mmax(ca.fabs(last) - CLOSED * (1 + ca.fabs(root))) < 0
    is_here = side(root, q, *free) * side(ca.DM(start), at, *free) > 0
    return ca.if_else(ca.logic_and(is_closed, is_here), root, float("nan"))
