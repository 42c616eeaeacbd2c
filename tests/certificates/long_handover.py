"""What takes long of `test_handover.py`: filters and gates to which it hands over, and a gate around both."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_handover import ARM, JERK, SPEED, STEP, WITHIN, driven, motion

from covariant.certificates import certify_globally
from covariant.observers import Gated, Intrinsic, IntrinsicKalman, run
from covariant.signals import Record, StepCode

pytestmark = pytest.mark.long
SHARP = Intrinsic(ARM, 20.0, 200.0, substeps=1)
INNER = {
    "behind a gate": Gated(SHARP, ARM, 1e-3, 1.0, fast_start=True),
    "kalman": IntrinsicKalman(ARM, 0.1 * jnp.eye(2), 1e-8 * jnp.eye(2), jnp.eye(2), substeps=1),
}


@pytest.fixture(scope="module")
def certificate():
    return certify_globally(ARM, velocity=SPEED, interval=(STEP, STEP), jerk=JERK, lost=1, rate=3.0)


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
