"""Damaged files are read or refused in a sentence; tests/fuzz.py tries as many as one likes."""

import pytest
from fuzz import KINDS, fuzz


@pytest.mark.long_unless("npz")
@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_read_or_refused_in_a_sentence(name):
    found = fuzz(KINDS[name], KINDS[name].quick, seed=1)
    assert not found.failed, found.failed[0]
    assert found.read + found.refused.total() == KINDS[name].quick
    assert found.refused, "nothing was damaged enough to be refused"
