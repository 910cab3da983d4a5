"""Numbers and lists as people read them: no more digits than a figure deserves."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

LEAST_CHANCE = 1e-6  # chance below which nobody asks how small it is
METRE = 1000.0  # millimetres from which an error is no figure any more: it says that nothing holds the tip
UNBOUNDED = "unbounded"

SMALL_UNITS = {"mm": ("um", 1e3), "rad": ("urad", 1e6), "1": ("parts per million", 1e6)}


def counted(count: int, noun: str = "row") -> str:
    """A number with its noun: "1 row", "2 rows"."""
    return f"{count} {noun}{'' if count == 1 else 'es' if noun.endswith('ch') else 's'}"


def listed(names: Sequence[str], word: str = "and") -> str:
    """Names in a sentence: "a", "a and b", "a, b and c"."""
    return f"{', '.join(names[:-1])} {word} {names[-1]}" if len(names) > 1 else "".join(names)


def shortened(names: Iterable[object], most: int = 12) -> str:
    """The first of many names or line numbers, and how many more there are."""
    every = [str(name) for name in names]
    return ", ".join(every[:most]) + (f" and {len(every) - most} more" if len(every) > most else "")


def numbered_lines(lines: Sequence[int], most: int = 12) -> str:
    """Lines of a file: "line 3", "lines 3, 4 and 10 more"."""
    return f"line{'' if len(lines) == 1 else 's'} {shortened(lines, most)}"


def capital(text: str) -> str:
    """The text with a capital at its beginning."""
    return text[:1].upper() + text[1:]


def lower(text: str) -> str:
    """The text without a capital at its beginning."""
    return text[:1].lower() + text[1:]


def sentence(clause: str) -> str:
    """A clause as a sentence."""
    return f"{capital(clause)}."


def chance(p: float) -> str:
    """A probability under the null hypothesis: "p = 0.03", "p < 1e-06"."""
    return f"p = {p:.2g}" if p >= LEAST_CHANCE else f"p < {LEAST_CHANCE:g}"


def times(ratio: float) -> str:
    """A ratio in two figures."""
    return f"{ratio:,.0f}" if ratio >= 100 else f"{ratio:.2g}"


def figures(value: float, count: int = 3, *, signed: bool = False) -> str:
    """A number in so many significant figures, without an exponent: "0.0123", "120", "4570"."""
    return f"{float(f'{value:.{count}g}'):{'+' if signed else ''}.9f}".rstrip("0").rstrip(".")


def with_spread(value: float, spread: float, most: int) -> tuple[str, str]:
    """A signed number and its spread, with the decimals that leave the spread two figures, and no more than `most`."""
    decimals = min(max(1 - math.floor(math.log10(spread)), 0), most) if 0 < spread < math.inf else most
    return f"{value:+.{decimals}f}", f"{spread:.{decimals}f}"


def mm(value: float, figures: int = 2) -> str:
    """A length in so many significant figures, at least down to a micrometre: "0.62 mm", "9.9 mm", "17 mm"."""
    if math.isnan(value):
        return "unknown"
    if abs(value) >= METRE:
        return "more than 1 m" if math.isfinite(value) else UNBOUNDED
    size = math.floor(math.log10(abs(value))) if value else 0
    decimals = min(max(figures - 1 - size, 0), 4)
    # 0.996 in two figures is 1.0, not 1.00
    if value and math.floor(math.log10(abs(round(value, decimals)) or 1.0)) > size:
        decimals = max(decimals - 1, 0)
    return f"{value:.{decimals}f} mm"


def sized(value: float, unit: str) -> str:
    """A small size in a unit that suits it: "120 um", "35 urad", "10 mrad"."""
    name, factor = SMALL_UNITS.get(unit, (unit, 1.0))
    number = value * factor
    if number >= 1e3 and name in ("um", "urad"):
        name, number = f"m{name[1:]}", number / 1e3
    return f"{number:,.0f} {name}" if number >= 100 else f"{number:.2g} {name}"


def html_table(words: str, header: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """A paragraph and a table as a notebook shows them; what is in them is escaped."""
    cells = "".join(f"<th>{escape(str(name))}</th>" for name in header)
    lines = ["".join(f"<td>{escape(str(value))}</td>" for value in row) for row in rows]
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<p>{escape(words.strip('<>'))}</p><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table>"
