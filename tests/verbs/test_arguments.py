"""Numbers that verbs take are counted and checked, with one line that names the argument."""

import math

import numpy as np
import pytest

from covariant.verbs.base import arguments

NAMES = ("shoulder", "elbow")


def test_one_number_stands_for_all_where_it_may():
    np.testing.assert_array_equal(arguments.numbers("error", 0.1, NAMES, one=True), [0.1, 0.1])
    np.testing.assert_array_equal(arguments.numbers("error", [0.1, 0.2], NAMES, one=True), [0.1, 0.2])
    np.testing.assert_array_equal(arguments.amounts("noise", 0.0, NAMES), [0.0, 0.0])
    assert arguments.numbers("input", [], ()).shape == (0,)


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        ([1.0], {}, r"error needs 2 finite numbers, for shoulder, elbow; got 1$"),
        ([1.0, 2.0, 3.0], {"one": True}, r"one number, or 2 finite numbers"),
        ([1.0, -2.0], {"positive": True}, r"2 positive numbers.*got 1, -2"),
        ([1.0, math.inf], {}, "finite"),
        ([1.0, math.nan], {"positive": True}, "got 1, nan"),
        ([[1.0, 2.0]], {}, "2 finite"),
        (["fast"], {}, "is not a list of numbers"),
    ],
)
def test_other_numbers_are_refused(given, options, message):
    with pytest.raises(ValueError, match=message):
        arguments.numbers("error", given, NAMES, **options)


def test_bounds_are_those_of_names_that_there_are():
    assert arguments.bounds("region", {"elbow": (-1, 1)}, NAMES) == {"elbow": (-1.0, 1.0)}
    assert arguments.bounds("region", {"elbow": (1, 1)}, NAMES, equal=True) == {"elbow": (1.0, 1.0)}
    for given, message in (
        ({"wrist": (0, 1)}, "unknown coordinate 'wrist'. Known: shoulder, elbow"),
        ({"elbow": (1, 0)}, "region: the low end of elbow must be below the high one; got 1 and 0"),
        ({"elbow": (1, 1)}, "below"),
        ({"elbow": (0, math.inf)}, "region elbow needs 2 finite"),
        ({"elbow": (3.0,)}, "region elbow needs 2 finite"),
    ):
        with pytest.raises(ValueError, match=message):
            arguments.bounds("region", given, NAMES, "coordinate")


def test_negative_bounds_and_single_gains_are_refused():
    with pytest.raises(ValueError, match="noise: bounds must not be negative; got 0, -1"):
        arguments.amounts("noise", [0.0, -1.0], NAMES)
    assert arguments.given_gains(None, None) is None
    assert arguments.given_gains(2.0, 3.0) == {"alpha": 2.0, "beta": 3.0}
    given = arguments.given_gains([2.0, 3.0], [4.0], 5.0)
    assert (given["alpha"].tolist(), given["beta"], given["speed"]) == ([2.0, 3.0], 4.0, 5.0)
    with pytest.raises(ValueError, match="`speed` with them"):
        arguments.given_gains(None, None, 1.0)
    for pair, message in (((1.0, None), "belong together"), ((-1.0, 1.0), "positive"), ((1.0, math.inf), "positive")):
        with pytest.raises(ValueError, match=message):
            arguments.given_gains(*pair)
    for value in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="rate must be a positive number"):
            arguments.above_zero("rate", value)
