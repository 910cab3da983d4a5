"""Which language a program is in, by its ending, and its value."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from casacal.data.text import Table
from casacal.errors import CasacalError, came
from casacal.programs import fanuc, krl, rapid, urscript, yaskawa
from casacal.programs.endings import ENDINGS, is_program
from casacal.programs.program import SUFFIX, Form, Given, TaughtProgram
from casacal.values import Array, FrozenMapping
from casacal.wording import listed


@dataclass(frozen=True)
class Dialect:
    """A language: its reader, its poses, and how it states an arm's configuration.

    configuration: joint values (N, 6; rad) and bits (N, 2: wrist behind axis 1, wrist on the other side of the lower
    arm) -> entries (N, k), as `Target.config` has them. upright: degrees (6,) at which both bits are zero.
    """

    read: Callable[[Mapping[str, str], Given], TaughtProgram]
    form: Form
    configuration: Callable[[Array, Array], Array]
    upright: tuple[float, ...] = (0.0,) * 6
    beside: tuple[str, ...] = ()


RAPID = Dialect(rapid.read, rapid.FORM, rapid.configuration)
KRL = Dialect(krl.read, krl.FORM, krl.configuration, krl.UPRIGHT, (".dat",))
URSCRIPT = Dialect(urscript.read, urscript.FORM, urscript.configuration)
FANUC = Dialect(fanuc.read, fanuc.FORM, fanuc.configuration)
YASKAWA = Dialect(yaskawa.read, yaskawa.FORM, yaskawa.configuration)
DIALECTS: Mapping[str, Dialect] = FrozenMapping(
    {"rapid": RAPID, "krl": KRL, "urscript": URSCRIPT, "fanuc": FANUC, "yaskawa": YASKAWA}
)


def read_program(
    path: str | Path,
    *,
    tools: Mapping[str, Sequence[float]] | None = None,
    bases: Mapping[str, Sequence[float]] | None = None,
    pulses: Sequence[float] | None = None,
) -> TaughtProgram:
    """Read a robot program: RAPID (.mod), KRL (.src with its .dat), URScript (.script), FANUC TP (.ls), Yaskawa (.jbi).

    tools, bases: frames that the program names and does not hold, each as its language writes a pose (URScript: m and a
    rotation vector; RAPID: mm and a quaternion; else mm and three degrees): by the name that it has there, `tcp` for
    URScript's tool before set_tcp, `$tool` and `$base` for KRL's before they are set, `UT1`, `UF1` for FANUC's,
    `TOOL1`, `USER1` for Yaskawa's. The base `world` is where the program's world stands in the problem's base frame,
    the tool `flange` where the controller's flange stands in that of `robot.pose`. pulses: pulses per degree of the
    six axes of a Yaskawa.

    Raises CasacalError for what is no such file or frame. What of a program is not understood is in `puzzles`.
    """
    if not is_program(path):
        endings = f"{listed(list(ENDINGS), 'or')}"
        said = f"'{path}' has the ending of no robot program" if isinstance(path, (str, Path)) else f"Got {came(path)}"
        raise CasacalError(said, f"Name a file that ends in {endings}")
    path = Path(path)
    language = ENDINGS[path.suffix.lower()]
    dialect = DIALECTS[language]
    files = {str(path): _letters(path)}
    for ending in dialect.beside:
        found = [each for each in (path.with_suffix(ending), path.with_suffix(ending.upper())) if each.is_file()]
        if found:
            files[str(found[0])] = _letters(found[0])
    given = Given(
        _frames("tool", tools or {}, dialect.form),
        _frames("base", bases or {}, dialect.form),
        _pulses(pulses, language),
    )
    return dialect.read(files, given)


def joint_table(program: TaughtProgram, names: Container[str], key: str) -> Table:
    """Joint targets with some names as rows of a samples file: their names in a column `key`, and q1_deg to q6_deg."""
    chosen = [each for each in program.targets if each.kind == "joints" and each.name in names]
    rows = tuple((each.name, *(repr(v) for v in np.degrees(each.joints).tolist())) for each in chosen)
    header = (key, *(f"q{k}_deg" for k in range(1, 7)))
    digest = hashlib.sha256("".join(program.texts).encode("latin-1")).hexdigest()
    lines = tuple(each.line for each in chosen)
    return Table(program.paths[0], digest, header, 0, rows, lines, decimal_comma=False)


MOST_BYTES = 1 << 25  # no controller holds a program of such a size


def _letters(path: Path) -> str:
    """A file's bytes as letters; raises CasacalError for what is no program."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise CasacalError(f"'{path}' is larger than any program", "Name a program")
        data = path.read_bytes()
    except OSError as error:
        raise CasacalError(f"'{path}' cannot be read ({error.strerror})", "Check the path") from error
    if b"\x00" in data:
        raise CasacalError(f"'{path}' is not a text file (it holds zero bytes)", "Give the program as text")
    return data.decode("latin-1")


def read_again(program: TaughtProgram, texts: Sequence[str]) -> TaughtProgram:
    """A program with other texts, read as it was."""
    return DIALECTS[program.language].read(dict(zip(program.paths, texts, strict=True)), program.given)


def _frames(kind: Literal["tool", "base"], given: Mapping[str, Sequence[float]], form: Form) -> Mapping[str, Array]:
    """Frames by name in small letters; CasacalError for what is none."""
    found = dict[str, Array]()
    for name, numbers in given.items():
        try:
            if len(numbers) != len(form.units):
                raise CasacalError(f"it has {len(numbers)} numbers", "")
            found[str(name).lower()] = form.pose([float(each) for each in numbers])
        except CasacalError as error:
            raise CasacalError(f"The {kind} '{name}' is not understood: {error.what}", f"Give {form.named}") from None
    return FrozenMapping(found)


def _pulses(pulses: Sequence[float] | None, language: str) -> tuple[float, ...] | None:
    if pulses is None:
        return None
    found = tuple(float(each) for each in pulses)
    if language != "yaskawa":
        raise CasacalError(f"Pulses are for Yaskawa, and this is {SUFFIX[language]}", "Leave them out")
    if len(found) != 6 or not np.isfinite(found).all() or 0.0 in found:
        raise CasacalError(f"Got {len(found)} pulses per degree", "Give six numbers that are not zero, one per axis")
    return found
