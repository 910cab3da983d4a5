"""Controller's joint values and the model's, against arithmetic by hand."""

import casadi as ca
import numpy as np
import pytest

from casacal import Conventions
from casacal.errors import ProblemError


def test_signs_offsets_and_coupling_by_hand():
    conventions = Conventions((1, -1, 1), (0.1, 0.2, 0.3), ((3, 2, -1.0),))
    q = np.array([1.0, 2.0, 5.0])
    expected = [1.1, -1.8, 3.3]  # the third: 5 - 2 + 0.3
    assert np.allclose(conventions.to_model(q), expected)
    assert np.allclose(conventions.to_model(np.array([q, q])), [expected, expected])
    assert np.allclose(np.asarray(conventions.to_model(ca.DM(q))).ravel(), expected)
    symbol = ca.SX.sym("q", 3)
    assert np.allclose(np.asarray(ca.Function("f", [symbol], [conventions.to_model(symbol)])(q)).ravel(), expected)
    assert np.allclose(conventions.to_controller(np.array(expected)), q)


def test_plain_conventions_change_nothing():
    q = np.array([[0.1, -0.2], [3.0, 4.0]])
    assert np.array_equal(Conventions.plain(2).to_model(q), q)


def test_signs_alone_are_conventions():
    assert Conventions(signs=(1, 1, -1)) == Conventions((1, 1, -1), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_a_joint_turned_round_means_the_same_of_readings_turned_round(joint):
    conventions = Conventions((1, -1, 1), (0.1, 0.2, 0.3), ((3, 2, -1.0), (1, 3, 2.0)))
    q = np.array([1.0, 2.0, 5.0])
    other = np.where(np.arange(1, 4) == joint, -q, q)
    assert np.allclose(conventions.flipped(joint).to_model(other), conventions.to_model(q))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (((1, 2), (0.0, 0.0)), "Use 1 or -1"),
        (((1, 1), (0.0,)), "one finite offset for each joint"),
        (((1, 1), (0.0, 0.0), ((1, 3, 1.0),)), "two different joints of 1 to 2"),
        (((1, 1), (0.0, 0.0), ((1, 2, 1.0), (2, 1, 1.0))), "Leave one out"),
    ],
)
def test_bad_conventions_are_refused(arguments, words):
    with pytest.raises(ProblemError, match=words):
        Conventions(*arguments)
