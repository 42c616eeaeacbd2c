"""A proved observer that hands over to a sharper one: bounds at every sample, returns, switches, C and streams."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import certify_globally
from covariant.observers import Intrinsic, MeasuredCoefficients
from covariant.simulation import simulate

ARM = models.pendulum_chain((1.0, 1.0), (0.5, 0.5))
STEP, ROWS = 0.001, 4000
SPEED, JERK = 1.0, 15.0
FAR = 3.0, 20.0
"""First errors of each position and velocity [rad, rad/s]."""
WITHIN = 0.1
"""Errors of velocities below which the sharper observer takes over [rad/s]."""


def motion(*x0):
    """States (ROWS, 4) of the true motion."""
    stamps = jnp.asarray(STEP * np.arange(ROWS))
    return np.asarray(eqx.filter_jit(simulate)(ARM, jnp.asarray(x0), stamps).x)


@pytest.fixture(scope="module")
def true():
    x = motion(0.25, 0.1, 0.0, 0.0)
    v = x[:, 2:]
    assert np.abs(v).max() < SPEED
    assert np.abs(np.diff(v, 2, axis=0)).max() < JERK * STEP**2  # the premises of the certificate
    return x


@pytest.fixture(scope="module")
def certificate():
    return certify_globally(ARM, velocity=SPEED, interval=(STEP, STEP), jerk=JERK, lost=1, rate=3.0)


@pytest.fixture(scope="module")
def sharp():
    return Intrinsic(ARM, 20.0, 200.0, substeps=1)


class Driven(NamedTuple):
    """What is reported after every row but the first, with the states."""

    estimate: np.ndarray
    info: Any
    states: Any

    @property
    def bound(self):
        return np.concatenate([self.info.position_bound, self.info.velocity_bound], axis=1)

    @property
    def switches(self):
        return int(np.abs(np.diff(np.asarray(self.info.holds))).sum())


@eqx.filter_jit
def _scanned(observer, state, y):
    def one(state, y):
        state, info = observer.step(state, jnp.zeros(2), y, STEP)
        return state, (observer.estimate(state), info, state)

    return jax.lax.scan(one, state, y)[1]


def driven(observer, y, q=0.0, v=0.0, bound=None) -> Driven:
    """Run it from the first reading, off by q and v in every coordinate, with the bound that is known."""
    state = observer.init(jnp.asarray(y[0]))
    inner = state.inner._replace(q=state.inner.q + q, v=state.inner.v + v)
    known = observer._by_data(inner) if bound is None else jnp.asarray(bound)
    state = state._replace(inner=inner, sharp=observer._start(inner), bound=known)
    return Driven(*_scanned(observer, state, jnp.asarray(y[1:])))


def with_gains(sharp, alpha, beta):
    """Gains that the class refuses, too."""
    return eqx.tree_at(lambda o: (o.alpha, o.beta), sharp, (jnp.asarray(alpha), jnp.asarray(beta)))


def norm(document, x):
    """The norm of the certificate, by its definition, of errors (T, 4)."""
    error = np.stack([document.omega * x[:, :2], x[:, 2:]], axis=-1) / document.weights[:, None]
    return np.sqrt(np.einsum("tia,iab,tib->t", error, document.metrics, error))


@pytest.fixture(scope="module")
def far(certificate, sharp, true):
    return driven(certificate.hand_over(sharp, velocity=WITHIN), true[:, :2], *FAR)


def test_from_far_it_hands_over_once_and_is_then_the_sharper_one(far, certificate, sharp, true):
    errors = np.abs(far.estimate - true[1:])
    assert (errors <= far.bound).all()
    assert far.switches == 1
    first = int(np.argmax(far.info.holds))
    start = sharp.init(jnp.asarray(true[0, :2] + FAR[0]))._replace(v=jnp.full(2, FAR[1]))
    alone = np.asarray(_scanned(sharp, start, jnp.asarray(true[1:, :2]))[0])
    own = np.concatenate([far.states.inner.q, far.states.inner.v], axis=1)
    np.testing.assert_allclose(far.estimate[first:], alone[first:], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(far.estimate[:first], own[:first])
    assert errors[-1, 2:].max() < 1e-3 * np.abs(own - true[1:])[-1, 2:].max()


def test_the_bound_is_that_of_the_norm_at_every_sample(far, certificate, true):
    """Computed from its definition; it begins by the measurement and the largest speed alone."""
    own = np.concatenate([far.states.inner.q, far.states.inner.v], axis=1) - true[1:]
    assert (norm(certificate.document, own) <= far.states.bound).all()
    # From where it is less than the measurement alone tells it falls at the rate of the certificate, to the radius.
    left = np.asarray(far.states.bound) - certificate.document.radius()
    falling = np.exp(-certificate.document.rate * STEP * np.arange(len(left) - 1000))
    np.testing.assert_allclose(left[1000:], left[1000] * falling, rtol=1e-4)
    rest = driven(certificate.hand_over(Intrinsic(ARM, 20.0, 200.0, substeps=1), velocity=WITHIN), true[:, :2])
    assert rest.switches == 1
    assert rest.states.bound[0] < 0.2 * far.states.bound[0]


def test_a_wrong_sharper_observer_is_left_and_what_is_reported_stays_within_its_bound(certificate, sharp, true):
    """Each return halves what is asked of the proved one, so that switches are rare."""
    wrong = with_gains(sharp, -5.0, -200.0)
    both = certificate.hand_over(wrong, velocity=6 * WITHIN)
    got = driven(both, true[:, :2], *FAR)
    assert (np.abs(got.estimate - true[1:]) <= got.bound).all()
    returns = int((np.diff(np.asarray(got.info.holds)) < 0).sum())
    assert returns >= 2
    np.testing.assert_allclose(got.states.level[-1], both.level / 2**returns)
    assert both.level / 2**returns > both.radius / 2  # below the errors that remain it never takes over again
    assert got.info.holds[-1] == 0


def test_after_a_jump_the_proved_observer_reports_at_once(certificate, sharp, true):
    jumped = motion(-0.15, -0.07, 0.4, 0.1)
    assert np.abs(jumped[:, 2:]).max() < SPEED
    x = np.concatenate([true[:2500], jumped[: ROWS - 2500]])
    both = certificate.hand_over(sharp, velocity=WITHIN)
    got = driven(both, x[:, :2], *FAR)
    assert (np.abs(got.estimate - x[1:]) <= got.bound).all()
    holds = np.asarray(got.info.holds)
    assert holds[2498] == 1
    assert holds[2499] == 0
    assert got.states.level[-1] == both.level
    assert got.switches <= 3


def test_lost_rows_are_covered_as_far_as_the_certificate_says(certificate, sharp, true):
    """One in a row; beyond it the bound begins anew by the measurement."""
    y = true[:, :2].copy()
    y[3000], y[3200:3202], y[3400, 0] = np.nan, np.nan, np.nan
    got = driven(certificate.hand_over(sharp, velocity=WITHIN), y, *FAR)
    holds, bound = np.asarray(got.info.holds), got.bound
    assert (np.abs(got.estimate - true[1:]) <= bound).all()
    assert np.isinf(bound[[2999, 3199, 3200, 3399]]).all()
    assert np.isfinite(np.delete(bound, [2999, 3199, 3200, 3399], 0)).all()
    assert (holds[2990:3201] == 1).all()
    assert holds[3201] == 0
    assert got.states.bound[3000] < 1.01 * got.states.bound[2998]
    assert got.states.bound[3201] > 5 * got.states.bound[3198]


def test_what_does_not_fit_is_refused(certificate, sharp):
    for make, message in (
        (lambda: certificate.hand_over(sharp, velocity=1e-3), "proved to be within"),
        (lambda: certificate.hand_over(Intrinsic(models.oscillator(), 1.0, 1.0), velocity=1.0), "same coordinates"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    weak = certify_globally(MeasuredCoefficients(ARM, 3.0, 4.0, SPEED), interval=(STEP, STEP))
    with pytest.raises(ValueError, match="nothing is proved"):
        weak.hand_over(sharp, velocity=1.0)
