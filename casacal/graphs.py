"""CasADi graphs as lines of text: what a file can hold, anybody can read, and no code is run to take back.

A line is an operation: "const 1.5", "input 0 3" (element 3 of argument 0, column by column), or an elementary operation
on values counted by line from 0, such as "sin 4" and "mul 4 5".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from casacal.errors import CasacalError

MOST = 1_000_000  # operations beyond which a graph is no arm's
MOST_PARTS = 500  # arguments and results beyond which it is none either

UNARY = (
    *("assign", "neg", "exp", "log", "sqrt", "sq", "twice", "sin", "cos", "tan", "asin", "acos", "atan", "not"),
    *("floor", "ceil", "fabs", "sign", "erf", "inv", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erfinv"),
    *("log1p", "expm1"),
)
BINARY = (
    *("add", "sub", "mul", "div", "pow", "constpow", "lt", "le", "eq", "ne", "and", "or", "fmod", "copysign"),
    *("if_else_zero", "fmin", "fmax", "atan2", "hypot", "remainder"),
)
NAMES: Mapping[int, str] = {getattr(ca, f"OP_{name.upper()}"): name for name in (*UNARY, *BINARY)}
OPERATIONS: Mapping[str, int] = {name: op for op, name in NAMES.items()}
ARITY = {(name, 1) for name in UNARY} | {(name, 2) for name in BINARY}


@dataclass(frozen=True)
class Operation:
    """One value: an operation on earlier values, a constant, or an element of an argument."""

    op: int
    args: tuple[int, ...] = ()
    constant: float = 0.0
    element: tuple[int, int] = (-1, -1)
    """Argument of the function and position in it, for OP_INPUT."""


def operations_of(function: ca.Function) -> tuple[list[Operation], list[list[int]]]:
    """The operations of an SX function, and the value of each element of each result; raises RuntimeError for MX."""
    operations: list[Operation] = []
    work: dict[int, int] = {}
    results = [[0] * function.numel_out(i) for i in range(function.n_out())]
    for k in range(function.n_instructions()):
        op, read, written = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_OUTPUT:
            results[written[0]][written[1]] = work[read[0]]
            continue
        if op == ca.OP_CONST:
            operations.append(Operation(op, constant=float(function.instruction_constant(k))))
        elif op == ca.OP_INPUT:
            operations.append(Operation(op, element=(read[0], read[1])))
        else:
            operations.append(Operation(op, tuple(work[i] for i in read)))
        work[written[0]] = len(operations) - 1
    return operations, results


def graph_data(function: ca.Function) -> dict[str, Any]:
    """Name, arguments, operations and results of an SX function; raises CasacalError for operations of other kinds."""
    try:
        operations, results = operations_of(function)
    except RuntimeError as error:
        raise CasacalError(f"'{function.name()}' is no graph of operations", "Build it of SX symbols") from error
    lines: list[str] = []
    for each in operations:
        if each.op == ca.OP_CONST:
            lines.append(f"const {each.constant!r}")
        elif each.op == ca.OP_INPUT:
            lines.append(f"input {each.element[0]} {each.element[1]}")
        elif each.op in NAMES:
            lines.append(" ".join((NAMES[each.op], *map(str, each.args))))
        else:
            raise CasacalError(f"'{function.name()}' uses an operation that is not elementary", "Use elementary ones")
    return {
        "name": function.name(),
        "arguments": [[function.name_in(i), *function.size_in(i)] for i in range(function.n_in())],
        "operations": lines,
        "results": [
            {"shape": list(function.size_out(i)), "values": " ".join(map(str, values))}
            for i, values in enumerate(results)
        ],
    }


def graph_from(data: Mapping[str, Any]) -> ca.Function:
    """The function that such data describe; raises CasacalError for what describes none."""
    try:
        if len(data["arguments"]) + len(data["results"]) > MOST_PARTS:
            raise ValueError("it has too many arguments and results")
        symbols = [ca.SX.sym(str(name), _size(rows), _size(columns)) for name, rows, columns in data["arguments"]]
        elements = [ca.vec(symbol).elements() if symbol.numel() else [] for symbol in symbols]
        values = _values(data["operations"], elements)
        results = []
        for result in data["results"]:
            rows, columns = map(_size, result["shape"])
            chosen = [values[_place(word, len(values))] for word in result["values"].split()]
            if len(chosen) != rows * columns:
                raise ValueError("a result has another number of values than its shape")
            results.append(ca.reshape(ca.vertcat(*chosen), rows, columns) if chosen else ca.SX(rows, columns))
        return ca.Function(str(data["name"]), symbols, results)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, RuntimeError, NotImplementedError) as error:
        said = " ".join(str(error).split())[:200]
        raise CasacalError(f"A graph cannot be read: {said}", "Restore the file that holds it") from error


def _values(lines: Sequence[str], elements: Sequence[Sequence[Any]]) -> list[ca.SX]:
    """The value of each line; raises ValueError for a line that is no operation on what stands before it."""
    if len(lines) > MOST:
        raise ValueError(f"it has {len(lines)} operations")
    values: list[ca.SX] = []
    for line in lines:
        name, *words = line.split()
        if name == "const" and len(words) == 1:
            values.append(ca.SX(float(words[0])))
            continue
        if name == "input" and len(words) == 2:
            argument = elements[_place(words[0], len(elements))]
            values.append(ca.SX(argument[_place(words[1], len(argument))]))
            continue
        given = [values[_place(word, len(values))] for word in words]
        if (name, len(given)) not in ARITY:
            raise ValueError(f"'{line[:40]}' is no operation")
        values.append((ca.SX.unary if len(given) == 1 else ca.SX.binary)(OPERATIONS[name], *given))
    return values


def _place(word: str, count: int) -> int:
    if not (word.isascii() and word.isdigit() and int(word) < count):
        raise ValueError(f"'{word}' names no value")
    return int(word)


def _size(number: Any) -> int:
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number <= MOST:
        raise ValueError(f"{number!r} is no size")
    return number
