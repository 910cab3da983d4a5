"""Damaged files of every kind that casacal reads: each is read, or refused in one sentence, soon and in little memory.

    python tests/fuzz.py --kind csv --files 2000 --seed 0 --keep folder

A kind is a maker of well-formed files and a reader; add one to KINDS. A damaged file passes when its reader returns or
raises a CasacalError of one line, within ten seconds and two gigabytes. Any other is saved where --keep says.
"""

import argparse
import contextlib
import io
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import fuzz_arms
import fuzz_seeds
import numpy as np
from seals import resealed_text

from casacal.data.samples import Layout, Samples
from casacal.errors import CasacalError

SECONDS = 10.0
MEMORY = 2 << 30
LAYOUT = Layout(("angle", "length"), {"reading": "length"}, ("plane",))

Mutation = Callable[[bytes, random.Random, tuple[bytes, ...]], bytes]


class TooSlowError(BaseException):
    """Raised in a reader whose time is over; no `except Exception` keeps it."""


def mutated(data: bytes, rng: random.Random, tokens: tuple[bytes, ...]) -> bytes:
    """Bytes with one to four damages: flipped, put in, taken out, cut off, said twice, moved, or a token put in."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at, some = rng.randrange(len(data) + 1), rng.choice((1, 1, 2, 8, 64, 512))
        before, here, after = data[:at], data[at : at + some], data[at + some :]
        token = rng.choice(tokens) if tokens else rng.randbytes(some)
        data = rng.choice(
            (
                before + bytes(byte ^ (1 << rng.randrange(8)) for byte in here[:1]) + here[1:] + after,
                before + rng.randbytes(len(here)) + after,
                before + rng.randbytes(min(some, 8)) + here + after,
                before + after,
                before,
                after,
                before + here * rng.choice((2, 3, 50)) + after,
                before + after + here,
                before + token + here + after,
                before + token + here[len(token) :] + after,
                before + token * rng.choice((2, 5, 300)) + here + after,
            )
        )
    return data


def mutated_lines(data: bytes, rng: random.Random, tokens: tuple[bytes, ...]) -> bytes:
    """Bytes of text with damages of lines and cells, or those of `mutated`."""
    if rng.random() < 0.3:
        return mutated(data, rng, tokens)
    for _ in range(rng.choice((1, 1, 2, 3))):
        end = rng.choice((b"\r\n", b"\n", b"\r")) if rng.random() < 0.1 else b"\n"
        lines = data.split(end)
        row, other = rng.randrange(len(lines)), rng.randrange(len(lines))
        delimiter = max((b",", b";", b"\t"), key=lines[row].count)
        cells = lines[row].split(delimiter)
        place, token = rng.randrange(len(cells)), rng.choice(tokens)
        what = rng.randrange(11)
        if what == 0:
            del cells[place]
        elif what == 1:
            cells.insert(place, rng.choice((token, b"", b"7")))
        elif what <= 5:
            cells[place] = rng.choice((token, cells[place] + token, token + cells[place], b'"' + cells[place] + b'"'))
        lines[row] = delimiter.join(cells)
        if what == 6:
            lines.insert(row, rng.choice((token, b"", b"  ", b"# a, remark, of, four, five", lines[other], lines[0])))
        elif what == 7:
            lines[row], lines[other] = lines[other], lines[row]
        elif what == 8:
            lines = lines[: row + 1]
        elif what == 9:
            lines[row] = rng.choice((token, b" ", b"\t")) + lines[row] + rng.choice((b"", b",", b" ", token))
        elif what == 10 and rng.random() < 0.1:
            lines[row] += token * 50_000
        data = end.join(lines)
    return data


def mutated_members(data: bytes, rng: random.Random, tokens: tuple[bytes, ...]) -> bytes:
    """Bytes of a zip archive, one of whose members is damaged; or damaged itself."""
    if rng.random() < 0.3:
        return mutated(data, rng, (b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06", b"\xff\xff\xff\xff", b"\0\0\0\0"))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(sorted(members))
    if rng.random() < 0.05:
        del members[name]
    else:
        members[name] = mutated(members[name], rng, tokens)
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return whole.getvalue()


def mutated_result(data: bytes, rng: random.Random, tokens: tuple[bytes, ...]) -> bytes:
    """Bytes with damages, most of them sealed anew, so that they come to what looks behind the seal."""
    damaged = mutated(data, rng, tokens)
    return resealed_text(damaged) if rng.random() < 0.8 else damaged


@dataclass(frozen=True)
class Kind:
    """A kind of file: a maker of well-formed ones in a folder, a reader, what the format is made of, how it is damaged.

    quick: how many files the test suite tries.
    """

    seeds: Callable[[Path], list[Path]]
    read: Callable[[Path], object]
    tokens: tuple[bytes, ...] = ()
    mutate: Mutation = mutated
    quick: int = 60


def read_samples(path: Path) -> Samples:
    """Samples of a file."""
    return Samples.from_file(path, LAYOUT)


def one_line(error: CasacalError) -> None:
    """Raise AssertionError unless a refusal is one line that can be shown."""
    assert len(str(error).splitlines()) == 1, f"a refusal of several lines: {error!r:.300}"
    assert len(str(error)) < 5000, f"a refusal of {len(str(error))} letters"


KINDS: Mapping[str, Kind] = {
    "csv": Kind(fuzz_seeds.csv_files, read_samples, fuzz_seeds.CSV_TOKENS, mutated_lines, 150),
    "npy": Kind(fuzz_seeds.npy_files, read_samples, fuzz_seeds.NPY_TOKENS, quick=150),
    "npz": Kind(fuzz_seeds.npz_files, read_samples, fuzz_seeds.NPY_TOKENS, mutated_members, 100),
    "urdf": Kind(fuzz_arms.urdf_files, fuzz_arms.read_arm, fuzz_arms.URDF_TOKENS, quick=250),
    "dh": Kind(fuzz_arms.dh_files, fuzz_arms.read_arm, fuzz_arms.TABLE_TOKENS, mutated_lines, 200),
    "result": Kind(fuzz_arms.result_files, fuzz_arms.use_result, fuzz_arms.RESULT_TOKENS, mutated_result, 60),
    "joints": Kind(fuzz_arms.joint_files, fuzz_arms.read_joint_values, fuzz_seeds.CSV_TOKENS, mutated_lines, 100),
    "targets": Kind(fuzz_arms.target_files, fuzz_arms.read_target_poses, fuzz_seeds.CSV_TOKENS, mutated_lines, 100),
    "pendant": Kind(fuzz_arms.pendant_files, fuzz_arms.read_pendant, fuzz_seeds.CSV_TOKENS, mutated_lines, 100),
    "xlsx": Kind(fuzz_seeds.xlsx_files, read_samples, fuzz_seeds.XLSX_TOKENS, mutated_members, 40),
}


@dataclass
class Figures:
    """What came of damaged files: how many were read, refused (by the first words of what was said), or failed."""

    read: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    failed: list[str] = field(default_factory=list)
    slowest: float = 0.0
    memory: int = 0


def fuzz(kind: Kind, files: int, seed: int, keep: Path | None = None) -> Figures:
    """Read so many damaged files of a kind; what fails is saved to `keep`."""
    figures = Figures()
    with tempfile.TemporaryDirectory() as place:
        seeds = [(path, path.read_bytes()) for path in sorted(kind.seeds(Path(place)))]
        for path, _ in seeds:
            kind.read(path)  # well-formed files are read, or nothing is tried at all
        base = memory()
        for number in range(files):
            rng = random.Random(f"{seed} {number}")
            path, data = rng.choice(seeds)
            damaged = path.with_stem(f"damaged_{number}")
            damaged.write_bytes(kind.mutate(data, rng, kind.tokens))
            began = time.perf_counter()
            why = said_of(kind, damaged, figures)
            figures.slowest = max(figures.slowest, time.perf_counter() - began)
            figures.memory = max(figures.memory, grown := memory() - base)
            if grown > MEMORY:
                why = why or f"{grown >> 20} MB of memory"
                base = memory()
            if why:
                figures.failed.append(f"{damaged.name}: {why}")
                if keep:
                    keep.mkdir(parents=True, exist_ok=True)
                    shutil.copy(damaged, keep)
                    (keep / f"{damaged.name}.txt").write_text(why)
            damaged.unlink()
    return figures


def said_of(kind: Kind, path: Path, figures: Figures) -> str | None:
    """What is wrong with how a file was read; None where it was read or refused as it should be."""
    try:
        with limited():
            kind.read(path)
        figures.read += 1
    except CasacalError as error:
        try:
            one_line(error)
        except AssertionError as said:
            return str(said)
        figures.refused[re.sub(r"\d+|'.*'", "_", str(error).split(": ")[-1])[:60]] += 1
    except TooSlowError:
        return f"more than {SECONDS:g} s"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return "".join(traceback.format_exception(error)[-3:])
    return None


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Raise TooSlowError when time is over."""

    def over(number: int, frame: object) -> None:
        raise TooSlowError

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def memory() -> int:
    """The most memory that this process has held, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    np.seterr(all="ignore")
    resource.setrlimit(resource.RLIMIT_AS, (3 * MEMORY, resource.RLIM_INFINITY))  # the machine is not to be fuzzed
    began = time.perf_counter()
    found = fuzz(KINDS[given.kind], given.files, given.seed, given.keep)
    seconds = time.perf_counter() - began
    sys.stdout.write(
        f"{given.kind}: {given.files} files in {seconds:.0f} s: {found.read} read, {found.refused.total()} refused, "
        f"{len(found.failed)} failed; slowest {found.slowest:.2f} s, {found.memory >> 20} MB more memory\n"
    )
    sys.stdout.writelines(f"  {count:6d}  {words}\n" for words, count in found.refused.most_common(25))
    sys.stdout.writelines(f"{words[:1000]}\n" for words in found.failed[:4])
    return 1 if found.failed else 0


if __name__ == "__main__":
    sys.exit(main())
