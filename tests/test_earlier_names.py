"""Modules that were public under another name send their users on, for one version."""

import importlib

import pytest
from test_architecture import EARLIER


@pytest.mark.parametrize(
    ("earlier", "name", "home"),
    [("kinematics", "rotate_x", "casacal.model.kinematics"), ("discrepancy", "with_kit", "casacal.effects")],
)
def test_an_earlier_name_works_and_says_where_it_went(earlier, name, home):
    assert earlier in EARLIER
    module = importlib.import_module(f"casacal.{earlier}")
    with pytest.warns(DeprecationWarning, match=f"casacal.{earlier} is now {home}: take '{name}' from there"):
        found = getattr(module, name)
    assert found is getattr(importlib.import_module(home), name)
    with pytest.raises(AttributeError):
        module.__no_such_thing__  # noqa: B018
    with pytest.warns(DeprecationWarning, match="is now"), pytest.raises(AttributeError, match="no_such_thing"):
        module.no_such_thing  # noqa: B018
