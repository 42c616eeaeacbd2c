"""What takes long of `test_group_observers.py`."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from charts import chart_velocity, in_chart
from error_law import ALPHA, BETA, directions, worst
from plain import rk4
from test_group_observers import CASES, OBSERVERS, system

from covariant.geometry import Budget
from covariant.geometry.lie import SO3
from covariant.models import Lagrangian, Motion, acceleration, free_body, heavy_top, input_count
from covariant.models.marine import euler_rotation
from covariant.observers import Geodesic, Intrinsic
from covariant.observers.constant_gain import GeodesicState
from covariant.papers._errata import PrintedGroup
from covariant.simulation import observe

SPEEDS = (0.0, 0.5, 3.0)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("observer", "name"), CASES)
def test_error_in_a_parallel_frame_obeys_the_linear_law_at_any_speed(observer, name):
    """Law (10): ξ' = ζ − αξ, ζ' = −βξ along any trajectory, to first order in the error."""
    model = system(name)
    for speed in SPEEDS:
        assert worst(OBSERVERS[observer](model, ALPHA, BETA), model, speed) <= 1e-4, f"at speed {speed}"


@pytest.mark.exhaustive
def test_the_exact_observer_on_the_arm_is_the_approximate_one_to_first_order():
    """So it obeys the linear law as that does: integrating it along a motion of the arm compiles for minutes."""
    model = system("robot, SE(3) x joints")
    x = model.manifold.retract(model.manifold.origin(), 0.4 * directions(model, model.manifold.origin(), 2)[0])
    along, error, rest = directions(model, x, 1)
    u = jnp.linspace(0.3, -0.2, input_count(model, len(error)))

    @jax.jit
    def apart(size):
        q, v = model.manifold.retract(x, size * error), 3.0 * along + 0.6 * size * rest
        slopes = [
            made.flow(jnp.zeros(()), made.init(q)._replace(v=v), u, x)
            for made in (Intrinsic(model, ALPHA, BETA), Geodesic(model, ALPHA, BETA, Budget(newton=0, steps=2)))
        ]
        return jnp.maximum(*(model.space.norm(q, a - b) for a, b in zip(slopes[0][:2], slopes[1][:2], strict=True)))

    sizes = np.geomspace(1e-4, 1e-2, 3)
    found = [float(apart(jnp.asarray(size))) for size in sizes]
    assert np.polyfit(np.log(sizes), np.log(found), 1)[0] == pytest.approx(2.0, abs=0.1)


@pytest.mark.exhaustive
def test_what_the_linear_law_leaves_out_is_of_first_order_in_the_error():
    model = system("SO(3)")
    small, large = (worst(OBSERVERS["intrinsic"](model, ALPHA, BETA), model, 3.0, size) for size in (1e-4, 1e-3))
    assert np.log10(large / small) == pytest.approx(1.0, abs=0.1)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["SO(3)", "SE(3)"])
def test_the_printed_observer_without_its_slips_keeps_the_law(name):
    model = system(name)
    assert worst(PrintedGroup(model, ALPHA / 2, BETA, ()), model, 3.0) <= 1e-4


def runge_kutta(slope, x, steps, h):
    """Trajectory of a compiled right-hand side; a loop in Python, so that it is compiled once."""
    path = [x]
    for _ in range(steps):
        path.append(rk4(slope, path[-1], h))
    return jnp.stack(path)


@pytest.mark.exhaustive
def test_coordinates_and_group_are_one_observer():
    """The exact observer in Euler angles and on SO(3), away from pitch 90°, on an asymmetric heavy top."""
    to_body = partial(chart_velocity, SO3, euler_rotation)
    model, budget = heavy_top((1.0, 2.0, 3.5), 2.0), Budget(newton=2, steps=12)
    angles = in_chart(model, euler_rotation)
    metric = jax.jit(lambda q: angles.metric(q))  # differentiated and batched in many places: each way once
    chart = Lagrangian(metric, angles.potential)
    exact = Geodesic(chart, 2.0, 3.0, budget)
    group = Geodesic(model, 2.0, 3.0, budget=budget)
    none, zero = jnp.zeros(3), jnp.zeros(())

    # The last three numbers of a state are where the search for the geodesic starts.
    @jax.jit
    def in_angles(x):
        q, v, estimate, w, log = jnp.split(x, 5)
        slope = exact.flow(zero, GeodesicState(estimate, w, zero, log), none, q)
        return jnp.concatenate([v, acceleration(chart, zero, q, v, none), slope.q, slope.v, slope.log])

    @jax.jit
    def on_group(x):
        g, v, estimate, w, log = x[:9].reshape(3, 3), x[9:12], x[12:21].reshape(3, 3), x[21:24], x[24:]
        slope = group.flow(zero, GeodesicState(estimate, w, zero, log), none, g)
        rate = acceleration(model, zero, g, v, none)
        moved = [(g @ SO3.hat(v)).ravel(), rate, (estimate @ SO3.hat(slope.q)).ravel(), slope.v, slope.log]
        return jnp.concatenate(moved)

    @jax.jit
    def carried_over(x):
        parts = [
            (euler_rotation(q).ravel(), to_body(q, rate)) for q, rate in (x[:6].reshape(2, 3), x[6:12].reshape(2, 3))
        ]
        return jnp.concatenate([a for part in parts for a in part])

    start = jnp.array([-0.1, 0.3, 0.2, 0.4, -0.2, 0.5, 0.2, 0.1, 0.4, 0.0, 0.1, 0.0, -0.3, 0.2, -0.2])
    warm = to_body(start[6:9], start[12:])
    carried = jnp.stack([carried_over(x) for x in runge_kutta(in_angles, start, 60, 0.02)])
    elements = runge_kutta(on_group, jnp.concatenate([carried_over(start), warm]), 60, 0.02)[:, :24]
    assert np.abs(carried - elements).max() < 1e-7
    gap = np.abs(elements[:, 21:] - elements[:, 9:12]).max(axis=1)
    assert gap[-1] < 0.5 * gap[0]


@eqx.filter_jit
def observed(observer, model, start, state, t):
    return observe(model, observer, start, state, t, rtol=1e-9, atol=1e-12)


@pytest.mark.exhaustive
def test_a_pitch_of_90_degrees_is_no_event():
    """The body pitches over at a constant rate, through 90°, where Euler angles have no rates."""
    model = free_body((1.0, 2.0, 3.5))
    t = jnp.linspace(0.0, 4.0, 81)
    start = Motion(jnp.eye(3), jnp.array([0.0, 1.0, 0.0]))
    observer = Intrinsic(model, 4.0, 8.0)
    x, state = observed(observer, model, start, observer.init(SO3.exp(jnp.array([0.1, -0.1, 0.2]))), t)
    distance = np.linalg.norm(np.asarray(x.v - state.v), axis=1)
    pitch = np.asarray(-jnp.arcsin(x.q[:, 2, 0]))
    assert pitch.max() > 1.54
    assert distance[-1] < 1e-2 * distance[0]
    assert np.isfinite(distance).all()
    assert np.abs(np.diff(np.log(distance))).max() < 0.5
