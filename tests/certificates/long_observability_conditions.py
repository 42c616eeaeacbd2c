"""What takes long of `test_observability_conditions.py`."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_observability_conditions import BEAM, SIGMA, M, Q, bends, contracts, eye, polar_sphere, system

from covariant import geometry, models
from covariant._integrate import rk8
from covariant.certificates import observability, tangent_metric
from covariant.certificates.theory import detectability_rate
from covariant.geometry._functions import norm
from covariant.metrics import lie_derivative
from covariant.models import StateSpace
from covariant.papers.sanfelice_praly import analytic_metric, grid

OSCILLATOR = models.unknown_frequency()


GRID = grid()[::7]


@pytest.mark.parametrize("rate", [0.5, 2.0, 8.0])
def test_what_the_oscillators_output_does_not_see_decays_at_the_rate(rate):
    """On the kernel of dh equation (15) is L_f P = −λP."""
    found = jax.jit(jax.vmap(lambda x: detectability_rate(OSCILLATOR, analytic_metric(rate), x)))(jnp.asarray(GRID))
    np.testing.assert_allclose(found, rate, rtol=1e-8)


def bent(x):
    return jnp.stack([x[1] - x[0] ** 3, -x[0] - x[1] + jnp.sin(x[2]), x[0] * x[1] - 2 * x[2]])


def test_the_rate_is_the_largest_of_inequality_2():
    """With a little less some ρ makes L_f P − ρ dhᵀdh + q P negative, with a little more none does."""
    model, x = system(bent, lambda x: x[:1] + 0.3 * x[1:2] ** 2, 3), jnp.array([0.4, -0.6, 0.9])

    def metric(x):
        return jnp.eye(3) + 0.3 * jnp.outer(x, x)

    q = contracts(model, metric, x)
    change, p = eqx.filter_jit(lie_derivative)(model, metric, x), metric(x)
    dh = jnp.array([[1.0, 0.6 * x[1], 0.0]])

    def greatest(q):
        return np.linalg.eigvalsh(change + q * p - 1e7 * dh.T @ dh)[-1]

    assert greatest(q - 1e-3) < 0 < greatest(q + 1e-3)


@pytest.mark.parametrize(
    ("f", "rate", "where"),
    [
        (lambda x: jnp.stack([-x[0], x[1]]), -2.0, None),
        (lambda x: jnp.stack([-x[0], -(x[1] ** 3)]), 0.0, (0.5, 0.0)),
    ],
    ids=["unstable", "cubic"],
)
def test_a_metric_that_does_not_contract_is_a_counter_example(f, rate, where):
    points = np.array([[0.2, 0.4], [0.5, 0.0], [-0.3, -0.8]])
    found = observability(system(f, lambda x: x[:1]), eye, points)
    assert found.condition_1.verdict == "fails"
    assert found.condition_1.margin == pytest.approx(rate, abs=1e-12)
    assert where is None or found.condition_1.point == where
    assert found.verdict.startswith("no observer from this metric")


def to_z(x):
    a = x[0] + 0.1 * x[1] ** 3
    return jnp.stack([a, x[1] - 0.2 * a**3])


def to_x(z):
    b = z[1] + 0.2 * z[0] ** 3
    return jnp.stack([z[0] - 0.1 * b**3, b])


def test_bending_and_rate_are_the_same_in_any_coordinates():
    def f(x):
        return jnp.stack([x[1] - x[0], -jnp.sin(x[0]) - x[1]])

    def in_z(z):
        return jax.jvp(to_z, (to_x(z),), (f(to_x(z)),))[1]

    def metric(z):
        j = jax.jacfwd(to_x)(z)
        return j.T @ polar_sphere(to_x(z)) @ j

    def h(x):
        return (x[0] ** 2 + 0.3 * x[1])[None]

    one, other = system(f, h), system(in_z, lambda z: h(to_x(z)))
    for x in jnp.array([[0.8, 0.3], [1.2, -0.7]]):
        here, there = bends(one, polar_sphere, x), bends(other, metric, to_z(x))
        assert here[0] == pytest.approx(float(there[0]), rel=1e-10)
        carried = jax.jvp(to_z, (x,), (here[2],))[1]
        assert min(np.abs(carried - there[2]).max(), np.abs(carried + there[2]).max()) < 1e-9
        rates = contracts(one, polar_sphere, x), contracts(other, metric, to_z(x))
        assert rates[0] == pytest.approx(float(rates[1]), rel=1e-10)


@pytest.fixture(scope="module")
def oscillator():
    return observability(OSCILLATOR, analytic_metric(1.0), GRID)


@pytest.mark.exhaustive
def test_the_oscillators_observer_is_local_only(oscillator):
    assert oscillator.verdict.startswith("local only")
    assert oscillator.condition_1.verdict == "holds"
    assert oscillator.condition_1.margin == pytest.approx(1.0, rel=1e-8)
    assert oscillator.condition_2.verdict == "fails"
    assert oscillator.condition_2.margin > 0.01
    assert oscillator.condition_2.evidence == "sampled"
    assert any(np.allclose(oscillator.condition_2.point, x) for x in GRID)


@jax.jit
def geodesic(x, v):
    """States at 21 equal times of the geodesic from x with velocity v, by its own differential equation."""
    metric = analytic_metric(1.0)

    def flow(t, joint):
        return joint[1], -geometry.christoffel(metric, joint[0], joint[1], joint[1])

    def step(joint, _):
        return rk8(flow, jnp.zeros(()), joint, jnp.asarray(0.05)), joint[0]

    (end, _), path = jax.lax.scan(step, (x, v), length=20)
    return jnp.concatenate([path, end[None]])


@pytest.mark.exhaustive
def test_its_witness_is_a_geodesic_on_which_the_output_turns_back(oscillator):
    metric = analytic_metric(1.0)
    first, middle, last = (jnp.asarray(x) for x in oscillator.witness)
    curvature, _, direction = bends(OSCILLATOR, metric, middle)
    assert norm(metric, middle, direction) == pytest.approx(1.0, rel=1e-10)
    assert jnp.abs(direction[0]) < 1e-12  # it touches the level set
    v = 0.1 / curvature * direction
    forward, backward = geodesic(middle, 0.9 * v), geodesic(middle, -v)
    ends = sorted([forward[-1].tolist(), backward[-1].tolist()])
    np.testing.assert_allclose(ends, sorted([first.tolist(), last.tolist()]), rtol=0, atol=1e-7)
    outputs = oscillator.outputs[:, 0]
    np.testing.assert_allclose(outputs, [first[0], middle[0], last[0]], rtol=1e-12)
    assert abs(outputs[2] - outputs[0]) < abs(outputs[1] - outputs[0])
    both = np.concatenate([backward[::-1, 0], forward[1:, 0]])
    away = np.abs(both - both[0])
    assert (np.diff(away)[:15] > 0).all()
    assert (np.diff(away)[-15:] < 0).all()


@pytest.mark.exhaustive
def test_with_several_outputs_no_bending_decides_nothing():
    model = StateSpace(lambda t, x, u: -x, lambda t, x, u: x[:2], coordinates=("a", "b", "c"))
    found = observability(model, eye, np.random.default_rng(1).uniform(-1, 1, (5, 3)))
    assert found.condition_2.verdict == "undecided"
    assert found.verdict.startswith("at least local")
    bent = StateSpace(model.f, lambda t, x, u: jnp.stack([x[0], x[1] + x[2] ** 2]), coordinates=("a", "b", "c"))
    assert observability(bent, eye, np.array([[0.1, 0.2, 0.3]])).condition_2.verdict == "fails"


@pytest.mark.exhaustive
def test_a_wanted_rate_is_asked_for():
    points = GRID[:3]
    found = observability(OSCILLATOR, analytic_metric(1.0), points, rate=1.1).condition_1
    assert found.verdict == "fails"
    assert found.margin == pytest.approx(1.0, rel=1e-8)
    assert found.hypotheses[0].margin == pytest.approx(-0.1, rel=1e-7)  # by as much as the rate is missed


def lifted(x):
    """The metric m|ξ|² + |w|² on the states of the ball on the beam."""
    return 2 * tangent_metric(BEAM.space, Q)(jnp.zeros(()), x)


def beam_norm(q, a):
    return math.sqrt(a[0] ** 2 + (1 + q[0] ** 2) * a[1] ** 2)


def test_geodesics_of_the_lift_turn_by_no_more_than_the_curvature_allows():
    """Geodesics by Christoffel symbols of the metric on states, which know nothing of X, p and curvature."""
    rng = np.random.default_rng(1)
    moved = jax.jit(
        jax.vmap(lambda x, u, s: jax.jvp(lambda s: geometry.exp(lifted, x, s * u), (s,), (1.0,)), (None, None, 0))
    )
    bent = 0.0
    for _ in range(8):
        x, u = rng.uniform(-1, 1, 4), rng.normal(size=4)
        u *= 3 * rng.uniform() / math.sqrt(u @ np.asarray(lifted(jnp.asarray(x))) @ u)
        states, rates = (np.asarray(a) for a in moved(x, u, np.linspace(0.0, 1.0, 41)))
        q, v, speed = states[:, :2], states[:, 2:], rates[:, :2]
        changes = rates[:, 2:] + np.array(
            [
                [-a[0] * b[1] * c[1], a[0] / (1 + a[0] ** 2) * (b[0] * c[1] + b[1] * c[0])]
                for a, b, c in zip(q, v, speed, strict=True)
            ]
        )
        p = changes - SIGMA * speed
        sizes = np.array([beam_norm(*each) for each in zip(q, speed, strict=True)])
        pushes = np.array([beam_norm(*each) for each in zip(q, p, strict=True)])
        np.testing.assert_allclose(sizes, sizes[0], rtol=1e-5)
        np.testing.assert_allclose(M * sizes**2 + pushes**2, u @ np.asarray(lifted(jnp.asarray(x))) @ u, rtol=1e-5)
        area = np.abs(v[:, 0] * p[:, 1] - v[:, 1] * p[:, 0]) * np.sqrt(1 + q[:, 0] ** 2)
        turning = np.trapezoid(area / (1 + q[:, 0] ** 2) ** 2, dx=1 / 40) / M
        end = jnp.asarray(q[-1])
        away = -np.asarray(geometry.log(BEAM.space, end, jnp.asarray(q[0])))
        cosine = float(BEAM.space.lower(end, away) @ speed[-1]) / beam_norm(q[-1], away) / sizes[-1]
        assert math.acos(min(cosine, 1.0)) <= turning + 1e-4
        assert beam_norm(q[-1], away) >= sizes[0] * math.sin(turning) / turning * (1 - 1e-6)
        bent = max(bent, turning)
    assert bent > 0.1
