"""What a quick reader found is believed where it accounts for all that its lines hold: the proof, whoever read them."""

import csv

import numpy as np
import pytest

from casacal.tables.plain_cells import FEW, accountable, accounted
from casacal.tables.plain_lines import Form
from casacal.tables.sections import Rows

LABELLED = Form(",", ("plane", "q1_deg"), ("q1_deg",), ("plane",))
LAST = Form(",", ("q1_deg", "plane"), ("q1_deg",), ("plane",))
COMMAS = Form(";", ("plane", "q1_deg"), ("q1_deg",), ("plane",))
TABS = Form("\t", ("plane", "q1_deg"), ("q1_deg",), ("plane",))
NUMBERS = Form(",", ("q1_deg", "q2_deg"), ("q1_deg", "q2_deg"), ())


def account(form, text, *labels):
    """The account of lines whose labels a quick reader found to be these, one a line."""
    lines = text.count("\n")
    plain = accountable(text.encode(), lines, form)
    assert plain is not None
    names = list(dict.fromkeys(labels))
    found = {"plane": (names, np.array([names.index(label) for label in labels]))} if form.texts else {}
    return accounted(Rows({}, found, range(1, lines + 1), plain.mark), plain, form)


@pytest.mark.parametrize(
    ("form", "text", "found", "labels", "mark"),
    [
        (LABELLED, "a,1.5\nb b,-2\na,3\n", ("a", "b b", "a"), ["a", "b b"], ""),
        (LABELLED, '"a",1\n"",2\n', ('"a"', '""'), ["a", ""], ""),
        (LABELLED, '"#1",1\nsee #2,2\n', ('"#1"', "see #2"), ["#1", "see #2"], ""),
        (LABELLED, "e5/-.,1\n/,2\n", ("e5/-.", "/"), ["e5/-.", "/"], ""),
        (LABELLED, "wänd,1\r\nx,2\r\n", ("wänd", "x"), ["wänd", "x"], ""),
        (LABELLED, "a,1\na, +2E+05 \n", ("a", "a"), ["a"], ""),
        (LAST, "1,#a\n2, #b\n", ("#a", " #b"), ["#a", " #b"], ""),
        (COMMAS, "a;1,5\n", ("a",), ["a"], ","),
        (COMMAS, "a;1.5\n", ("a",), ["a"], "."),
        (COMMAS, "a, b;1\n", ("a, b",), ["a, b"], ""),
        (COMMAS, "a, b;1,5\n", ("a, b",), ["a, b"], ","),
        (COMMAS, "2,5;1\n", ("2,5",), ["2,5"], ","),
        (COMMAS, '"2.5" ;1\n'.replace(" ", ""), ('"2.5"',), ["2.5"], "."),
        (COMMAS, "25;1\nb,c;2\n", ("25", "b,c"), ["25", "b,c"], ""),
        (TABS, "a b\t1\n", ("a b",), ["a b"], ""),
    ],
)
def test_an_account_that_balances(form, text, found, labels, mark):
    rows = account(form, text, *found)
    assert rows is not None
    assert rows.labels["plane"][0] == labels
    assert rows.mark == mark


@pytest.mark.parametrize(
    ("form", "text", "found"),
    [
        (LABELLED, "a,True\n", ("a",)),
        (LABELLED, "a,nan\n", ("a",)),
        (LABELLED, "a,1\u0661\n", ("a",)),
        (LABELLED, "a,1\0\n", ("a",)),
        (LABELLED, 'a,"1"\n', ("a",)),
        (LABELLED, "ab,1\n", ("a",)),
        (LABELLED, "\ufeffa,1\n", ("a",)),
        (LABELLED, "a\0b,1\n", ("a",)),
        (LABELLED, "a\x01,1\n", ("a\x01",)),
        (LABELLED, ",1\n", ("",)),
        (LABELLED, "a,1\n", (float("nan"),)),
        (LABELLED, "a,1,\nb,2\n", ("a", "b")),
        (LAST, "1,a,5\n2\n", ("a", "")),
        (LABELLED, "#1,1\n", ("#1",)),
        (LABELLED, " #1,1\n", (" #1",)),
        (TABS, " \t#1\n", (" ",)),
        (LABELLED, 'a"b,1\n', ('a"b',)),
        (LABELLED, '"a""b",1\n', ('"a""b"',)),
        (LABELLED, ' "a",1\n', (' "a"',)),
        (LABELLED, '"a,1\nb",2\n', ('"a', 'b"')),
    ],
)
def test_an_account_that_does_not(form, text, found):
    assert account(form, text, *found) is None


def test_numbers_alone_have_no_labels_to_account_for():
    assert account(NUMBERS, "1,2\n-3.5,4e-5\n") is not None
    assert account(NUMBERS, "1,2\n3,True\n") is None
    assert account(NUMBERS, "1,2\n3,4,\n") is None


def test_too_many_labels_are_left_to_who_needs_no_account():
    labels = [f"n{k}" for k in range(FEW + 500)]
    text = "".join(f"{label},1\n" for label in labels)
    assert account(LABELLED, text, *labels) is None
    few = [label for label in labels[: FEW // 2] for _ in range(2)]
    assert account(LABELLED, "".join(f"{label},1\n" for label in few), *few) is not None


@pytest.mark.parametrize(
    ("form", "text"),
    [
        (Form(",", ("plane", "q1_deg", "note"), ("q1_deg",), ("plane",)), "a,1,x\n"),
        (COMMAS, "a;1,5\nb;2.5\n"),
        (LABELLED, "a,1\rb,2\n"),
        (LABELLED, "a" * (csv.field_size_limit() + 1) + ",1\n"),
        (NUMBERS, "0" * (csv.field_size_limit() + 1) + "1,2\n"),
    ],
    ids=["a column that is left", "two marks", "a line end of old", "a long cell", "a long number"],
)
def test_what_no_account_can_tell(form, text):
    assert accountable(text.encode(), text.count("\n"), form) is None
