"""What takes long of `test_observers.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from charts import in_chart
from error_law import ALPHA, BETA, worst
from jaxtyping import Array
from test_observers import SYSTEMS

from covariant import models
from covariant._integrate import rk8
from covariant.geometry import Budget, christoffel, curvature, hyperbolic
from covariant.models import Lagrangian, acceleration, source
from covariant.observers import REGISTRY, Geodesic, Intrinsic, MechanicalState

SPEEDS = (0.0, 0.5, 3.0, 10.0)


def promising(law: str) -> dict:
    """Makers of the observers in the registry that promise a law, by name, with the gains of this file."""
    return {entry.name: lambda m, e=entry: e.make(m, ALPHA, BETA) for entry in REGISTRY if law in entry.promises}


OBSERVERS = promising("error law") | {
    "intrinsic, coefficients at the estimate": lambda m: Intrinsic(m, ALPHA, BETA, coefficients="estimated"),
    "geodesic, converged": lambda m: Geodesic(m, ALPHA, BETA, Budget()),
}
"""Those in the registry, and forms of them that a user may choose."""


class Spoiled(eqx.Module):
    """Observer (5) with one mistake: what the law tests are there to catch."""

    model: Lagrangian
    mistake: str = eqx.field(static=True)

    def init(self, y: Array) -> MechanicalState:
        return MechanicalState(y, jnp.zeros_like(y), jnp.zeros((), y.dtype))

    def flow(self, t, state, u, y):
        q, v, _ = state
        metric = self.model.metric
        xi = -self.model.manifold.towards(q, y)
        s = source(self.model, t, y, u)
        sign = -1.0 if self.mistake == "curvature sign" else 1.0
        drive = s + sign * curvature(metric, y, xi, v, v)
        if self.mistake != "no source transport":
            drive = drive - christoffel(metric, y, s, xi)
        q_dot = v - ALPHA * xi
        at = y if self.mistake == "Γ(q) for Γ(q̂)" else q
        return MechanicalState(q_dot, drive - BETA * xi - christoffel(metric, at, v, q_dot), jnp.ones(()))


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("observer", OBSERVERS)
def test_error_in_a_parallel_frame_obeys_the_linear_law_at_any_speed(observer, name):
    """Law (10): ξ' = ζ − αξ, ζ' = −βξ along any trajectory, to first order in the error."""
    model = SYSTEMS[name]
    for speed in SPEEDS:
        assert worst(OBSERVERS[observer](model), model, speed, 1e-6) <= 1e-4, f"at speed {speed}"


@pytest.mark.exhaustive
@pytest.mark.parametrize("observer", ["intrinsic", "geodesic"])
def test_what_the_linear_law_leaves_out_is_of_first_order_in_the_error(observer):
    model = SYSTEMS["ball and beam"]
    small, large = (worst(OBSERVERS[observer](model), model, 3.0, size) for size in (1e-4, 1e-3))
    assert np.log10(large / small) == pytest.approx(1.0, abs=0.1)


@pytest.mark.exhaustive
@pytest.mark.parametrize("mistake", ["curvature sign", "Γ(q) for Γ(q̂)", "no source transport"])
@pytest.mark.parametrize("name", ["hyperbolic plane", "ball and beam"])
def test_each_mistake_breaks_the_linear_law(mistake, name):
    assert worst(Spoiled(SYSTEMS[name], mistake), SYSTEMS[name], 3.0) > 5e-3


@pytest.mark.exhaustive
def test_the_spoiled_observer_without_a_mistake_keeps_the_law():
    model = SYSTEMS["ball and beam"]
    assert worst(Spoiled(model, "none"), model, 3.0) <= 1e-4


DAMPED = {
    "double pendulum": (models.pendulum_chain((1.0, 0.7), (0.5, 0.4), viscous=(0.2, 0.1)), [0.4, 0.6]),
    "heavy top": (models.heavy_top((1.0, 2.0, 3.5), 2.0, viscous=0.2), [0.4, 0.6, -0.3]),
}


@pytest.mark.exhaustive(
    "double pendulum-geodesic",
    "double pendulum-geodesic, converged",
    "heavy top-geodesic",
    "heavy top-geodesic, converged",
)
@pytest.mark.parametrize("observer", OBSERVERS)
@pytest.mark.parametrize("name", DAMPED)
def test_without_an_error_the_estimate_moves_as_the_plant(observer, name):
    """Friction at the estimate is a part of the observer, beside the published law."""
    model, at = DAMPED[name]
    y, v = model.manifold.retract(model.manifold.origin(), jnp.array(at)), jnp.array([1.0, -2.0, 0.5])[: len(at)]
    u, made = jnp.full(len(at) if model.inputs is None else model.inputs, 0.3), OBSERVERS[observer](model)

    @jax.jit
    def both():
        slope = made.flow(jnp.zeros(()), made.init(y)._replace(v=v), u, y)
        return (slope.q, slope.v), (v, acceleration(model, jnp.zeros(()), y, v, u))

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12), *both())


def shear(a, b):
    """A random cubic diffeomorphism of the plane with an exact inverse: two shears."""

    def forward(z):
        x, y = z
        y = y + x * x * (a[0] + a[1] * x)
        return jnp.stack([x + y * y * (b[0] + b[1] * y), y])

    def inverse(q):
        x, y = q
        x = x - y * y * (b[0] + b[1] * y)
        return jnp.stack([x, y - x * x * (a[0] + a[1] * x)])

    return forward, inverse


FORWARD, INVERSE = shear(*(0.3 * np.random.default_rng(3).normal(size=(2, 2))))


PLAIN = Lagrangian(SYSTEMS["double pendulum"].metric, SYSTEMS["double pendulum"].potential, inputs=2)


BENT = in_chart(PLAIN, FORWARD)


def passed(flow, start, t):
    """The solution from `start` at all later stamps, by fixed steps that are quick to compile and accurate to 1e-12."""

    def interval(x, begin):
        after = rk8(flow, begin, x, t[1], 8)
        return after, after

    return jax.lax.scan(interval, start, t[:-1])[1]


@eqx.filter_jit
def estimates(observer, model, x0, start, t):
    none = jnp.zeros(2)

    def flow(s, joint):
        (q, v), state = joint
        return (v, acceleration(model, s, q, v, none)), observer.flow(s, state, none, q)

    joint = (x0[:2], x0[2:]), observer.init(start[:2])._replace(v=start[2:])
    _, state = passed(flow, joint, t)
    return jnp.concatenate([state.q, state.v], axis=1)


def chart_gap(make) -> float:
    """Largest difference of the estimates of one double pendulum made in two charts, both mapped to q."""
    x0, start = jnp.array([0.2, -0.3, 0.5, 0.4]), jnp.array([0.35, -0.1, 0.2, 0.1])

    def there(x):
        return jnp.concatenate(jax.jvp(INVERSE, (x[:2],), (x[2:],)))

    def back(z):
        return jnp.concatenate(jax.jvp(FORWARD, (z[:2],), (z[2:],)))

    t = jnp.linspace(0.0, 1.5, 7)
    direct = estimates(make(PLAIN), PLAIN, x0, start, t)
    begin = jax.jit(jax.vmap(there))(jnp.stack([x0, start]))
    mapped = jax.jit(jax.vmap(back))(estimates(make(BENT), BENT, *begin, t))
    return float(np.abs(mapped - direct).max())


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", promising("coordinate-free"))
def test_a_coordinate_free_observer_is_the_same_in_all_coordinates(name):
    """As exactly as it solves for its geodesics, which by default is a fixed amount of work."""
    assert chart_gap(promising("coordinate-free")[name]) <= 5e-5


@pytest.mark.exhaustive
def test_the_exact_observer_is_the_same_to_the_tolerance_of_the_integration():
    assert chart_gap(lambda m: Geodesic(m, ALPHA, BETA, Budget(steps=4))) <= 1e-8


@pytest.mark.exhaustive
def test_the_approximate_observer_is_not():
    assert chart_gap(lambda m: Intrinsic(m, ALPHA, BETA)) > 1e-3


@pytest.mark.exhaustive
@pytest.mark.parametrize(("order", "slope"), [(1, 2.0), (2, 2.0)])
def test_intrinsic_differs_from_geodesic_by_second_order(order, slope):
    """The second-order error ξ leaves a second-order rest too: the transport and curvature are still of first order."""
    model = models.pendulum_chain((1.0, 0.7), (0.5, 0.4))
    y, v, u = jnp.array([0.4, 0.6]), jnp.array([1.0, -2.0]), jnp.array([0.3, -0.2])
    exact, near = Geodesic(model, ALPHA, BETA, Budget()), Intrinsic(model, ALPHA, BETA, order=order)

    @jax.jit
    def gap(size):
        q = y + size * jnp.array([0.8, -0.6])
        one = exact.flow(jnp.zeros(()), exact.init(q)._replace(v=v), u, y)
        two = near.flow(jnp.zeros(()), near.init(q)._replace(v=v), u, y)
        return jnp.linalg.norm(jnp.concatenate([one.q - two.q, one.v - two.v]))

    sizes = np.geomspace(1e-3, 1e-2, 5)
    fitted = np.polyfit(np.log(sizes), np.log([float(gap(jnp.asarray(s))) for s in sizes]), 1)[0]
    assert fitted == pytest.approx(slope, abs=0.05)
