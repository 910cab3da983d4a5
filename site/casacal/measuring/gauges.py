"""What gauges send, and a serial line to one by pyserial, which is an extra."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from casacal.errors import CasacalError, refuse_unknown

if TYPE_CHECKING:
    import serial


INCH = 25.4
UNITS: Mapping[str, float] = {"mm": 1.0, "in": INCH, '"': INCH, "inch": INCH, "um": 1e-3}

NUMBER = r"(?P<value>[+-]?\s*(?:\d+[.,]?\d*|[.,]\d+))"
UNIT = r"(?P<unit>mm|inch|in|um|\")?"


@dataclass(frozen=True)
class Gauge:
    """How a gauge says a reading: a pattern with the groups `value` and, where it says it, `unit`; else it is `unit`.

    errors: a pattern of lines by which it says that there is none. asks: what makes it send one; "" where only its
    button does.
    """

    name: str
    pattern: str
    errors: str = r"(?!)"
    unit: str = "mm"
    asks: str = ""

    def refuse_error(self, line: str) -> str:
        """A line without its ends; raises CasacalError where it says that there is no reading."""
        text = line.strip("\x00\r\n\t ")
        if re.fullmatch(self.errors, text, re.IGNORECASE):
            raise CasacalError(
                f"The gauge says {text!r}, which is an error", "Check the gauge, and send the reading again"
            )
        return text

    def reading(self, line: str) -> float:
        """The reading of a line, mm; raises CasacalError where there is none."""
        text = self.refuse_error(line)
        found = re.fullmatch(self.pattern, text, re.IGNORECASE)
        if found is None:
            raise CasacalError(
                f"{text!r} is not a reading of a gauge called {self.name}",
                "Look at --gauge and --pattern, or send it again",
            )
        said = found.groupdict().get("unit")
        value = float(re.sub(r"\s", "", found["value"]).replace(",", ".")) * UNITS[(said or self.unit).lower()]
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
    refuse_unknown("unit", [] if unit is None else [unit], UNITS)
    known = GAUGES[name]
    if pattern is not None:
        try:
            groups = re.compile(pattern).groupindex
        except re.error as error:
            raise CasacalError(f"The pattern {pattern!r} is none ({error})", "Write a regular expression") from None
        if "value" not in groups:
            raise CasacalError(
                f"The pattern {pattern!r} has no group 'value'", "Write (?P<value>...) around the number"
            )
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
            raise CasacalError(
                f"The connection to the gauge was lost ({error})", "Plug it in again and continue"
            ) from None

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
