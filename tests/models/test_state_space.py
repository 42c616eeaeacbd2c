"""State-space models: what they refuse, their Jacobians, and what is known of each example system."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.models import StateSpace, state_space

SYSTEMS = {
    "unknown frequency": models.unknown_frequency(),
    "Lorenz": models.lorenz(),
    "Duffing": models.duffing(),
    "a Lagrangian": state_space(models.ball_and_beam()),
}
TIME = jnp.zeros(())


def inside(model, dtype=float):
    """A state in the box, one half of the way between middle and corner, and an input."""
    box = np.array(model.box or [(-1.0, 1.0)] * len(model.coordinates)).T
    towards = np.linspace(0.55, 0.8, box.shape[1])
    return jnp.asarray(box[0] + towards * (box[1] - box[0]), dtype), jnp.linspace(0.2, 0.5, model.inputs, dtype=dtype)


each_system = pytest.mark.parametrize("name", SYSTEMS)


@pytest.mark.core(1)
@pytest.mark.exhaustive("a Lagrangian")
@each_system
def test_jacobians_are_those_of_finite_differences(name):
    model = SYSTEMS[name]
    x, u = inside(model)
    for exact, function in zip(model.jacobians(TIME, x, u), (model.f, model.h), strict=True):
        steps = np.diag(1e-5 * np.maximum(1.0, np.abs(x)))
        columns = [(function(TIME, x + e, u) - function(TIME, x - e, u)) / (2 * e.sum()) for e in steps]
        scale = float(jnp.abs(exact).max())
        np.testing.assert_allclose(exact, np.stack(columns, axis=1), rtol=1e-6, atol=1e-8 * scale)


@pytest.mark.core(3)
@pytest.mark.exhaustive("a Lagrangian")
@each_system
def test_single_precision_stays_single(name):
    model = SYSTEMS[name]
    x, u = inside(model, jnp.float32)
    rate, y = jax.jit(lambda x, u: (model.f(jnp.float32(0), x, u), model.h(jnp.float32(0), x, u)))(x, u)
    assert (rate.dtype, y.dtype) == (jnp.float32, jnp.float32)
    exact = model.f(TIME, x.astype(float), u.astype(float))
    np.testing.assert_allclose(rate, exact, rtol=1e-4, atol=1e-4 * float(jnp.abs(exact).max()))
    assert y.shape == (len(model.outputs),)


@each_system
def test_numbers_say_their_unit_and_source(name):
    model = SYSTEMS[name]
    assert len(model.units) == len(model.coordinates)
    assert all(each.unit and each.source for each in model.parameters.values())


def test_systems_are_made_inside_compiled_functions():
    made = jax.jit(lambda x: models.lorenz(9.0).f(TIME, x, jnp.zeros(0)))(jnp.ones(3))
    np.testing.assert_allclose(made, [0.0, 26.0, 1 - 8 / 3], rtol=1e-15)


def two_states(f=lambda t, x, u: x, h=lambda t, x, u: x[:1], **more):
    return StateSpace(f, h, coordinates=("a", "b"), **more)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"f": lambda t, x, u: x[:1]}, "f must return shape (2,) for 2 states; it returned (1,)"),
        ({"f": lambda t, x, u: x[:, None]}, "f must return shape (2,) for 2 states; it returned (2, 1)"),
        ({"f": lambda t, x, u: x + u[0]}, "f cannot be evaluated with 2 states and 0 inputs: "),
        ({"h": lambda t, x, u: x[0]}, "h must return a vector of outputs (p,), p ≥ 1; it returned ()"),
        ({"h": lambda t, x, u: x[:0]}, "h must return a vector of outputs (p,), p ≥ 1; it returned (0,)"),
        ({"outputs": ("y", "z")}, "h must return shape (2,) for 2 outputs; it returned (1,)"),
        ({"circles": (1,)}, "circles (1,) must be indices of the 1 outputs, 0 to 0"),
        ({"units": ("m",)}, "units needs one entry for each of the 2 states; it has 1"),
        ({"box": ((0.0, 1.0),)}, "box needs one entry for each of the 2 states; it has 1"),
        ({"box": ((0.0, 1.0), (2.0, 2.0))}, "box of b: the lower bound 2 must be below the upper one 2"),
    ],
)
def test_what_does_not_fit_is_named(wrong, words):
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        two_states(**wrong)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: models.lorenz(prandtl=0.0), "lorenz: prandtl [1] must be positive; got 0.0"),
        (lambda: models.lorenz(rayleigh=np.inf), "lorenz: rayleigh [1] must be positive; got inf"),
        (lambda: models.duffing(damping=-1.0), "duffing: damping [N s/m] must be ≥ 0; got -1.0"),
        (lambda: models.duffing(stiffness=np.nan), "duffing: stiffness [N/m] must be finite; got nan"),
    ],
)
def test_parameters_that_make_no_sense_are_named(make, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        make()


def test_outputs_have_names_and_angles_wrap():
    model = two_states(h=lambda t, x, u: x, circles=(1,))
    assert model.outputs == ("y1", "y2")
    error = model.output_error(jnp.array([3.0, 3.0]), jnp.array([jnp.nan, -3.0]))
    np.testing.assert_allclose(error, [0.0, 6 - 2 * np.pi], rtol=1e-14)


def test_fixed_points_and_divergence_of_lorenz():
    prandtl, rayleigh, geometry = 10.0, 28.0, 8 / 3
    model, none = models.lorenz(), jnp.zeros(0)
    side = np.sqrt(geometry * (rayleigh - 1))
    for point in ([0.0, 0.0, 0.0], [side, side, rayleigh - 1], [-side, -side, rayleigh - 1]):
        np.testing.assert_allclose(model.f(TIME, jnp.array(point), none), 0.0, rtol=0, atol=1e-12)
    for x in np.random.default_rng(0).uniform(-20, 20, (3, 3)):
        divergence = jnp.trace(model.jacobians(TIME, jnp.asarray(x), none)[0])
        np.testing.assert_allclose(divergence, -(prandtl + 1 + geometry), rtol=1e-14)
    # Routh and Hurwitz: the two outer points lose their stability at a Rayleigh number of 24.74.
    edge = prandtl * (prandtl + geometry + 3) / (prandtl - geometry - 1)
    for ratio, sign in ((0.99, -1), (1.01, 1)):
        r = ratio * edge
        point = jnp.array([np.sqrt(geometry * (r - 1))] * 2 + [r - 1])
        spectrum = np.linalg.eigvals(models.lorenz(rayleigh=r).jacobians(TIME, point, none)[0])
        assert np.sign(spectrum.real.max()) == sign


def test_duffing_is_a_hardening_spring_with_damping():
    x, u = jnp.array([0.7, -1.1]), jnp.array([0.3])
    rate = models.duffing(damping=0.25, stiffness=-1.0, cubic=2.0).f(TIME, x, u)
    np.testing.assert_allclose(rate, [-1.1, 0.3 + 0.25 * 1.1 + 0.7 - 2.0 * 0.7**3], rtol=1e-13)
