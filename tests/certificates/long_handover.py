"""What takes long of `test_handover.py`: filters, gates, lost and wrong ones to which it hands over, C."""

import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from test_handover import ARM, FAR, SPEED, STEP, WITHIN, certificate, driven, motion, sharp, true, with_gains

from covariant.engine import Stream, run_log
from covariant.observers import Gated, Intrinsic, IntrinsicKalman, run
from covariant.signals import Record, StepCode

pytestmark = pytest.mark.long
SHARP = Intrinsic(ARM, 20.0, 200.0, substeps=1)
INNER = {
    "behind a gate": Gated(SHARP, ARM, 1e-3, 1.0, fast_start=True),
    "kalman": IntrinsicKalman(ARM, 0.1 * jnp.eye(2), 1e-8 * jnp.eye(2), jnp.eye(2), substeps=1),
}


@pytest.mark.parametrize("which", INNER)
def test_filters_and_gates_keep_what_they_have_learnt(certificate, which):
    true = motion(0.25, 0.1, 0.0, 0.0)
    got = driven(certificate.hand_over(INNER[which], velocity=WITHIN), true[:, :2])
    assert got.switches == 1
    first = int(np.argmax(got.info.holds))
    assert np.abs(got.estimate[first + 1] - got.estimate[first]).max() < 0.02
    assert (np.abs(got.estimate - true[1:]) <= got.bound).all()
    assert np.abs(got.estimate[-1] - true[-1]).max() < 1e-3


def test_a_gate_around_both_turns_outliers_into_lost_rows(certificate):
    true = motion(0.25, 0.1, 0.0, 0.0)
    y = true[:, :2].copy()
    y[3000] += 0.5
    record = Record(STEP * np.arange(len(y)), np.zeros_like(y), y)
    both = certificate.hand_over(SHARP, velocity=WITHIN)
    bare, gated = (run(each, record) for each in (both, Gated(both, ARM, 1e-4, 1.0)))
    # Without it the proved observer takes the outlier, and what is reported is that.
    assert np.asarray(bare.info.holds)[3010] == 0
    assert np.asarray(gated.info.result)[3000] == StepCode.OUTLIER
    assert (np.asarray(gated.info.holds)[2500:] == 1).all()
    assert np.abs(gated.estimate - true)[2500:].max() < 1e-6


def test_a_sharper_observer_that_is_lost_starts_at_the_estimate_of_the_proved_one(certificate, sharp, true):
    both = certificate.hand_over(with_gains(sharp, 1e-6, 1e-9), velocity=WITHIN)
    got = driven(both, true[:, :2], *FAR)
    first = int(np.argmax(got.info.holds))
    assert got.info.holds[first] == 1
    np.testing.assert_array_equal(got.states.sharp.v[first], got.states.inner.v[first])
    assert np.abs(got.states.sharp.v[first - 1] - got.states.inner.v[first - 1]).max() > 1.0
    assert (np.abs(got.estimate - true[1:]) <= got.bound).all()


def test_an_arm_that_is_faster_than_stated_is_not_handed_over(certificate, sharp):
    x = motion(2.0, 0.5, 0.0, 0.0)
    assert np.abs(x[:, 2:]).max() > 3 * SPEED
    # It starts at rest and knows it, so that the sharper one is reported at first.
    got = driven(certificate.hand_over(sharp, velocity=WITHIN), x[:, :2], bound=0.0)
    holds, speed = np.asarray(got.info.holds), np.abs(x[1:, 2:]).max(1)
    assert holds[0] == 1
    assert not holds[speed > 1.5 * SPEED].any()
    assert (np.asarray(got.info.result)[speed > 1.5 * SPEED] == StepCode.ASTRAY).all()


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
def test_c_and_a_stream_do_the_same(certificate, sharp, true):
    both = certificate.hand_over(sharp, velocity=8 * WITHIN)
    y = true[:1500, :2].copy()
    y[1200:1204] = np.nan
    record = Record(STEP * np.arange(1500), np.zeros((1500, 2)), y)
    expected = run(both, record)
    assert set(np.asarray(expected.info.holds).tolist()) == {0.0, 1.0}
    done, engine = run_log(both, record, None, "c")
    assert engine == "c"
    np.testing.assert_allclose(done.estimate, expected.estimate, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(done.info.result, expected.info.result)
    np.testing.assert_allclose(done.info.velocity_bound, expected.info.velocity_bound, rtol=1e-9)
    stream = Stream(both, y[0], 1 / STEP, engine="c")
    streamed = [stream.step(t, y, u) for t, y, u in zip(record.t, record.y, record.u, strict=True)]
    np.testing.assert_allclose(np.stack(streamed)[1:], expected.estimate[1:], rtol=0, atol=1e-10)
