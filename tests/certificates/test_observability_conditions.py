"""Both conditions on a metric, against closed forms, in other coordinates, and with a witness checked on its own."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import observability, tangent_metric
from covariant.certificates.theory import bending, detectability_rate
from covariant.models import StateSpace, state_space

bends, contracts = eqx.filter_jit(bending), eqx.filter_jit(detectability_rate)


def eye(x):
    return jnp.eye(x.shape[0])


def system(f, h, n=2):
    return StateSpace(lambda t, x, u: f(x), lambda t, x, u: h(x), coordinates=tuple(f"x{k}" for k in range(n)))


def still(x):
    return 0.0 * x


def test_where_every_direction_is_seen_the_rate_is_infinite():
    assert detectability_rate(system(still, lambda x: x), eye, jnp.zeros(2)) == jnp.inf


def round_circle(x):
    return jnp.sum(x**2)[None]


def test_circles_in_the_plane_bend_by_one_over_their_radius():
    model = system(still, round_circle)
    curved = jax.jit(jax.vmap(lambda x: bending(model, eye, x)))
    for radius in (0.1, 1.0, 30.0):
        x = radius * jnp.array([[1.0, 0.0], [0.6, -0.8]])
        curvature, _, direction = curved(x)
        np.testing.assert_allclose(curvature, 1 / radius, rtol=1e-12)
        np.testing.assert_allclose(jnp.sum(direction * x, axis=1), 0.0, atol=1e-12 * radius)
        np.testing.assert_allclose(jnp.linalg.norm(direction, axis=1), 1.0, rtol=1e-12)


def polar_sphere(x):
    return jnp.diag(jnp.stack([jnp.ones_like(x[0]), jnp.sin(x[0]) ** 2]))


def test_circles_of_latitude_bend_by_the_cotangent_and_the_equator_does_not():
    model = system(still, lambda x: x[:1])
    polar = jnp.array([0.3, 1.0, np.pi / 2, 2.0])
    points = jnp.stack([polar, jnp.linspace(0.0, 2.0, 4)], axis=1)
    curvature, *_ = jax.jit(jax.vmap(lambda x: bending(model, polar_sphere, x)))(points)
    np.testing.assert_allclose(curvature, np.abs(1 / np.tan(polar)), rtol=1e-10, atol=1e-12)


def test_a_sphere_in_space_has_the_largest_of_its_principal_curvatures():
    """An ellipsoid's curvatures at its tip (0, 0, c) are c/a² and c/b²."""
    a, b, c = 2.0, 3.0, 1.5
    model = system(still, lambda x: ((x[0] / a) ** 2 + (x[1] / b) ** 2 + (x[2] / c) ** 2)[None], 3)
    curvature, _, direction = bends(model, eye, jnp.array([0.0, 0.0, c]))
    assert curvature == pytest.approx(c / a**2, rel=1e-12)
    np.testing.assert_allclose(np.abs(direction), [1.0, 0.0, 0.0], atol=1e-12)


def test_a_linear_output_in_flat_space_is_good_from_any_distance():
    model = system(lambda x: jnp.stack([x[1] - 2 * x[0], -x[1]]), lambda x: x[:1] - 0.4 * x[1:])

    def metric(x):
        return jnp.array([[2.0, 0.3], [0.3, 1.0]])

    found = observability(model, metric, np.random.default_rng(0).uniform(-1, 1, (20, 2)))
    assert (found.condition_1.verdict, found.condition_2.verdict) == ("holds", "holds")
    assert found.condition_2.margin < 1e-12
    assert found.witness is None
    assert found.verdict.startswith("local, and from any distance for a large enough gain, as sampled at 20 states")


def test_a_point_without_a_metric_is_refused():
    def metric(x):
        return jnp.where(x[0] < 0.5, jnp.eye(2), jnp.nan)

    with pytest.raises(ValueError, match=r"the metric is not positive definite at \(0.7, 0\)") as caught:
        observability(system(still, lambda x: x[:1]), metric, np.array([[0.1, 0.0], [0.7, 0.0]]))
    assert "\n" not in str(caught.value)


BEAM = models.ball_and_beam()
M, SIGMA = 12.0, 1.5
Q = np.array([[M + SIGMA**2, -SIGMA], [-SIGMA, 1.0]])
"""Of the metric m|ξ|² + |ζ − σξ|²."""


@pytest.mark.parametrize(
    "model", [BEAM, pytest.param(models.pendulum_chain((1.0, 1.0), (1.0, 1.0)), marks=pytest.mark.long)]
)
def test_the_first_condition_holds_at_twice_sigma_and_the_second_where_geodesics_turn_little(model):
    points = np.random.default_rng(0).uniform(-1, 1, (10, 4))
    metric = tangent_metric(model.space, Q)
    found = observability(state_space(model), metric, points)
    assert found.condition_1.margin == pytest.approx(2 * SIGMA, abs=1e-9)
    assert (found.condition_2.verdict, found.witness) == ("holds", None)
    assert "turn by less than π/2" in found.verdict
    # The same metric without the knowledge that it is a lift: straight, of which several outputs decide nothing.
    found = observability(state_space(model), lambda x: metric(0.0 * x[0], x), points)
    assert (found.condition_2.verdict, found.witness) == ("undecided", None)


@pytest.mark.long
def test_an_output_that_is_no_position_is_not_taken_for_one():
    model = StateSpace(
        state_space(BEAM).f, lambda t, x, u: x[:2] + 0.1 * x[2:], coordinates=("r", "theta", "v", "w"), inputs=2
    )
    found = observability(model, tangent_metric(BEAM.space, Q), np.random.default_rng(0).uniform(-1, 1, (4, 4)))
    assert "turn by less" not in found.verdict
    assert found.condition_2.verdict != "holds"
