"""Public names come from one place each, on demand; earlier places send their users on, for one version."""

import importlib
import subprocess
import sys

import pytest
from test_architecture import EARLIER

import casacal
from casacal.model import kinematics


@pytest.mark.parametrize(
    ("earlier", "name", "home"),
    [("kinematics", "rotate_x", "casacal.model.kinematics"), ("discrepancy", "with_kit", "casacal.effects")],
)
def test_an_earlier_name_works_and_says_where_it_went(earlier, name, home):
    assert earlier in EARLIER
    module = importlib.import_module(f"casacal.{earlier}")
    with pytest.warns(DeprecationWarning, match=f"casacal.{earlier} is now {home}: take '{name}' from there") as caught:
        found = getattr(module, name)
    assert caught[0].filename == __file__
    assert found is getattr(importlib.import_module(home), name)
    with pytest.raises(AttributeError):
        module.__no_such_thing__  # noqa: B018
    with pytest.warns(DeprecationWarning, match="is now"), pytest.raises(AttributeError, match="no_such_thing"):
        module.no_such_thing  # noqa: B018


def test_all_earlier_names_are_taken_at_once():
    """`from casacal.kinematics import *`, as first problems were written."""
    taken = {}
    with pytest.warns(DeprecationWarning, match="casacal.kinematics is now casacal.model.kinematics"):
        exec("from casacal.kinematics import *", taken)
    for name in ("rotate_x", "translate", "position", "chain"):
        assert taken[name] is getattr(kinematics, name)


@pytest.mark.parametrize(
    ("name", "chapter"), [("Result", "fit"), ("SamplesError", "errors"), ("Study", "study"), ("rail", "model")]
)
def test_a_name_that_stood_at_the_front_works_and_says_where_it_went(name, chapter):
    with pytest.warns(DeprecationWarning, match=f"casacal.{name} is now casacal.{chapter}.{name}$") as caught:
        found = getattr(casacal, name)
    assert caught[0].filename == __file__
    assert found is getattr(importlib.import_module(f"casacal.{chapter}"), name)
    assert name not in dir(casacal)


def test_what_never_stood_at_the_front_is_not_found_there():
    for name in ("no_such_thing", "np", "_np", "__wrapped__", "LONGEST"):
        with pytest.raises(AttributeError, match=name):
            getattr(casacal, name)


@pytest.mark.parametrize("chapter", ["fit", "model", "planning", "uncertainty"])
def test_every_public_name_of_a_chapter_is_there_and_listed(chapter):
    module = importlib.import_module(f"casacal.{chapter}")
    for name in module.__all__:
        assert getattr(module, name).__name__ == name
    with pytest.raises(AttributeError, match="no_such_thing"):
        module.no_such_thing  # noqa: B018


def test_a_chapter_is_reached_from_the_front_and_costs_nothing_until_then():
    code = """
import sys, casacal
assert "numpy" not in sys.modules and "casacal.fit" not in sys.modules
casacal.fit
assert "casacal.fit.lm" not in sys.modules and "casadi" not in sys.modules
casacal.fit.Gaussian
assert "casacal.fit.least_squares" in sys.modules and "casadi" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
