"""Operations of a program, each once and in its cheapest form: the algebra that saves work in every lane.

CasADi's derivatives are exact but know no trigonometric identity and no difference between parameters and data. The
rules here do; each keeps the value to rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from itertools import product
from typing import Literal, NamedTuple, TypeAlias

import casadi as ca

from casacal.graphs import Operation

Role: TypeAlias = Literal["once", "lane"]
Kind: TypeAlias = Literal["constant", "once", "lane", "mixed"]

TRIGONOMETRIC = (ca.OP_SIN, ca.OP_COS)

COMMUTATIVE = (ca.OP_ADD, ca.OP_MUL, ca.OP_FMIN, ca.OP_FMAX, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_HYPOT)

FEW = 3  # values that an output may be the sum of, times factors, to be written as that sum


class Signed(NamedTuple):
    """A value and its sign in a sum."""

    sign: int
    value: int


class Builder:
    """Collects operations, each once and in its cheapest form."""

    def __init__(self, roles: Sequence[Role], ahead: bool) -> None:
        self.roles, self.ahead = roles, ahead
        self.operations: list[Operation] = []
        self.kinds: list[Kind] = []
        self._known: dict[Operation, int] = {}
        self._sums: dict[int, dict[int, int]] = {}

    def add(self, operation: Operation) -> int:
        """An operation as it is: the value it makes."""
        if operation not in self._known:
            self._known[operation] = len(self.operations)
            self.operations.append(operation)
            self.kinds.append(self._kind(operation))
        return self._known[operation]

    def constant(self, value: float) -> int:
        """A number."""
        return self.add(Operation(ca.OP_CONST, constant=float(value)))

    def apply(self, op: int, *args: int) -> int:
        """An operation on earlier values, rewritten where a rule applies."""
        if op in TRIGONOMETRIC:
            parts = self._summands(args[0])
            if parts is not None:
                return self._of_sum(op, *parts)
        if op == ca.OP_DIV and self._depends_on_lane(args[0]) and not self._depends_on_lane(args[1]):
            return self.apply(ca.OP_MUL, args[0], self.apply(ca.OP_INV, args[1]))  # one division for all lanes
        if op in (ca.OP_ADD, ca.OP_SUB):
            turned = self._slope_of_rotation(op, *args)
            if turned is not None:
                return turned
        return self.add(Operation(op, tuple(sorted(args)) if op in COMMUTATIVE else args))

    def _kind(self, operation: Operation) -> Kind:
        if operation.op == ca.OP_CONST:
            return "constant"
        if operation.op == ca.OP_INPUT:
            return self.roles[operation.element[0]]
        kinds = {self.kinds[arg] for arg in operation.args} - {"constant"}
        if not kinds:
            return "once"
        kind = kinds.pop() if len(kinds) == 1 else "mixed"
        return "mixed" if kind == "lane" and not self.ahead else kind

    def _summands(self, value: int) -> tuple[int, int] | None:
        """A mixed value as a sum of parameters and data, when it is one."""
        if self.kinds[value] != "mixed":
            return None
        operation = self.operations[value]
        if operation.op not in (ca.OP_ADD, ca.OP_SUB):
            return None
        once = lane = zero = self.constant(0.0)
        for arg, minus in zip(operation.args, (False, operation.op == ca.OP_SUB), strict=True):
            pair = (zero, arg) if self.kinds[arg] == "lane" else (arg, zero)
            if self.kinds[arg] == "mixed":
                inner = self._summands(arg)
                if inner is None:
                    return None
                pair = inner
            once, lane = self._sum(once, pair[0], minus), self._sum(lane, pair[1], minus)
        return once, lane

    def _sum(self, one: int, other: int, minus: bool) -> int:
        zero = self.constant(0.0)
        if other == zero:
            return one
        if one == zero:
            return self.apply(ca.OP_NEG, other) if minus else other
        return self.apply(ca.OP_SUB if minus else ca.OP_ADD, one, other)

    def _of_sum(self, op: int, once: int, lane: int) -> int:
        """sin(a + b) = sin a cos b + cos a sin b; cos(a + b) = cos a cos b - sin a sin b."""
        (sin_a, cos_a), (sin_b, cos_b) = (
            (self.add(Operation(ca.OP_SIN, (part,))), self.add(Operation(ca.OP_COS, (part,)))) for part in (once, lane)
        )
        if op == ca.OP_SIN:
            return self.apply(ca.OP_ADD, self.apply(ca.OP_MUL, sin_a, cos_b), self.apply(ca.OP_MUL, cos_a, sin_b))
        return self.apply(ca.OP_SUB, self.apply(ca.OP_MUL, cos_a, cos_b), self.apply(ca.OP_MUL, sin_a, sin_b))

    def flat(self, value: int) -> int:
        """A mixed value as a sum of at most `FEW` others times factors of parameters alone; itself where it is none."""
        parts = self._linear(value)
        if value in parts:
            return value
        products = [self.apply(ca.OP_MUL, factor, other) for other, factor in parts.items()]
        return reduce(lambda one, other: self.add(Operation(ca.OP_ADD, tuple(sorted((one, other))))), products)

    def _linear(self, value: int) -> dict[int, int]:
        """Values, and the factors of parameters alone with which they add up to a value; found once for each."""
        if value not in self._sums:
            self._sums[value] = self._taken_apart(value)
        return self._sums[value]

    def _taken_apart(self, value: int) -> dict[int, int]:
        operation, itself = self.operations[value], {value: self.constant(1.0)}
        if self.kinds[value] != "mixed":
            return itself
        args = operation.args
        if operation.op in (ca.OP_NEG, ca.OP_TWICE):
            parts = {k: self.apply(operation.op, f) for k, f in self._linear(args[0]).items()}
        elif operation.op == ca.OP_MUL and not all(self._depends_on_lane(arg) for arg in args):
            inner, factor = args if self._depends_on_lane(args[0]) else (args[1], args[0])
            parts = {k: self.apply(ca.OP_MUL, factor, f) for k, f in self._linear(inner).items()}
        elif operation.op in (ca.OP_ADD, ca.OP_SUB) and all(self._depends_on_lane(arg) for arg in args):
            parts = dict(self._linear(args[0]))
            for k, f in self._linear(args[1]).items():
                parts[k] = self.apply(operation.op, parts.get(k, self.constant(0.0)), f)
        else:  # a shift by parameters alone stays: taken apart, it would cost digits
            return itself
        return parts if len(parts) <= FEW else itself

    def _depends_on_lane(self, value: int) -> bool:
        return self.kinds[value] in ("lane", "mixed")

    def _slope_of_rotation(self, op: int, one: int, other: int) -> int | None:
        """c (p a - q b) - s (p b + q a) as p (c a - s b) - q (c b + s a), where what is in brackets is known already.

        The slope by an angle as reverse differentiation finds it, and as a cross product of vectors that the function
        itself has turned: 3 operations in place of 9. With any signs.
        """
        minus = -1 if op == ca.OP_SUB else 1
        for (c, inner), (s, outer) in product(self._factors(one), self._factors(other)):
            for (p, a, q, b), (p2, b2, q2, a2) in product(self._products(inner), self._products(outer)):
                if (p.value, q.value, a, b) != (p2.value, q2.value, a2, b2):
                    continue
                first = self._known_sum(p.sign, c, a, minus * p2.sign, s, b)
                second = self._known_sum(q.sign, c, b, minus * q2.sign, s, a)
                if first is not None and second is not None:
                    return self._signed_sum(first, p.value, second, q.value)
        return None

    def _factors(self, value: int) -> Iterator[tuple[int, int]]:
        """A product's factors, either way round."""
        operation = self.operations[value]
        if operation.op == ca.OP_MUL:
            yield operation.args[0], operation.args[1]
            yield operation.args[1], operation.args[0]

    def _products(self, value: int) -> Iterator[tuple[Signed, int, Signed, int]]:
        """A sum of two products, (p, a, q, b) for every way to write it as +-p a +-q b."""
        operation = self.operations[value]
        if operation.op not in (ca.OP_ADD, ca.OP_SUB):
            return
        signs = (1, -1 if operation.op == ca.OP_SUB else 1)
        for (p, a), (q, b) in product(*(self._factors(arg) for arg in operation.args)):
            yield Signed(signs[0], p), a, Signed(signs[1], q), b
            yield Signed(signs[1], q), b, Signed(signs[0], p), a

    def _known_sum(self, sign: int, c: int, a: int, other_sign: int, s: int, b: int) -> Signed | None:
        """sign c a + other_sign s b, if it or its negative is known."""
        one, other = (self._known.get(Operation(ca.OP_MUL, tuple(sorted(pair)))) for pair in ((c, a), (s, b)))
        if one is None or other is None:
            return None
        if sign == other_sign:
            known = self._known.get(Operation(ca.OP_ADD, tuple(sorted((one, other)))))
            return None if known is None else Signed(sign, known)
        for first, second, found in ((one, other, sign), (other, one, other_sign)):
            known = self._known.get(Operation(ca.OP_SUB, (first, second)))
            if known is not None:
                return Signed(found, known)
        return None

    def _signed_sum(self, first: Signed, p: int, second: Signed, q: int) -> int:
        one, other = self.apply(ca.OP_MUL, p, first.value), self.apply(ca.OP_MUL, q, second.value)
        if first.sign == second.sign:
            total = self.add(Operation(ca.OP_ADD, tuple(sorted((one, other)))))
            return total if first.sign > 0 else self.add(Operation(ca.OP_NEG, (total,)))
        return self.add(Operation(ca.OP_SUB, (one, other) if first.sign > 0 else (other, one)))
