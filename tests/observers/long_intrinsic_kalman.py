"""The intrinsic Kalman filter: its reset is exact, and it is the same in all coordinates: what takes long."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from charts import chart_jacobian, chart_velocity, in_chart
from jaxtyping import Array
from plants import body, sphere_pendulum
from test_intrinsic_kalman import double_pendulum, isotropic

from covariant import models
from covariant.geometry import Budget
from covariant.geometry.lie import SO3
from covariant.models import Lagrangian, Motion, Parametric
from covariant.models.marine import euler_rotation
from covariant.observers import IntrinsicKalman
from covariant.signals import StepCode

INERTIA = jnp.diag(jnp.array([1.0, 2.0, 3.5]))


FINE = Budget(newton=None, steps=12)


STRICT = Budget(newton=2, steps=16)


def test_an_angle_starts_anew_where_it_is_uncertain_by_more_than_its_noise_explains():
    """A wheel whose velocity is known to 1 rad/s: after 0.4 s its angle is to 0.4 rad, after 0.6 s to 0.6 rad."""
    wheel = Lagrangian(lambda q: jnp.eye(1), lambda q: jnp.zeros(()), circles=(0,))
    start = IntrinsicKalman(wheel, 1e-6, 1.0, 1.0).init(jnp.zeros(1))

    @jax.jit
    def stepped(noise, dt):
        known = start._replace(root=jnp.diag(jnp.stack([noise, jnp.ones(())])))
        observer = IntrinsicKalman(wheel, 1e-6, noise**2, 1.0, gate=None, substeps=1)
        found, info = observer.step(known, jnp.zeros(1), jnp.array([0.1]), dt)
        return jnp.concatenate([found.q, found.v]), info.result

    for noise, dt, restarts in ((0.01, 0.4, False), (0.01, 0.6, True), (1.0, 0.4, False), (1.0, 0.6, False)):
        found, result = stepped(jnp.asarray(noise), jnp.asarray(dt))
        gain = np.array([dt**2 + noise**2, dt]) / (dt**2 + 2 * noise**2)
        assert result == (StepCode.RESTARTED if restarts else StepCode.OK)
        np.testing.assert_allclose(found, [0.1, 0.0] if restarts else 0.1 * gain, atol=1e-5)


CASES = {
    "SO(3)": (body(), SO3.exp(jnp.array([0.3, -0.2, 0.4])), (1.0, -2.0, 1.5)),
    "sphere": (sphere_pendulum(), jnp.array([1.1, 0.4]), (1.5, -2.0)),
    "double pendulum": (double_pendulum(), jnp.array([0.5, -0.8]), (2.0, -1.0)),
}


@pytest.mark.parametrize("name", CASES)
def test_the_reported_deviations_are_of_the_velocity_as_it_is_written(name):
    """Those of v − v̂, which differ from those of ν where the machine is fast."""
    model, q, v = CASES[name]
    n = len(v)
    observer = isotropic(model)
    root = jnp.asarray(np.random.default_rng(1).normal(size=(2 * n, 2 * n)))
    state = observer.init(q)._replace(v=jnp.array(v), root=root)
    written = jax.jit(lambda e: model.space.transport_along(q, e[:n], state.v + e[n:], FINE).w)
    h = 1e-4
    slopes = np.stack([(written(h * e) - written(-h * e)) / (2 * h) for e in np.eye(2 * n)], axis=1)
    np.testing.assert_allclose(observer.velocity_std(state), np.linalg.norm(slopes @ root, axis=1), rtol=1e-6)
    assert np.abs(slopes[:, :n]).max() > 0.1  # the difference is there


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", CASES)
def test_the_reset_is_the_derivative_of_the_exact_change_of_base_point(name):
    model, q, v = CASES[name]
    space, n = model.space, len(v)
    observer = isotropic(model, budget=FINE)
    correction = 0.25 * jnp.asarray(np.random.default_rng(1).normal(size=2 * n))
    state = observer.init(q)._replace(v=jnp.array(v))

    @jax.jit
    def rebased():
        moved, reset = observer.moved(state, correction)
        return moved.q, moved.v, reset

    new_q, new_v, reset = rebased()

    @jax.jit
    def seen_anew(error):
        """(ε, ν) of the old estimate, seen from the new one: out along the geodesic and back, by shooting."""
        true = space.transport_along(q, error[:n], state.v + error[n:], FINE)
        shot = space.shoot(new_q, true.q, None, FINE)
        back = space.transport_along(true.q, -shot.arrival, true.w, FINE)
        return jnp.concatenate([shot.velocity, back.w - new_v])

    np.testing.assert_allclose(seen_anew(correction), 0, atol=1e-11)
    h = 2e-3
    one, two = ([seen_anew(correction + a) - seen_anew(correction - a) for a in k * h * np.eye(2 * n)] for k in (1, 2))
    slopes = (8 * np.stack(one, axis=1) - np.stack(two, axis=1)) / (12 * h)
    np.testing.assert_allclose(reset, slopes, rtol=0, atol=1e-8)
    assert np.abs(reset - np.eye(2 * n)).max() > 0.02  # it does something


@pytest.mark.exhaustive
def test_body_frame_and_euler_angles_predict_correct_and_reset_alike():
    rigid = body()
    angles, rates = jnp.array([0.4, 0.5, -0.3]), jnp.array([1.0, -0.8, 1.2])
    measured = angles + jnp.array([0.25, -0.2, 0.3])
    fine = {"budget": STRICT, "substeps": 40, "gate": None}
    there, here = isotropic(rigid, **fine), isotropic(body_in_euler_angles(), **fine)

    def turned(q):
        return chart_jacobian(SO3, euler_rotation, q)

    @eqx.filter_jit
    def both(observer, q, v, y):
        state = observer.init(q)._replace(v=v)
        return observer.correct(observer.predict(state, jnp.zeros(3), jnp.asarray(0.2)), jnp.zeros(3), y)[0]

    group = both(there, euler_rotation(angles), turned(angles) @ rates, euler_rotation(measured))
    chart = both(here, angles, rates, measured)
    np.testing.assert_allclose(euler_rotation(chart.q), group.q, rtol=0, atol=1e-9)
    to_body = turned(chart.q)
    np.testing.assert_allclose(to_body @ chart.v, group.v, rtol=0, atol=1e-8)
    map_ = jnp.kron(jnp.eye(2), to_body)
    np.testing.assert_allclose(map_ @ here.cov(chart) @ map_.T, there.cov(group), rtol=0, atol=1e-9)


class Lottery(NamedTuple):
    """A machine in coordinates, which are warped from draw to draw, how it moves and what is wrong of it."""

    model: Any
    chart: Any  # (z, a, b) -> configuration
    z: tuple[float, ...]
    rate: tuple[float, ...]
    first_error: float
    noise: float


def warped(z, a, b):
    """A map of Rⁿ in which waves of the next coordinate shear each; one to one where |a| + 2|b| < 1."""
    following = jnp.roll(z, -1)
    return z + a * jnp.sin(following) + b * jnp.cos(2 * following)


def body_in_euler_angles() -> Lagrangian:
    """A body on SO(3) in roll, pitch and yaw, its metric written out, which compiles sooner than `in_chart` does."""

    def metric(z):
        (cr, cp, _), (sr, sp, _) = jnp.cos(z), jnp.sin(z)
        one, none = jnp.ones_like(cr), jnp.zeros_like(cr)
        rows = ((one, none, -sp), (none, cr, sr * cp), (none, -sr, cr * cp))
        turned = jnp.stack([jnp.stack(row) for row in rows])
        return turned.T @ INERTIA @ turned

    return Lagrangian(metric, coordinates=("roll", "pitch", "yaw"))


LOTTERIES = {
    "double pendulum": Lottery(double_pendulum(), warped, (0.5, -0.8), (2.0, -1.0), 0.3, 0.02),
    "sphere": Lottery(sphere_pendulum(), warped, (1.1, 0.4), (0.8, -2.0), 0.3, 0.05),
    "SO(3)": Lottery(body_in_euler_angles(), warped, (0.4, 0.3, -0.3), (0.6, -0.8, 0.5), 0.3, 0.05),
}


DRAWS = 10


RATE = 50.0


SAMPLES = 40


@functools.cache
def samples(name: str) -> tuple[Motion, Array]:
    """The true motion at the stamps, and what is measured of it: large noise, a larger error at the start."""
    return jax.jit(functools.partial(recorded, LOTTERIES[name]))()


def recorded(case: Lottery) -> tuple[Motion, Array]:
    n, manifold = len(case.z), case.model.manifold
    none = Parametric(case.chart, a=np.zeros(n), b=np.zeros(n))
    z, rate = jnp.array(case.z), jnp.array(case.rate)
    noise = case.noise * np.random.default_rng(7).normal(size=(SAMPLES, n))
    noise[0] *= case.first_error / case.noise

    def step(motion, _):
        return models.advance(case.model, 0.0, motion, jnp.zeros(n), 1 / RATE, 4), motion

    true = jax.lax.scan(step, Motion(none(z), chart_velocity(manifold, none, z, rate)), None, SAMPLES)[1]
    return true, jax.vmap(manifold.retract)(true.q, jnp.asarray(noise))


def player(case: Lottery, make: Any) -> Any:
    """`(y, noise, draw) -> v`, compiled: estimates of the velocity (SAMPLES - 1, n), in the frame of the machine, of a
    filter that `make(model, noise)` makes in the chart of a draw."""
    n, manifold = len(case.z), case.model.manifold

    @eqx.filter_jit
    def played(y, noise, draw):
        chart = Parametric(case.chart, a=draw[0], b=draw[1])
        observer = make(in_chart(case.model, chart), noise)

        def inverse(guess, q):
            def newton(_, z):
                return z + jnp.linalg.solve(chart_jacobian(manifold, chart, z), manifold.local(chart(z), q))

            found = jax.lax.fori_loop(0, 12, newton, guess)
            return found, found

        measured = jax.lax.scan(inverse, jnp.array(case.z), y)[1]

        def step(state, sample):
            state, _ = observer.step(state, jnp.zeros(n), sample, jnp.asarray(1 / RATE))
            return state, chart_velocity(manifold, chart, state.q, state.v)

        return jax.lax.scan(step, observer.init(measured[0]), measured[1:])[1]

    return played


def draws(case: Lottery) -> list[Array]:
    """What the charts are warped by."""
    return list(jnp.asarray(0.15 * np.random.default_rng(1).normal(size=(DRAWS, 2, len(case.z)))))


def intrinsic_kalman(model, noise):
    return isotropic(model, 0.5, noise, 3.0, gate=None, budget=Budget(newton=1, steps=3), substeps=2)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", LOTTERIES)
def test_ten_charts_make_no_difference(name):
    """Less than a hundredth of the error itself, at errors of a third of a radian and noise of a twentieth."""
    case = LOTTERIES[name]
    true, y = samples(name)
    played, true = player(case, intrinsic_kalman), true.v[1:]
    estimates = np.stack([played(y, jnp.asarray(0.05), draw) for draw in draws(case)])
    errors = np.sqrt(np.mean((estimates - np.asarray(true)) ** 2, axis=(1, 2)))
    assert np.isfinite(errors).all()
    assert np.ptp(errors) < 0.01 * errors.mean()
    assert np.abs(estimates - estimates[0]).max() < 0.1 * errors.mean()  # at the worst sample
