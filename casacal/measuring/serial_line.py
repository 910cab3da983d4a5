"""A serial line to a gauge, by pyserial, which is an extra."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal

from casacal.errors import CasacalError

if TYPE_CHECKING:
    import serial

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
            raise CasacalError("pyserial is not installed", 'Install it with pip install "casacal[serial]"') from None
        try:
            self._line: serial.Serial = serial.Serial(port, baud, bits, parity, stops, timeout=0.2)
        except (serial.SerialException, ValueError, OSError) as error:
            said = " ".join(str(error).split())
            raise CasacalError(f"The port {port} cannot be used ({said})", "Look at its name and settings") from None

    def ask(self, text: str) -> None:
        """Send something, such as a request for a reading; raises CasacalError when the line is gone."""
        try:
            self._line.write(text.encode("ascii", errors="replace"))
        except OSError as error:
            raise CasacalError(f"The gauge's line is gone ({error})", "Plug it in again and go on") from None

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
