"""What is proven plain, and what is not: the proof alone, whatever pandas would make of the lines."""

import pytest

from casacal.tables.plain_lines import Form, proven

NAMES = ("plane", "q1_deg", "note")
LABELLED = Form(",", NAMES, ("q1_deg",), ("plane",))
COMMAS = Form(";", NAMES, ("q1_deg",), ("plane",))
TABS = Form("\t", NAMES, ("q1_deg",), ("plane",))
NUMBERS = Form(",", ("q1_deg", "q2_deg", "q3_deg"), ("q1_deg", "q2_deg", "q3_deg"), ())


@pytest.mark.parametrize(
    ("form", "written", "data", "mark"),
    [
        (LABELLED, "a,1.5,x", "a,1.5,x\n", ""),
        (LABELLED, 'a,1,x\r\nb,2,"y"\r\n', "a,1,x\nb,2,y\n", ""),
        (LABELLED, '"a",1,""\n', "a,1,\n", ""),
        (LABELLED, "wänd, 1 ,see #3\n", "wänd, 1 ,see #3\n", ""),
        (COMMAS, "a;1,5;2.5.2026\n", "a;1,5;2.5.2026\n", ","),
        (COMMAS, "a;1;2,5\n", "a;1;2,5\n", ","),
        (TABS, "a\t1.5\tone, two\n", "a\t1.5\tone, two\n", "."),
        (NUMBERS, "1,-2.5e3,+3\n", "1,-2.5e3,+3\n", ""),
    ],
)
def test_plain(form, written, data, mark):
    found = proven(written.encode(), form)
    assert found is not None
    assert (found.data.decode(), found.lines, found.mark) == (data, data.count("\n"), mark)


@pytest.mark.parametrize(
    ("form", "written"),
    [
        (LABELLED, "a,1,x\ry\n"),
        (LABELLED, "a,1\n2,3,4,5\n"),
        (LABELLED, "a,1\n"),
        (LABELLED, "a,1,x,y\n"),
        (LABELLED, "a,1,x\n\nb,2,y\n"),
        (LABELLED, 'a,1,"x,y"\n'),
        (LABELLED, 'a,"1,x"\n'),
        (LABELLED, 'a,1,"x\n'),
        (LABELLED, 'a,1,5" wall 6"\n'),
        (LABELLED, 'a,1, "x"\n'),
        (LABELLED, 'a,1,"x""y"\n'),
        (LABELLED, "a,True,x\n"),
        (LABELLED, "a,nan,x\n"),
        (LABELLED, "a,\u0661,x\n"),
        (LABELLED, "a,1,5,\n"),
        (LABELLED, "# a,1,x\n"),
        (LABELLED, " # a,1,x\n"),
        (TABS, "\t\t# x\n"),
        (TABS, "\u00a0\t# x\n"),
        (LABELLED, "\ufeffa,1,x\n"),
        (LABELLED, "a,1," + "x" * 131_073 + "\n"),
        (LABELLED, "a,1,\x01\n"),
        (LABELLED, "a,1,\f\n"),
        (COMMAS, "a;1,5;2.5\n"),
        (COMMAS, "a;1,5;x\nb;2.5;x\n"),
        (NUMBERS, "1,2,3\n1,2\n"),
        (NUMBERS, "1,2,3\n1,2,3,4\n"),
        (Form(";", NUMBERS.names, NUMBERS.numbers, ()), "1,5;2.5;3\n"),
    ],
)
def test_not_plain(form, written):
    assert proven(written.encode(), form) is None


def test_what_is_no_text_is_not_plain():
    assert proven(b"a,1,\xff\n", LABELLED) is None
