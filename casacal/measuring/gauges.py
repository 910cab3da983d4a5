"""What gauges send, and a serial line to one by pyserial, which is an extra."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from casacal.errors import CasacalError, refuse_unknown
from casacal.instruments.description import Dimension
from casacal.wording import listed

if TYPE_CHECKING:
    import serial


INCH = 25.4
DEGREE = math.pi / 180
UNITS: Mapping[Dimension, Mapping[str, float]] = {
    "length": {"mm": 1.0, "in": INCH, '"': INCH, "inch": INCH, "um": 1e-3},
    "angle": {"deg": DEGREE, "\N{DEGREE SIGN}": DEGREE, "rad": 1.0},
    "number": {"": 1.0},
}
"""What may follow a reading, with its factor to mm or rad, by what is read; first what a bare number is in."""

NUMBER = r"(?P<value>[+-]?\s*(?:\d+[.,]?\d*|[.,]\d+))"
UNIT = r"(?P<unit>mm|inch|in|um|\"|deg|\N{DEGREE SIGN}|rad)?"


@dataclass(frozen=True)
class Gauge:
    """How a gauge says a reading: a pattern with the groups `value` and, where it says it, `unit`; else it is `unit`.

    errors: a pattern of lines by which it says that there is none. unit: "" stands for mm, of angles for degrees. asks:
    what makes it send one; "" where only its button does.
    """

    name: str
    pattern: str
    errors: str = r"(?!)"
    unit: str = ""
    asks: str = ""

    def refuse_error(self, line: str) -> str:
        """A line without its ends; raises CasacalError where it says that there is no reading."""
        text = line.strip("\x00\r\n\t ")
        if re.fullmatch(self.errors, text, re.IGNORECASE):
            fix = "Check the gauge, and send the reading again"
            raise CasacalError(f"The gauge says {text!r}, which is an error", fix)
        return text

    def reads(self, line: str) -> bool:
        """Whether a line has the form of a reading; raises CasacalError where it says that there is none."""
        return re.fullmatch(self.pattern, self.refuse_error(line), re.IGNORECASE) is not None

    def reading(self, line: str, kind: Dimension = "length") -> float:
        """The reading of a line, mm, rad or as it is; raises CasacalError where there is none, or in another's unit."""
        text = self.refuse_error(line)
        found = re.fullmatch(self.pattern, text, re.IGNORECASE)
        if found is None:
            fix = "Look at --gauge and --pattern, or send it again"
            raise CasacalError(f"{text!r} is not a reading of a gauge called {self.name}", fix)
        units = UNITS[kind]
        unit = (found.groupdict().get("unit") or self.unit).lower() or next(iter(units))
        if unit not in units:
            fix = f"Give it in {listed(list(units), 'or')}" if kind != "number" else "Give it without a unit"
            raise CasacalError(f"{text!r} is in {unit}, which is no unit of this reading", fix)
        value = float(re.sub(r"\s", "", found["value"]).replace(",", ".")) * units[unit]
        if not math.isfinite(value):
            raise CasacalError(f"{text!r} is not a finite reading", "Send it again")
        return value


GAUGES: Mapping[str, Gauge] = {
    "plain": Gauge("plain", rf"{NUMBER}\s*,?\s*{UNIT}"),
    # channel, "A" for data, sign, digits and point; "911" and the like for errors
    "digimatic": Gauge("digimatic", rf"\d{{2}}A{NUMBER}\s*{UNIT}", r"9\d[0-9]?|\d{2}[B-Z].*"),
    # sign or blank, digits, point, digits; "ERR" and a number for errors; "?" and a carriage return ask for one
    "sylvac": Gauge("sylvac", rf"{NUMBER}\s*{UNIT}\s*[<=>]?", r"ERR\s*\d*", asks="?\r"),
}
"""By the name of what makers have in common."""


def gauge(name: str, *, pattern: str | None = None, unit: str | None = None, asks: str | None = None) -> Gauge:
    """A gauge by name, with one's own pattern, unit or question in place of its own.

    Raises CasacalError for a name or unit that there is not, and for a pattern that is none or has no group `value`.
    """
    refuse_unknown("gauge", [name], GAUGES)
    known_units = [each for units in UNITS.values() for each in units if each]
    refuse_unknown("unit", [] if unit is None else [unit], known_units)
    known = GAUGES[name]
    if pattern is not None:
        try:
            groups = re.compile(pattern).groupindex
        except re.error as error:
            raise CasacalError(f"The pattern {pattern!r} is none ({error})", "Write a regular expression") from None
        if "value" not in groups:
            fix = "Write (?P<value>...) around the number"
            raise CasacalError(f"The pattern {pattern!r} has no group 'value'", fix)
        known = Gauge("of this pattern", pattern)
    if asks is not None:  # the ends of lines are typed as a backslash and a letter
        known = replace(known, asks=asks.replace("\\r", "\r").replace("\\n", "\n"))
    return replace(known, unit=unit or known.unit)


Parity = Literal["N", "E", "O"]


class SerialLine:
    """Lines that a gauge sends, and questions to it.

    port: such as COM3 or /dev/ttyUSB0. baud, bits, parity, stops: as the gauge's page says. Raises CasacalError where
    pyserial is missing or the port cannot be opened.
    """

    def __init__(self, port: str, *, baud: int = 9600, bits: int = 8, parity: Parity = "N", stops: int = 1) -> None:
        try:
            import serial
        except ImportError:
            raise CasacalError("pyserial is not installed", "Install it with pip install pyserial") from None
        try:
            self._line: serial.Serial = serial.Serial(port, baud, bits, parity, stops, timeout=0.2)
        except (serial.SerialException, ValueError, OSError) as error:
            said = " ".join(str(error).split())
            raise CasacalError(f"The port {port} cannot be used ({said})", "Check its name and settings") from None

    def ask(self, text: str) -> None:
        """Send something, such as a request for a reading; raises CasacalError when the line is gone."""
        try:
            self._line.write(text.encode("ascii", errors="replace"))
        except OSError as error:
            fix = "Plug it in again and continue"
            raise CasacalError(f"The connection to the gauge was lost ({error})", fix) from None

    def lines(self) -> Iterator[str]:
        """Lines as they come, ended by a carriage return, a line feed or both; ends when the line is closed or gone."""
        held = b""
        while True:
            try:
                held += self._line.read(self._line.in_waiting or 1)
            except (OSError, TypeError):  # pyserial's word for a port that was closed meanwhile
                return
            held = held.replace(b"\r", b"\n")
            while b"\n" in held:
                line, _, held = held.partition(b"\n")
                if line.strip():
                    yield line.decode("ascii", errors="replace")

    def close(self) -> None:
        """Give the port back."""
        self._line.close()
