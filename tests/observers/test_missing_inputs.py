"""Over a hole in which readings and torques are lost a filter is as uncertain as it is wrong."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import Record
from covariant.calibration import missing_inputs
from covariant.observers import MissingInputs


def rough(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """A torque that changes at random, and forgets in 0.2 s."""
    keep, u = np.exp(-(t[1] - t[0]) / 0.2), [rng.normal()]
    for _ in t[1:]:
        u.append(keep * u[-1] + np.sqrt(1 - keep**2) * rng.normal())
    return 6 * np.array(u)[:, None]


@pytest.mark.parametrize(("decay", "square"), [(2.0, 9.0), (2.0, 0.0), (5.0, -24.0), (300.0, -89_000.0)])
def test_an_input_that_is_missing_becomes_what_inputs_are(decay, square):
    """Transition and added variance keep the stationary one, by the numbers of a matrix exponential."""
    from scipy.linalg import expm

    inputs = MissingInputs(jnp.zeros(1), 2 * jnp.ones(1), jnp.array([decay]), jnp.array([square]), 0.1)
    pace = decay**2 + square
    flow, stationary = np.array([[0.0, 1.0], [-pace, -2 * decay]]), np.diag([4.0, 4.0 * pace])
    for h in (1e-3, 0.03, 0.4):
        left, root = np.asarray(inputs.transition(h))[0], np.asarray(inputs.added_root(h))[0]
        np.testing.assert_allclose(left, expm(h * flow), rtol=2e-5, atol=2e-5 * np.sqrt(pace))
        np.testing.assert_allclose(left @ stationary @ left.T + root @ root.T, stationary, atol=1e-6 * stationary.max())


def test_a_log_shows_how_its_inputs_change():
    t = np.arange(0.0, 200.0, 0.01)
    u = rough(np.random.default_rng(0), t)
    u[1000:1030] = np.nan
    inputs = missing_inputs(Record(t, u, np.zeros_like(u)))
    assert inputs is not None
    assert float(inputs.std[0]) == pytest.approx(6.0, rel=0.1)
    # What is left of an input after its time constant is 1/e.
    assert float(inputs.transition(0.2)[0, 0, 0]) == pytest.approx(np.exp(-1), abs=0.1)
    assert missing_inputs(Record(t, np.nan_to_num(u), np.zeros_like(u))) is None
    assert missing_inputs(Record(t, 0 * u, np.zeros_like(u))) is None


def test_numbers_that_make_no_process_are_refused():
    one = jnp.ones(1)
    with pytest.raises(ValueError, match="decay² \\+ square must be a positive"):
        MissingInputs(one, one, one, -2 * one, 0.1)
    with pytest.raises(ValueError, match="hold must be a positive"):
        MissingInputs(one, one, one, one, 0.0)


def test_a_missing_input_beside_one_that_never_changes():
    """As the switch of a servo that stays on: it has no correlation, and its size is 0."""
    t = np.delete(np.arange(0.0, 20.0, 0.01), slice(700, 750))
    u = np.stack([np.sin(3 * t), np.ones_like(t)], axis=1)
    inputs: Any = missing_inputs(Record(t, u, np.zeros_like(u)))
    assert inputs.std[1] == 0
    assert np.isfinite(np.array([inputs.decay, inputs.square])).all()
