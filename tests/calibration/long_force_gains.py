"""What takes long of `test_force_gains.py`."""

import numpy as np
import pytest
from test_force_gains import FORCE, NOISE

import covariant
from covariant import models
from covariant.models import oscillator
from covariant.verbs.base.design import design


@pytest.mark.exhaustive
def test_the_estimate_of_a_log_has_the_force():
    log = covariant.simulate("oscillator", duration=2.0, rate=100.0, noise=1e-4, push=[3.0], seed=1)
    result = covariant.estimate("oscillator", log.record, overrides=NOISE | FORCE)
    assert list(result.columns)[-1] == "external_force1"
    true = np.asarray(log.columns["true_external_force1"])
    assert np.mean((result.columns["external_force1"] - true)[20:] ** 2) < 0.05 * np.mean(true**2)


@pytest.mark.exhaustive
def test_an_observer_without_a_force_to_learn_says_so():
    file = models.load("oscillator", NOISE)
    log = covariant.simulate("oscillator", duration=0.2, rate=100.0, noise=1e-4).record
    result = covariant.estimate(file, log, observer="intrinsic-force", engine="jax")
    assert "It learns no force" in result.summary["design"]
