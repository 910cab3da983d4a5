"""Messages of gauges, and a serial line to one by pyserial, which is an extra."""

from __future__ import annotations

import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

from casacal.data.columns import Dimension
from casacal.errors import CasacalError, harmless, refuse_unknown
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
"""Units of a reading with their factors to mm or rad, by dimension; the first is that of a bare number."""

NUMBER = r"(?P<value>[+-]?\s*(?:\d+[.,]?\d*|[.,]\d+))"
UNIT = r"(?P<unit>mm|inch|in|um|\"|deg|\N{DEGREE SIGN}|rad)?"
LONGEST = 200  # bytes of a line that are kept: no reading has more
RETRY = 1.0  # seconds between two attempts to find a lost gauge again
QUIET = 2.0
"""Seconds without a line before one counts that nobody asked for: not what a button sends that is pressed twice, nor
any of a stream. Nobody brings an arm to its next posture in less."""
EVEN = 0.02  # part by which two times between lines of a gauge that sends by the clock differ
HOLD, STREAM = 0.3, 2  # seconds in which so many more lines show that a gauge sends without end, and not its button


@dataclass(frozen=True)
class Gauge:
    """Message format of a gauge: a pattern with the group `value` and, where the unit is sent, the group `unit`.

    errors: pattern of lines that report an error. unit: of readings sent without one; "" stands for mm, of angles for
    degrees. asks: request that makes it send a reading; "" where only its button does.
    """

    name: str
    pattern: str
    errors: str = r"(?!)"
    unit: str = ""
    asks: str = ""

    def refuse_error(self, line: str) -> str:
        """The line stripped of its ends; raises CasacalError where it reports an error."""
        text = line.strip("\x00\r\n\t ")
        if re.fullmatch(self.errors, text, re.IGNORECASE):
            what = f"The gauge says {text!r}, which is an error"
            raise CasacalError(what, "Check the gauge, and send the reading again")
        return text

    def reads(self, line: str) -> bool:
        """Whether a line has the form of a reading; raises CasacalError where it reports an error."""
        return re.fullmatch(self.pattern, self.refuse_error(line), re.IGNORECASE) is not None

    def unit_of(self, kind: Dimension) -> str:
        """The unit of a bare number."""
        return self.unit.lower() if self.unit.lower() in UNITS[kind] else next(iter(UNITS[kind]))

    def reading(self, line: str, kind: Dimension = "length") -> float:
        """The reading of a line in mm or rad, or as a number; CasacalError without one or in another kind of unit."""
        text = self.refuse_error(line)
        found = re.fullmatch(self.pattern, text, re.IGNORECASE)
        if found is None:
            fix = "Look at --gauge and --pattern, or send it again"
            raise CasacalError(f"{text!r} is not a reading of a gauge called {self.name}", fix)
        units = UNITS[kind]
        unit = (found.groupdict().get("unit") or self.unit).lower() or next(iter(units))
        if unit not in units:
            fix = "Give it without a unit" if kind == "number" else f"Give it in {listed(list(units), 'or')}"
            raise CasacalError(f"{text!r} is in {unit}, which is no unit of this reading", fix)
        try:
            value = float(re.sub(r"\s", "", found["value"]).replace(",", ".")) * units[unit]
        except (TypeError, ValueError):  # a pattern of one's own lets through what is no number
            raise CasacalError(f"{text!r} holds no number", "Look at --pattern, or send it again") from None
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
"""Gauges by the name of their protocol."""


def gauge(name: str, *, pattern: str | None = None, unit: str | None = None, asks: str | None = None) -> Gauge:
    """A gauge by name, with one's own pattern, unit or question; CasacalError for a name, unit or pattern not known."""
    refuse_unknown("gauge", [name], GAUGES)
    refuse_unknown("unit", [] if unit is None else [unit], [each for some in UNITS.values() for each in some if each])
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
        known = replace(known, name="of this pattern", pattern=pattern)
    if asks is not None:  # the ends of lines are typed as a backslash and a letter
        known = replace(known, asks=asks.replace("\\r", "\r").replace("\\n", "\n"))
    return replace(known, unit=unit or known.unit)


Parity = Literal["N", "E", "O"]


class SerialLine:
    """Lines that a gauge sends, and questions to it; CasacalError without pyserial, or where the port is not opened."""

    def __init__(self, port: str, *, baud: int = 9600, bits: int = 8, parity: Parity = "N", stops: int = 1) -> None:
        try:
            import serial
        except ImportError:
            raise CasacalError("pyserial is not installed", "Install it with pip install pyserial") from None
        try:
            self._closed = threading.Event()
            self._line: serial.Serial = serial.Serial(port, baud, bits, parity, stops, timeout=0.2)
        except (serial.SerialException, ValueError, OSError) as error:
            said = " ".join(str(error).split())
            raise CasacalError(f"The port {port} cannot be used ({said})", "Check its name and settings") from None

    def ask(self, text: str, inbox: Inbox) -> None:
        """Send something, such as a request for a reading; where the line is gone, a note in an inbox says so."""
        try:
            self._line.write(text.encode("ascii", errors="replace"))
        except OSError as error:
            inbox.note(f"The gauge cannot be asked ({error}). Plug it in again, or type the readings")

    def lines(self) -> Iterator[str]:
        """Lines as they come, ended by a carriage return, a line feed or both; ends when the line is closed or gone."""
        held = b""
        while True:
            try:
                held += self._line.read(self._line.in_waiting or 1)
            except (OSError, TypeError):  # pyserial's word for a port that was closed meanwhile
                return
            *whole, held = held.replace(b"\r", b"\n").split(b"\n")
            held = held[-LONGEST:]
            for line in whole:
                if line.strip():
                    yield harmless(line[-LONGEST:].decode("ascii", errors="replace"))

    def listen(self, inbox: Inbox) -> None:
        """Put what comes into an inbox until `close`; says there when the gauge is gone and when it is back."""
        while True:
            for line in self.lines():
                inbox.send(line)
            if self._closed.is_set():
                return
            inbox.note(f"The gauge at {self._line.port} is gone. Plug it in again, or type the readings")
            self._line.close()
            while not self._line.is_open:
                with suppress(OSError, ValueError, TypeError):
                    self._line.open()
                if not self._line.is_open and self._closed.wait(RETRY):
                    return
            inbox.note("The gauge is back")

    def close(self) -> None:
        """Give the port back."""
        self._closed.set()
        self._line.close()


class Entry(NamedTuple):
    """One input: a typed line, a line from a gauge, or a note to the operator."""

    text: str
    source: Literal["typed", "sent", "note"] = "typed"


class Inbox:
    """Inputs from keyboard and gauge while a reading is awaited; the keyboard comes first.

    Of a gauge at most one line waits. It counts only if it came after the prompt, and either `QUIET` seconds after the
    gauge's line before it or after `take_next`; of a line that nobody asked for it is seen, for `HOLD` seconds, whether
    it begins a stream. What does not count is dropped, and one note for each prompt says so.
    """

    def __init__(self, *, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._came = now, threading.Condition()
        self._typed, self._notes = deque[str | None](), deque[str]()
        self._sent: str | None = None
        self._last, self._quiet, self._due, self._more = -math.inf, math.inf, 0.0, 0
        self._open, self._wanted, self._noted = False, False, False

    def type(self, line: str | None) -> None:
        """A line of the keyboard; None where there will be no more."""
        with self._came:
            self._typed.append(line)
            self._came.notify()

    def send(self, line: str) -> None:
        """A line of the gauge."""
        with self._came:
            before, quiet, self._last = self._quiet, self._now() - self._last, self._now()
            self._quiet, even = quiet, abs(quiet - before) < EVEN * quiet  # a slow stream, as no hand presses
            if self._open and (self._wanted or (quiet >= QUIET and not even)):
                self._sent, self._open, self._more = line, False, 0
                self._due = self._last + (0.0 if self._wanted else HOLD)
            else:
                awaited, self._more = self._open or self._sent is not None, self._more + 1
                if self._sent is not None and self._more >= STREAM and self._last < self._due:
                    self._sent, self._open = None, True
                if not self._noted:
                    why = f"{quiet:.1f} s after another line" if awaited else "before it was asked for"
                    self._notes.append(
                        f"Not taken: {line.strip()}, which the gauge sent {why}. Send it again after {QUIET:g} s, or "
                        "press Enter to take its next line"
                    )
                self._noted = True
            self._came.notify()

    def note(self, words: str) -> None:
        """Something that the operator is to know."""
        with self._came:
            self._notes.append(words)
            self._came.notify()

    def prompted(self) -> None:
        """From now on a reading is waited for."""
        with self._came:
            self._sent, self._open, self._wanted, self._noted = None, True, False, False

    def take_next(self) -> None:
        """Accept the gauge's next line, even one of a stream."""
        with self._came:
            self._sent, self._wanted, self._open = None, True, True

    def next(self) -> Entry | None:
        """Wait for what comes; None at the end of the keyboard's lines."""
        with self._came:
            while not self._typed and (self._sent is None or self._now() < self._due):
                if self._sent is None and self._notes:
                    return Entry(self._notes.popleft(), "note")
                self._came.wait(None if self._sent is None else max(self._due - self._now(), 0.0))
            if self._typed:
                typed = self._typed.popleft()
                return None if typed is None else Entry(typed)
            sent, self._sent = self._sent, None
            return Entry(sent or "", "sent")
