"""What rivals are tuned on: neither rest nor faults; and what they are ranked by."""

import numpy as np
import pytest

from covariant.verbs.base.trial import moving_part

T = 0.01 * np.arange(3000)
V = np.cos(3 * T)[:, None]
NONE, ALL = np.zeros(3000, bool), np.ones(3000, bool)


def begin(part):
    return T[part][0]


def test_the_first_third_is_taken_where_nothing_speaks_against_it():
    part = moving_part(T, V, ALL, NONE)
    assert begin(part) == 0.0
    assert T[part][-1] == pytest.approx(T[-1] / 3, abs=0.02)


def test_rest_is_passed_over():
    assert begin(moving_part(T, np.where(T[:, None] < 10.0, 0.0, V), ALL, NONE)) > 2.0


def test_faults_are_passed_over_and_the_fewest_taken_where_they_are_everywhere():
    faulty = (T < 9.0) & (np.arange(3000) % 50 == 0)
    assert begin(moving_part(T, V, ALL, faulty)) > 8.9
    everywhere = np.arange(3000) % np.where(T < 15.0, 50, 200) == 0
    assert begin(moving_part(T, V, ALL, everywhere)) > 14.9


def test_faults_of_the_reference_are_no_motion():
    v = np.where(T[:, None] < 12.0, 0.0, V)
    v[300] = 500.0
    assert begin(moving_part(T, v, ALL, NONE)) > 3.0
