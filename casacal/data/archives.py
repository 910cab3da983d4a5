"""Rows from arrays, workbooks and DataFrames, as named columns or cells.

The unpacked size of zip archives, be they of arrays or workbooks, is bounded before anything in them is read.
"""

from __future__ import annotations

import hashlib
import io
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from casacal.data.columns import Columns, Labels
from casacal.data.text import UNSHOWN, NumberedRows, Table, check_names, make_table
from casacal.errors import CasacalError, SamplesError
from casacal.values import Array

MOST_MEMBERS = 10_000
UNPACKED = 1 << 26  # bytes that any archive may unpack to
GROWTH = 20  # a larger archive may unpack to so many times its size; measurements seldom shrink to a half
PIECE = 1 << 20


def columns_of_arrays(arrays: Mapping[str, Any], file: str, digest: str) -> Columns:
    """Columns of arrays by name, of equal length; what is read as numbers must be numbers."""

    def number(name: str) -> Array:
        values = np.asarray(arrays[name])
        if values.dtype.kind not in "iuf" or values.dtype == np.float16:
            raise SamplesError(file, f"the column holds {_kind(values)}, not numbers", "Store float64", column=name)
        with np.errstate(all="ignore"):  # a number beyond float64 becomes infinite, and is refused as such
            values = np.asarray(values, dtype=np.float64)
        if (bad := np.flatnonzero(~np.isfinite(values))).size:
            line, *also = (bad + 1).tolist()
            what = f"'{values[bad[0]]}' is not a finite number"
            raise SamplesError(file, what, "Mend or remove the row", line=line, column=name, also=also)
        return values

    def text(name: str) -> Labels:
        values = np.asarray(arrays[name])
        if values.dtype.kind not in "iufbUSM":
            raise SamplesError(file, f"the column holds {_kind(values)}, not labels", "Store text", column=name)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0]) + 1
            raise SamplesError(file, "the label is not finite", "Give the row its label", line=row, column=name)
        names, codes = np.unique(values, return_inverse=True)
        try:
            words = [each.decode() if isinstance(each, bytes) else text_of_cell(each) for each in names]
            return Labels.coded(words, codes)
        except (ValueError, SystemError):  # the latter is what Python makes of signs beyond Unicode
            raise SamplesError(file, "a label is not text of Unicode", "Store it as such", column=name) from None

    count = len(next(iter(arrays.values())))
    return Columns(file, digest, tuple(arrays), 0, range(1, count + 1), number, text)


def _kind(values: NDArray[Any]) -> str:
    return "records" if values.dtype.kind == "V" else str(values.dtype)


def digest_of(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of columns: their names and their bytes."""
    digest = hashlib.sha256()
    for name, values in arrays.items():
        digest.update(name.encode() + b"\0")
        buffer = io.BytesIO()
        np.save(buffer, values, allow_pickle=False)
        digest.update(buffer.getbuffer())
    return digest.hexdigest()


def read_arrays(path: Path) -> Columns:
    """Columns of a .npy file with named fields, mapped into memory, or an .npz with an array each; or SamplesError."""
    file = str(path)
    what = "this is not an array file of NumPy without Python objects, or it is damaged"
    with readable(file, what, "Write it with numpy.save or numpy.savez"):
        named = _members(path, file) if zipfile.is_zipfile(path) else _fields(path, file)
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
    check_names((name for name, _ in named), file)
    for name, values in named:
        if values.ndim != 1:
            what = f"the column has the shape {values.shape}"[:80]
            raise SamplesError(file, what, "Give one number per row", column=name)
        if len(values) != len(named[0][1]):
            what = f"the columns hold {named[0][0]} {len(named[0][1])}, {name} {len(values)} rows"
            raise SamplesError(file, what, "Give all columns the same number of rows")
    if not named or not len(named[0][1]):
        raise SamplesError(file, "the columns hold no rows", "Give all columns the same number of rows")
    return columns_of_arrays(dict(named), file, digest)


@contextmanager
def readable(file: str, what: str, fix: str) -> Iterator[None]:
    """Say in a SamplesError what is wrong with a file that a library refuses, and leave the library's warnings out."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of styles, of how a header is written, and the like
            yield
    except FileNotFoundError:
        raise SamplesError(file, "there is no such file", "Check the path") from None
    except CasacalError:
        raise
    except Exception as error:  # whatever a damaged file makes of the library, it is the file that must change
        raise SamplesError(file, f"{what} ({type(error).__name__})", fix) from None


def _fields(path: Path, file: str) -> list[tuple[str, NDArray[Any]]]:
    """Fields of one array, in their order; the memory is that of the file."""
    array = np.lib.format.open_memmap(path, mode="r")
    if array.dtype.names is None:
        fix = "Give fields such as q1_deg, or an .npz with one array per column"
        raise SamplesError(file, "the array has no named columns", fix)
    _check_size(array, path.stat().st_size - array.offset)
    return [(name, array[name]) for name in array.dtype.names]


def _members(path: Path, file: str) -> list[tuple[str, NDArray[Any]]]:
    """Arrays of an archive, in their order."""
    check_unpacked(path, file)
    named = []
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            with archive.open(member) as stream:
                array = np.lib.format.read_array(stream, allow_pickle=False)
                _check_size(array, array.nbytes + len(stream.read()))  # at the end, the archive's checksum is looked at
            named.append((member.filename.removesuffix(".npy"), array))
    return named


def _check_size(array: NDArray[Any], size: int) -> None:
    """Raise ValueError unless an array is as large as what is kept of it; rows may not go without bytes."""
    if array.nbytes != size or not array.itemsize:
        raise ValueError("more or fewer rows than are said")


def check_unpacked(path: Path, file: str) -> None:
    """Raise SamplesError for an archive of too many members, or too much in them; zipfile.BadZipFile for none."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    size, most = sum(member.file_size for member in members), max(UNPACKED, GROWTH * path.stat().st_size)
    if len(members) > MOST_MEMBERS:
        what = f"the archive has {len(members)} members; at most {MOST_MEMBERS} are read"
        raise SamplesError(file, what, "Leave out what is not a sample")
    if size > most:
        what = f"the archive unpacks to {size >> 20} MB; at most {most >> 20} MB are read from one of its size"
        raise SamplesError(file, what, "Save the samples alone, or as CSV")


MOST_ROWS = 1 << 20  # rows of a sheet, whatever its file says
MOST_TAGS = 1_600_000  # of all parts of a workbook, four a cell; more take minutes and gigabytes to read
MOST_OTHER_TAGS = 100_000  # tags of styles and the like, which take the library longest
CELL_TAG = re.compile(rb"</?(?:\w+:)?(?:row|c|v|f|is|si|t)[\s/>]")
MOST_PLACES = 20_000_000  # cells of a sheet, empty ones included: one coloured far to the right makes a row of 16,384
ERRORS = ("#NULL!", "#DIV/0!", "#VALUE!", "#REF!", "#NAME?", "#NUM!", "#N/A")  # of spreadsheets, and no comments


def read_workbook(path: str | Path) -> Table:
    """Read the first visible sheet of an Excel workbook as it is calculated: a header row, then one row per sample.

    Blank rows and comments are skipped as in text; "line" is the sheet's row, and `file` tells one sheet of several.

    Raises SamplesError for anything else, such as hidden rows; CasacalError without the extra `excel`.
    """
    try:
        import openpyxl
    except ImportError:
        what = f"{path} is an Excel workbook, which needs a library"
        raise CasacalError(what, "Install it with pip install openpyxl") from None
    file = str(path)
    with readable(file, "this is no readable workbook", "Save it again, or as CSV"):
        check_unpacked(Path(path), file)
        _check_tags(Path(path), file)
        data = Path(path).read_bytes()
        opened = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True, keep_links=False)
        with closing(opened) as book:
            file, rows, comments = _first_sheet(book, file)
    return make_table(file, hashlib.sha256(data).hexdigest(), rows, "\t", comments)


def _check_tags(path: Path, file: str) -> None:
    """Raise SamplesError for a workbook whose parts are too many, or that declares parts of its own."""
    tags = others = 0
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            with archive.open(member) as stream:  # which ends where it was declared to
                while piece := stream.read(PIECE):
                    here = piece.count(b"<")
                    tags, others = tags + here, others + here - len(CELL_TAG.findall(piece))
                    if b"<!DOCTYPE" in piece:
                        raise SamplesError(file, "the workbook declares a document type", "Save it again, or as CSV")
                    if tags > MOST_TAGS or others > MOST_OTHER_TAGS:
                        many = f"{MOST_TAGS // 4:,} cells, or {MOST_OTHER_TAGS:,} styles and the like"
                        raise SamplesError(file, f"the workbook holds more than {many}", "Save the samples as CSV")


def _first_sheet(book: Any, file: str) -> tuple[str, NumberedRows, NumberedRows]:
    """Cells of the first visible sheet as text and those of comments; the file with the sheet's name if it has more."""
    sheets = [sheet for sheet in book.worksheets if sheet.sheet_state == "visible"]
    if not sheets:
        fix = "Show the one with the samples, or save it as CSV"
        raise SamplesError(file, "the workbook has no visible sheet", fix)
    sheet = sheets[0]
    if len(book.sheetnames) > 1:
        file = f"{file}, sheet '{UNSHOWN.sub('?', sheet.title)[:40]}'"
    with book._archive.open(sheet._worksheet_path) as stream:  # the library passes over what it does not show
        hidden, uncalculated = _odd_rows(stream, file)
    sheet.reset_dimensions()  # they may be wrong
    rows, comments, places = NumberedRows(), NumberedRows(), 0
    for number, row in enumerate(sheet.iter_rows(values_only=True), 1):
        places += len(row)
        if places > MOST_PLACES:
            what = f"the sheet spans more than {MOST_PLACES:,} cells, most of them empty"
            raise SamplesError(file, what, "Delete the columns beside the samples, or save them as CSV", line=number)
        cells = [text_of_cell(cell) for cell in row]
        while cells and not cells[-1]:
            cells.pop()
        if not cells and number in uncalculated:
            what, fix = "the row holds formulas without results", "Open it in a spreadsheet and save it, or save as CSV"
            raise SamplesError(file, what, fix, line=number)
        if not cells:
            continue
        if cells[0].startswith("#") and cells[0] not in ERRORS:
            comments.append((number, cells))
            continue
        width = len(rows[0][1]) if rows else len(cells)
        if len(cells) > width:
            raise SamplesError(file, "a cell has no name in the header", "Name its column", line=number)
        if number in hidden:
            what = "the row is hidden, so that it is not clear whether it counts"
            raise SamplesError(file, what, "Show or delete it", line=number)
        rows.append((number, cells + [""] * (width - len(cells))))
    return file, rows, comments


def _odd_rows(stream: Any, file: str) -> tuple[set[int], set[int]]:
    """Rows that a sheet hides, and rows with formulas that are no text; SamplesError where they are not in order."""
    hidden, formulas, last, depth, kind = set[int](), set[int](), 0, 0, ""
    for event, element in ElementTree.iterparse(stream, ("start", "end")):
        depth += 1 if event == "start" else -1
        if event == "end":
            element.clear()
            continue
        name = element.tag.rpartition("}")[2]
        if name == "c" and depth == 4:
            kind = element.get("t", "")
        elif name == "f" and depth == 5 and kind != "str":  # one of text may well say nothing
            formulas.add(last)
        elif name == "row" and depth == 3:
            number = int(element.get("r", last + 1))
            if not last < number <= MOST_ROWS:
                raise SamplesError(file, "the rows are out of order", "Save it again, or as CSV", line=number)
            last = number
            if element.get("hidden", "0").strip() not in ("0", "false"):
                hidden.add(number)
    return hidden, formulas


def text_of_cell(cell: Any) -> str:
    """A cell as one would type it; "" for a missing one (None, or the NaN, NaT and NA of pandas)."""
    if cell is None:
        return ""
    if isinstance(cell, bytes):
        try:
            cell = cell.decode()
        except UnicodeDecodeError:
            raise CasacalError(f"A cell holds {cell[:20]!r}, which is no text of UTF-8", "Store text") from None
    if isinstance(cell, (float, np.floating)):
        cell = float(cell)
        return "" if cell != cell else str(int(cell)) if cell.is_integer() and abs(cell) < 1e15 else repr(cell)
    if isinstance(cell, np.datetime64) and np.isnat(cell):
        return ""
    return "" if type(cell).__name__ in ("NAType", "NaTType") else str(cell).strip()


def table_of_frame(frame: Any, source: str = "DataFrame") -> Table:
    """The cells of a frame as text; "line" is then its row, counted from 1."""
    header = tuple(str(name) for name in frame.columns)
    rows = tuple(tuple(map(text_of_cell, row)) for row in frame.itertuples(index=False, name=None))
    digest = hashlib.sha256(repr((header, rows)).encode()).hexdigest()
    return Table(source, digest, header, 0, rows, tuple(range(1, len(rows) + 1)), decimal_comma=False)
