"""Simulation under inputs as a log has them, against closed forms and against dense integration."""

import numpy as np
import pytest

from covariant.simulation import logged_inputs

T = np.array([0.5, 0.8, 1.4, 1.5])
U = np.array([[1.0], [-2.0], [4.0], [0.5]])
AT = np.array([0.0, 0.2, 0.9, 1.1, 2.0])


def dense(inputs, times):
    """The inputs at times, by whichever interval they are in."""
    return np.array([inputs.at(int(np.searchsorted(inputs.begin, t, side="right")) - 1, t)[0] for t in times])


@pytest.mark.parametrize("delay", [0.0, 0.15])
def test_inputs_are_held_or_linear_between_stamps(delay):
    times = np.linspace(0.01, 1.9, 57)
    held, linear = (dense(logged_inputs(T, U, word, delay, at=AT), times) for word in ("held", "linear"))
    k = np.clip(np.searchsorted(T + delay, times, side="right") - 1, 0, 3)
    np.testing.assert_allclose(held, U[k, 0], atol=1e-12)
    np.testing.assert_allclose(linear, np.interp(times, T + delay, U[:, 0]), atol=1e-12)


def test_another_word_for_what_is_between_stamps_is_refused():
    with pytest.raises(ValueError, match="'held' or 'linear'; got 'cubic'"):
        logged_inputs(T, U, "cubic")
