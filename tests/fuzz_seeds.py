"""Well-formed files of every kind and shape, from which tests/fuzz.py makes damaged ones."""

import io
import random
import warnings
import zipfile
from pathlib import Path

import numpy as np
from openpyxl import Workbook

CSV_TOKENS = (
    b"\xff", b"\xc3", b"\xff\xfe", b"\xed\xa0\x80",
    *(token.encode() for token in (
        "#", "# a remark", " # x", "\t# x", "#1", '"#1"',
        '"', '""', '"a,b"', '"a;b"', ",", ";", "\t", "\n", "\r", "\r\n", "\n\n",
        "\x00", "\x01", "\x0b", "\f", "\x1f", "\x7f", "\x85", "\ufeff", "\u2028", "\u00a0", "\u3000", " ", "  ", "nan",
        "NaN", "inf", "-Infinity", "True", "FALSE", "None", "NA", "1_000", "1_0.5", "0x1F", "1e5", "1e999", "1e-999",
        "1e-310", "1e4294967297", "1E+05", "1e", "1e+", "1d3", ".", "+", "-", "+.5", "5.", "-0", "0012", "1 2", "--1",
        "1.2.3", "1,5", "1.5", "1,234.5", "1.234,5", "12.03.2026", "10:30", "\u0661\u0662", "１２", "½", "²",
        "99999999", "3700", "12345678901234567890.123456789", "0.1234567890123456789", "179.99999999999997", "ä",
        "plane", "q1_deg", "left", "a" * 300, "9" * 400, "5\" wall", "=1+1", "'", "\\", "|",
    )),
)  # fmt: skip

NPY_TOKENS = (
    b"<f8", b">f8", b"<f4", b"<i8", b"|O", b"|S0", b"<U0", b"<U9999999", b"<c16", b"|V8", b"<M8[s]", b"|b1", b"True",
    b"False", b"(40,)", b"()", b"(0,)", b"(-1,)", b"(40, 1)", b"(999999999999,)", b"(2,2,2,2)", b"'shape'", b"'descr'",
    b"q1_deg", b"{", b"}", b"[", b"(", b")", b"\x93NUMPY", b"\x01\x00", b"\x03\x00", b"\xff\xff", b"\0" * 8, b"(" * 90,
    b"\n", b"'", b"10**9", b"lambda", b"\xc3\xa4", np.array(np.nan).tobytes(), np.array(1e300).tobytes(),
)  # fmt: skip

XLSX_TOKENS = (
    b"<row>", b"</row>", b'<row r="9999999">', b'<c r="XFD1048576"><v>1</v></c>', b'<c r="XFD1" s="1"/>', b't="s"',
    b'<c t="s"><v>99</v></c>', b'<c t="e"><v>#REF!</v></c>', b'<c t="d"><v>2026-13-45</v></c>', b"<v>1e999</v>",
    b"<v>nan</v>", b"<v>abc</v>", b'ref="A1:A1"', b'<dimension ref="A1:XFD1048576"/>', b'hidden="1"', b"<!--", b"]]>",
    b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"&b;", b"&lt;", b"<f>1+1</f>", b"\xff", b"</worksheet>", b"</sheetData>",
    b"state=\"hidden\"", b'r:id="rId9"', b"../", b'numFmtId="14"', b"<v>-99999999</v>", b"<mergeCell ref=\"A1:D4\"/>",
)  # fmt: skip


def csv_files(folder: Path) -> list[Path]:
    """Samples as text, each written in another way."""
    return [_csv(folder / f"{number}.csv", random.Random(number)) for number in range(40)]


def _csv(path: Path, rng: random.Random) -> Path:
    delimiter = rng.choice((",", ",", ";", "\t"))
    mark = "," if delimiter != "," and rng.random() < 0.5 else "."
    digits = rng.choice(("{:.1f}", "{:.4f}", "{!r}", "{:.18e}", "{:.0f}", "{:g}"))
    number = lambda low, high: digits.format(rng.uniform(low, high)).replace(".", mark)  # noqa: E731
    planes = rng.choice((("left", "right"), ("1", "2"), ("a b", f'"x{delimiter}y"'), ('"#1"', '"2"'), ("wänd", "Tür")))
    columns = {
        "q1_deg": lambda: number(-180, 180),
        "q2_mm": lambda: number(0, 900),
        "reading_um": lambda: number(0, 9000),
        "plane": lambda: rng.choice(planes),
        "note": lambda: rng.choice(("", "# 3", "see #3", "12.03.2026", "12:30", '"said ""so"""', "none", "ä", "5 mm")),
        "temperature": lambda: number(15, 25),
    }
    names = [*columns][: rng.choice((3, 4, 4, 5, 6))]
    if rng.random() < 0.4:
        rng.shuffle(names)
    lines = [delimiter.join(names)]
    lines += [delimiter.join(columns[name]() for name in names) for _ in range(rng.choice((1, 12, 40)))]
    taken_out = "# a remark" if names[0] in ("plane", "note") else f"#{lines[-1]}"
    for _ in range(rng.choice((0, 0, 0, 1, 3))):
        prose = delimiter.join(["# measured by Ann", " on Monday", " with care"])
        lines.insert(rng.randrange(len(lines)), rng.choice(("", "# a remark", "  ", "#,,,", prose, taken_out)))
    if rng.random() < 0.1:
        lines = [" " + line.replace(delimiter, f" {delimiter} ") for line in lines]
    end = rng.choice(("\n", "\n", "\n", "\r\n", "\r"))
    text = end.join(lines) + rng.choice((end, end, ""))
    path.write_bytes(text.encode(rng.choice(("utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16"))))
    return path


def _arrays(rows: int = 40) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(rows)
    return {
        "q1_deg": rng.uniform(-180, 180, rows),
        "q2_mm": rng.uniform(0, 900, rows),
        "reading_um": rng.uniform(0, 9000, rows).astype(np.float32),
        "plane": np.array(["left", "right"])[rng.integers(2, size=rows)],
    }


def npy_files(folder: Path) -> list[Path]:
    """Samples as arrays with named fields."""
    paths = []
    for order in "<>":
        arrays = _arrays()
        kinds = [(name, values.dtype.newbyteorder(order)) for name, values in arrays.items()]
        fields = np.zeros(40, dtype=kinds)
        for name, values in arrays.items():
            fields[name] = values
        for version in ((1, 0), (2, 0)):
            paths.append(folder / f"{'little' if order == '<' else 'big'}{version[0]}.npy")
            with paths[-1].open("wb") as file, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                np.lib.format.write_array(file, fields, version=version)
    return paths


def npz_files(folder: Path) -> list[Path]:
    """Samples as archives of arrays."""
    np.savez(folder / "plain.npz", **_arrays())
    np.savez_compressed(folder / "packed.npz", **_arrays())
    return [folder / "plain.npz", folder / "packed.npz"]


def xlsx_files(folder: Path) -> list[Path]:
    """Samples as workbooks."""
    book = Workbook()
    arrays = _arrays(12)
    book.active.append([*arrays])
    for row in zip(*(values.tolist() for values in arrays.values()), strict=True):
        book.active.append(row)
    book.save(folder / "plain.xlsx")
    book.active.insert_rows(1)
    book.active["A1"] = "# a remark"
    book.create_sheet("other").append(["something", "else"])
    book.save(folder / "two.xlsx")
    return [folder / "plain.xlsx", folder / "two.xlsx", _without_styles(folder / "plain.xlsx", folder / "bare.xlsx")]


def _without_styles(source: Path, target: Path) -> Path:
    """The same workbook, its texts in the cells and its size not said, as some programs write it."""
    whole = io.BytesIO()
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(whole, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name.endswith("sheet1.xml"):
                start, end = content.index(b"<dimension"), content.index(b"/>", content.index(b"<dimension")) + 2
                content = content[:start] + content[end:]
            new.writestr(name, content)
    target.write_bytes(whole.getvalue())
    return target


URDF = """<robot name="arm">
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="flange"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="a"/><origin xyz="0 0 0.3" rpy="0 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
  <joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.1 0 0" rpy="1.5 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
  <joint name="j3" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.4 0 0" rpy="0 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
  <joint name="mount" type="fixed"><parent link="c"/><child link="flange"/><origin xyz="0.3 0 0" rpy="0 0 0"/></joint>
</robot>
"""
