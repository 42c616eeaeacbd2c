"""Starts, profiles and doubts of a fit: wrong guesses, numbers that stand for each other, and logs that are misread."""

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.calibration.identification import Unknowns

SERVO = """
import jax.numpy as jnp
from covariant.models import Lagrangian, Parametric

def friction(q, v, damping, dry):
    return -damping * v - dry * jnp.tanh(v / 0.01)

def inertia(q, rotor):
    return rotor * jnp.eye(1)

def potential(q, moment):
    return -moment * jnp.cos(q[0])

def make(rotor, damping, dry, moment):
    forces = Parametric(friction, damping=damping, dry=dry)
    energy = Parametric(potential, moment=moment)
    return Lagrangian(Parametric(inertia, rotor=rotor), energy, dissipation=forces, coordinates=("q",), inputs=1)
"""


@pytest.mark.parametrize(("damping", "positive"), [(0.1, True), (-0.1, False)])
def test_inertias_and_friction_of_a_model_of_ones_own_stay_positive(tmp_path, monkeypatch, damping, positive):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_servo.py").write_text(SERVO)
    numbers = f"rotor = 0.02\ndamping = {damping}\ndry = 0.05\nmoment = 0.3\n"
    (tmp_path / "servo.toml").write_text(f'system = "own_servo:make"\n[parameters]\n{numbers}')
    family = models.family(str(tmp_path / "servo.toml"), ["rotor", "damping", "dry", "moment"])
    # A moment of the other sign is a zero of the angle that points up; a negative first value says that it may be so.
    assert family.positive == (True, positive, True, False)


def test_a_number_that_starts_from_zero_is_searched_too():
    """Relative changes of it are in units, also where another number is positive."""
    first, manifold = jnp.array([0.0, 2.0]), models.oscillator().manifold
    unknowns = Unknowns(lambda values: (None, values), first, (False, True), np.arange(1)[None], manifold)
    z = unknowns.relative(np.array([0.5, 4.0]))
    np.testing.assert_allclose(unknowns.values(jnp.asarray(z)), [0.5, 4.0])
    np.testing.assert_allclose(unknowns.values(jnp.asarray(unknowns.multiplied(z, 1, 8.0))), [0.5, 32.0])
    assert abs(unknowns.multiplied(np.zeros(2), 0, 8.0)[0]) > 1
