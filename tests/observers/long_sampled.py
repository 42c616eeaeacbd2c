"""What takes long of `test_sampled.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_sampled import LENGTH, LOOPS, PLAIN, X0, codes, record

from covariant import geometry
from covariant._integrate import rk8
from covariant.geometry._functions import norm
from covariant.models import Lagrangian, pendulum_chain
from covariant.observers import EKF, Geodesic, Intrinsic, LagrangianMetric, ModelCopy, SavitzkyGolay, run
from covariant.observers.base._sampled import predict
from covariant.signals import Record, StepCode


@pytest.mark.exhaustive("geodesic", "ekf")
def test_an_observer_on_the_truth_stays_there(model_based, pendulum, irregular, follow):
    u = np.random.default_rng(0).normal(0, 0.5, (len(irregular), 1))  # held from each row to the next
    x = pendulum.truth(irregular, X0, u)
    followed = follow(model_based, irregular, x[:, :1], v0=x[0, 1:], u=u)
    np.testing.assert_allclose(followed.x, x[1:], rtol=0, atol=1e-6)
    np.testing.assert_allclose(followed.info.innovation, 0.0, atol=1e-8)
    assert set(codes(followed.info)) == {StepCode.OK}


GAP = slice(120, 260)


@pytest.mark.exhaustive("ekf")
def test_a_gap_is_coasted_along_the_model(model_based, pendulum, irregular, follow):
    x = pendulum.truth(irregular, X0)
    y = x[:, :1] + np.random.default_rng(0).normal(0, 0.01, (len(x), 1))
    y[GAP] = np.nan
    followed = follow(model_based, irregular, y)
    last = GAP.start - 1
    coasted = pendulum.truth(irregular[last : GAP.stop], followed.x[last - 1])
    assert np.abs(coasted[0] - x[last]).max() > 1e-3, "it must coast from its own estimate, not from the truth"
    np.testing.assert_allclose(followed.x[last : GAP.stop - 1], coasted[1:], rtol=0, atol=1e-6)
    expected = np.full(len(y), int(StepCode.OK))
    expected[GAP] = StepCode.COASTED
    # The first sample after it may come too late; and the noise is ten times what the filter is told.
    found = codes(followed.info)
    found = np.where(np.isin(found, [StepCode.OUTLIER, StepCode.RESTARTED]), StepCode.OK, found)
    np.testing.assert_array_equal(found, expected[1:])
    np.testing.assert_array_equal(followed.info.innovation[last : GAP.stop - 1], 0.0)
    np.testing.assert_array_equal(followed.info.distance[last : GAP.stop - 1], 0.0)


def test_a_gap_is_coasted_along_a_straight_line_without_a_model(filter_only, pendulum, irregular, follow):
    x = pendulum.truth(irregular, X0)
    y = x[:, :1].copy()
    y[GAP] = np.nan
    followed = follow(filter_only, irregular, y)
    # The polynomial forgets its samples one by one; then it, too, runs on along its last slope.
    first = GAP.start + 8
    q, v = followed.x[first : GAP.stop - 1].T
    np.testing.assert_allclose(v, v[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(q, q[0] + v[0] * (irregular[first + 1 : GAP.stop] - irregular[first + 1]), atol=1e-9)
    assert set(codes(followed.info)[GAP.start - 1 : GAP.stop - 1]) == {StepCode.COASTED}
    assert np.isfinite(followed.x).all()
    np.testing.assert_array_equal(followed.info.innovation[GAP.start - 1 : GAP.stop - 1], 0.0)


PLANAR = {
    "intrinsic": lambda model: Intrinsic(model, 40.0, 600.0, order=2),
    "copy": lambda model: ModelCopy(model, 40.0, 600.0),
    "ekf": lambda model: EKF(model, 10.0 * jnp.eye(2), 1e-6 * jnp.eye(2)),
}


@pytest.fixture(params=PLANAR)
def on_the_beam(request, beam):
    return PLANAR[request.param](beam.model)


@pytest.mark.exhaustive("intrinsic-both", "ekf-both", "ekf-one in turn", "ekf-one every fourth")
@pytest.mark.parametrize("joints", ["both", "one in turn", "one every fourth"])
def test_one_of_two_joints_may_be_missing(on_the_beam, beam, regular, follow, joints):
    x = beam.truth(regular, np.array([0.3, 0.1, 0.2, -0.9]))
    y = x[:, :2].copy()
    if joints == "one in turn":
        y[1::2, 0] = y[2::2, 1] = np.nan
    elif joints == "one every fourth":
        y[np.arange(len(y)) % 4 != 0, 1] = np.nan
    followed = follow(on_the_beam, regular, y)
    assert np.isfinite(followed.x).all()
    assert np.abs(followed.x[0, 2:] - x[1, 2:]).max() > 0.05
    np.testing.assert_allclose(followed.x[300:], x[301:], rtol=0, atol=0.02)
    expected = np.where(np.isnan(y).any(1), StepCode.COASTED, StepCode.OK)
    np.testing.assert_array_equal(codes(followed.info), expected[1:])
    np.testing.assert_array_equal(np.asarray(followed.info.innovation)[np.isnan(y[1:])], 0.0)


def test_single_precision_finds_the_motion_too(pendulum, regular, follow):
    x = pendulum.truth(regular, X0)
    t = (regular - regular[0] + 3.0).astype(np.float32)
    observer = Intrinsic(pendulum.model, jnp.array(20.0, np.float32), jnp.array(150.0, np.float32))
    followed = follow(observer, t, x[:, :1].astype(np.float32))
    assert followed.x.dtype == np.float32
    np.testing.assert_allclose(followed.x[200:, 1], x[201:, 1], rtol=0, atol=0.01)


def test_an_innovation_is_measured_against_a_straight_line_where_there_is_no_model(
    filter_only, pendulum, irregular, follow
):
    """What was measured minus where the estimate before leads in a straight line."""
    x = pendulum.truth(irregular, X0)
    followed = follow(filter_only, irregular, x[:, :1])
    q, v = followed.x[:-1].T
    expected = x[2:, 0] - (q + v * np.diff(irregular)[1:])
    np.testing.assert_allclose(followed.info.innovation[1:, 0], expected, rtol=0, atol=1e-12)
    assert np.abs(expected).max() > 1e-3


def test_gains_that_blow_up_are_reported_and_raise_nothing(with_gains, pendulum, regular, follow):
    x = pendulum.truth(regular, X0)
    unstable = eqx.tree_at(lambda o: o.alpha, with_gains, jnp.array(-1e4))
    followed = follow(unstable, regular, x[:, :1])
    lost = codes(followed.info) == StepCode.NOT_FINITE
    assert 2 < lost.sum() < len(lost) / 2
    # Each time it starts anew, at rest at the reading.
    np.testing.assert_array_equal(followed.x[lost, 0], x[1:][lost, 0])
    np.testing.assert_array_equal(followed.x[lost, 1], 0.0)
    assert np.isfinite(followed.x).all()


CURVED = Lagrangian(
    geometry.hyperbolic(), lambda q: 0.3 * jnp.sin(q[0]) + 0.2 * q[1] ** 2, dissipation=lambda q, v: -0.4 * v
)


@pytest.mark.exhaustive("Geodesic")
@pytest.mark.parametrize("kind", [Intrinsic, Geodesic, LagrangianMetric, ModelCopy])
def test_fine_samples_follow_the_flow_to_first_order(kind):
    """The error of the sampled observer against the integrated flow, both fed the same smooth measurement."""
    observer = kind(CURVED, 3.0, 4.0, substeps=1)
    end, u = 1.0, jnp.array([0.1, -0.2])

    def measured(t):
        return jnp.stack([0.3 * jnp.sin(2 * t), 0.2 * jnp.cos(3 * t) - 0.1])

    start = observer.init(measured(0.0) + jnp.array([0.1, -0.15]))._replace(v=jnp.array([0.5, 0.4]))

    @jax.jit
    def sampled(count):
        dt = end / count.astype(float)

        def step(k, state):
            return observer.step(state, u, measured((k + 1) * dt), dt)[0]

        return observer.estimate(jax.lax.fori_loop(0, count, step, start))

    def flow(t, state):
        return observer.flow(t, state, u, measured(t))

    reference = observer.estimate(jax.jit(lambda state: rk8(flow, jnp.array(0.0), state, end, 200))(start))
    counts = np.array([100, 200, 400, 800])
    error = [np.linalg.norm(sampled(jnp.array(n)) - reference) for n in counts]
    order = -np.polyfit(np.log(counts), np.log(error), 1)[0]
    assert order == pytest.approx(1.0, abs=0.05)
    assert error[-1] < 0.01


@pytest.mark.exhaustive
def test_what_a_step_leaves_of_the_geodesic_leads_from_the_measurement_to_the_new_estimate():
    """It is what the next search starts from, and exact: the rest of a geodesic is a geodesic."""
    observer, u, y = Geodesic(CURVED, 3.0, 4.0), jnp.zeros(2), jnp.array([0.3, -0.2])
    state = observer.init(jnp.array([-0.1, 0.4]))._replace(v=jnp.array([0.5, 0.4]))
    after, info = jax.jit(observer.step)(state, u, y, jnp.array(0.1))
    left = geometry.log(CURVED.metric, y, after.q)
    np.testing.assert_allclose(after.log, left, rtol=0, atol=1e-13)
    assert 0.5 < norm(CURVED.metric, y, left) / info.distance < 0.9


def hand_written(observer, record):
    """The loop of the documentation, row by row."""
    step = eqx.filter_jit(observer.step)
    state = observer.init(record.y[0], record.t[0])
    x = [observer.estimate(state)]
    for k in range(1, len(record.t)):
        state, _ = step(state, record.u[k - 1], record.y[k], record.t[k] - record.t[k - 1])
        x.append(observer.estimate(state))
    return np.stack(x)


@pytest.mark.exhaustive("EKF")
@pytest.mark.parametrize("observer", LOOPS, ids=lambda o: type(o).__name__)
def test_run_is_the_loop_written_by_hand(observer, record):
    done = run(observer, record)
    np.testing.assert_array_equal(done.t, record.t)
    assert done.info.result.shape == (LENGTH,)
    # Where most of its window is missing, the polynomial is barely determined: rounding grows by some 1e9.
    rtol = 1e-6 if isinstance(observer, SavitzkyGolay) else 0.0
    np.testing.assert_allclose(done.estimate, hand_written(observer, record), rtol=rtol, atol=1e-10)


@pytest.mark.parametrize("observer", LOOPS, ids=lambda o: type(o).__name__)
def test_a_run_begins_at_rest_at_the_first_measurement(observer, record):
    first = run(observer, record).estimate[0]
    np.testing.assert_array_equal(first, [record.y[0, 0], 0.0])


def test_a_run_is_traced_once_a_shape(record):
    traces = []

    def potential(q):
        traces.append(q.shape)
        return -jnp.cos(q[0])

    model = Lagrangian(geometry.Euclidean(), potential, circles=(0,))
    observer = ModelCopy(model, jnp.array(20.0), jnp.array(150.0))
    run(observer, record)
    once = len(traces)
    assert once > 0
    run(observer, record._replace(y=record.y + 0.1, t=record.t - 1.0))
    run(eqx.tree_at(lambda o: o.alpha, observer, jnp.array(30.0)), record)
    assert len(traces) == once
    run(observer, Record(*(a[:-1] for a in record[:3])))
    assert len(traces) > once


def test_gains_may_be_mapped_and_compiled(record):
    alphas = jnp.array([10.0, 20.0, 40.0])

    @jax.jit
    @jax.vmap
    def velocities(alpha):
        return run(ModelCopy(PLAIN, alpha, alpha**2 / 2), record).estimate[:, 1]

    for alpha, v in zip(alphas, velocities(alphas), strict=True):
        alone = run(ModelCopy(PLAIN, alpha, alpha**2 / 2), record).estimate[:, 1]
        np.testing.assert_allclose(v, alone, rtol=0, atol=1e-10)


COULOMB = 0.3


@pytest.fixture(scope="module")
def rubbing():
    """A light link with Coulomb friction as steep as a direct-drive joint's: 1500 1/s at rest."""
    return pendulum_chain((0.1,), (0.4,), com=(0.4,), inertia=(0.004,), coulomb=(COULOMB,), viscous=(0.01,))


def test_friction_divides_the_prediction_as_finely_as_it_needs(rubbing):
    """Against a step a hundred times finer: where one step fails by far, the chosen number of steps does not."""
    dt = 0.004
    angle = jnp.linspace(-1.5, 1.5, 12)[:, None]
    rate = jnp.array([0.0, 1e-3, -0.02, 0.1, 0.5, 3.0] * 2)[:, None]

    def after(substeps):
        move = jax.vmap(lambda q, v: jnp.concatenate(predict(rubbing, 0.0, q, v, jnp.zeros(1), dt, substeps)))
        return np.asarray(jax.jit(move)(angle, rate))

    fine, chosen, single = after(400), after(None), after(1)
    np.testing.assert_allclose(chosen, fine, rtol=0, atol=2e-3 * np.abs(fine[:, 1]).max())
    assert not np.abs(single - fine).max() < 20 * np.abs(chosen - fine).max()
