"""Small files that would cost a machine: each is read or refused in a sentence, in seconds and without its memory."""

import io
import re
import zipfile

import numpy as np
import pytest
from fuzz import MEMORY, Figures, Kind, memory, mutated, read_samples, said_of
from openpyxl import Workbook

from casacal.errors import SamplesError

HEADER = "q1_deg,q2_mm,reading_um,plane,note\n"
ROW = "1.5,2.5,3.5,left,n\n"
MANY = 3 << 20
TEXTS = {
    "blank lines": "\n" * MANY,
    "blank lines first": "\r\n" * (MANY // 2) + HEADER + ROW,
    "comments": "#\n" * (MANY // 2) + HEADER + ROW,
    "columns": ",".join(f"a{k}" for k in range(200_000)),
    "cells": HEADER + "," * MANY,
    "quotes": HEADER + '"' * MANY,
    "digits": HEADER + "1" * 120_000 + "x" + ROW,
    "a long line": HEADER + "1.5,2.5,3.5,left," + "x" * MANY,
    "a long name": "q" * MANY + "\n1\n",
}


def hold(path):
    """Fail unless a file is read or refused as it should be."""
    before, figures = memory(), Figures()
    wrong = said_of(Kind(lambda folder: [], read_samples, mutate=mutated), path, figures)
    assert wrong is None, wrong
    assert memory() - before < MEMORY
    return figures


@pytest.mark.parametrize("name", TEXTS)
def test_text(tmp_path, name):
    (tmp_path / "s.csv").write_text(TEXTS[name], newline="")
    assert hold(tmp_path / "s.csv").read == ("first" in name or name == "comments")


def sheet(path, cells=b"", *, styles=b""):
    """A workbook of one row of samples, with more at the end of its sheet or of its styles."""
    book, whole = Workbook(), io.BytesIO()
    book.active.append(HEADER.strip().split(","))
    book.active.append([1, 2, 3, "left", ""])
    book.save(whole)
    ends = {"xl/worksheets/sheet1.xml": (b"</sheetData>", cells), "xl/styles.xml": (b"</fonts>", styles)}
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        for name in old.namelist():
            end, more = ends.get(name, (b"", b""))
            new.writestr(name, old.read(name).replace(end, more + end) if more else old.read(name))
    return path


@pytest.mark.parametrize(
    ("cells", "styles", "words"),
    [
        (b'<row r="9"><c r="XFD9"/></row>', b"", None),
        (b'<row r="999999999999"><c r="A1"/></row>', b"", "out of order"),
        (b"".join(b'<row r="%d"><c r="XFD%d"/></row>' % (k, k) for k in range(9, 3000)), b"", "20,000,000 cells"),
        (b"<row>" + b"<c/>" * 2_000_000 + b"</row>", b"", "more than 400,000 cells"),
        (b"", b"<font/>" * 200_000, "100,000 styles"),
        (b"<!--" + b" " * 70_000_000 + b"-->", b"", "unpacks to 6. MB; at most 64 MB"),
        (b"</sheetData></worksheet>", b"", "no readable workbook"),
    ],
    ids=["far cell", "far row", "far cells", "cells", "styles", "bomb", "broken"],
)
def test_workbooks(tmp_path, cells, styles, words):
    path = sheet(tmp_path / "s.xlsx", cells, styles=styles)
    assert hold(path).read == (words is None)
    if words:
        with pytest.raises(SamplesError, match=words):
            read_samples(path)


def test_a_workbook_of_entities(tmp_path):
    path = sheet(tmp_path / "s.xlsx")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("xl/more.xml", '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>')
    with pytest.raises(SamplesError, match="document type"):
        read_samples(path)


FIELDS = [("q1_deg", "<f8"), ("q2_mm", "<f8"), ("reading_um", "<f8")]


def header(kind, shape, fortran=False):
    """The beginning of an array file, whatever it says."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": fortran, "shape": shape})
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "or it is damaged"),
        (header(FIELDS, (10**12,)), "or it is damaged"),
        (header([("q1_deg", "|S0")], (10**12,)), "or it is damaged"),
        (header(FIELDS, (-1,)), "or it is damaged"),
        (header(FIELDS, (2,)) + bytes(24 * 4), "or it is damaged"),  # four rows, of which two would be read
        (header(FIELDS, (2,))[:60] + b"(" * 60, "or it is damaged"),
        (header("|O", (1,)) + b"\x80\x04N.", "without Python objects"),
        (header(FIELDS, (0,)), "no rows"),
        (header(FIELDS, ()) + bytes(24), re.escape("the shape ()")),
        (header(FIELDS, (2, 2)) + bytes(96), re.escape("the shape (2, 2)")),
        (header("<f8", (2, 3), fortran=True) + bytes(48), "no named columns"),
        (header([("q1_deg", "<c16"), *FIELDS[1:]], (1,)) + bytes(32), "complex128, not numbers"),
        (header([("q1_deg", [("a", "<f8")]), *FIELDS[1:]], (1,)) + bytes(24), "records, not numbers"),
        (header([("q1_deg", "<f8", (3,)), *FIELDS[1:]], (1,)) + bytes(40), re.escape("the shape (1, 3)")),
        (header([*FIELDS, ("plane", "<U1")], (1,)) + bytes(24) + b"\xff" * 4, "not text of Unicode"),
        (header([*FIELDS, ("plane", "<f8")], (1,)) + bytes(24) + np.array(np.nan).tobytes(), "label is not finite"),
        (header([*FIELDS, ("q2_mm\n", "<f8")], (1,)) + bytes(32), "the name of column 4"),
    ],
)
def test_arrays(tmp_path, content, words):
    (tmp_path / "s.npy").write_bytes(content)
    assert not hold(tmp_path / "s.npy").read
    with pytest.raises(SamplesError, match=words):
        read_samples(tmp_path / "s.npy")


def test_arrays_of_another_machine_are_read(tmp_path):
    fields = np.zeros(3, dtype=[("q1_deg", ">f8"), ("q2_mm", ">i2"), ("reading_um", ">f4"), ("plane", "S5")])
    fields["q2_mm"], fields["plane"] = [1, 2, 300], b"left"
    np.save(tmp_path / "s.npy", fields)
    samples = read_samples(tmp_path / "s.npy")
    np.testing.assert_array_equal(samples.joints[:, 1], [1, 2, 300])
    assert samples.labels["plane"] == ("left",) * 3


def archive_of(path, arrays):
    """An archive of members by name, each so many zeros after a header that says so."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, kind, rows in arrays:
            archive.writestr(f"{name}.npy", header(kind, (rows,)) + bytes(rows * np.dtype(kind).itemsize))


def test_archives(tmp_path):
    columns = ("q1_deg", "q2_mm", "reading_um")
    archive_of(tmp_path / "s.npz", [(name, "<f8", 3_000_000) for name in columns])
    with pytest.raises(SamplesError, match="unpacks to 68 MB; at most 64 MB"):
        read_samples(tmp_path / "s.npz")
    archive_of(tmp_path / "s.npz", [(name, "|i1", 4_000_000) for name in (*columns, "plane")])
    assert hold(tmp_path / "s.npz").read
    with pytest.warns(UserWarning, match="Duplicate"):
        archive_of(tmp_path / "s.npz", [(name, "<f8", 2) for name in (*columns, "q1_deg")])
    with pytest.raises(SamplesError, match="column 'q1_deg': the column appears twice"):
        read_samples(tmp_path / "s.npz")
    archive_of(tmp_path / "s.npz", [(f"a{k}", "<f8", 1) for k in range(10_001)])
    with pytest.raises(SamplesError, match="10001 members"):
        read_samples(tmp_path / "s.npz")
    with zipfile.ZipFile(tmp_path / "s.npz", "w") as archive:
        for name in columns:
            archive.writestr(f"{name}.npy", header("<f8", (2,)) + bytes(32))  # four rows, of which two would be read
    with pytest.raises(SamplesError, match="or it is damaged"):
        read_samples(tmp_path / "s.npz")
    np.savez(tmp_path / "s.npz", **{name: np.zeros(50) for name in columns})
    data = bytearray((tmp_path / "s.npz").read_bytes())
    data[data.index(b"\x93NUMPY") + 200] ^= 1  # a number within: only the checksum knows
    (tmp_path / "s.npz").write_bytes(data)
    with pytest.raises(SamplesError, match="or it is damaged"):
        read_samples(tmp_path / "s.npz")
