"""An estimate says what the best filter without a model would have left, and warns where that is less."""

import numpy as np
import pytest

import covariant
from covariant import observers
from covariant.calibration import even_velocity
from covariant.signals import Record
from covariant.verbs.base.design import log_sheet
from covariant.verbs.base.trial import trial_part
from covariant.verbs.base.without_model import without_model

NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.3}


@pytest.fixture(scope="module")
def log():
    made = covariant.simulate("pendulum_chain", duration=8.0, noise=1e-3, q0=[0.8, 0.5], rate=100.0).record
    return Record(made.t, made.u, made.y)  # without true velocities


@pytest.mark.exhaustive
def test_a_right_model_helps_and_the_estimate_says_so(log):
    result = covariant.estimate("pendulum_chain", log, overrides=NOISE)
    found = result.without_model
    assert found is not None
    assert found.surplus < -3
    assert found.own < found.error
    assert found.sentence("intrinsic") in str(result)
    assert "the model helps" in str(result)
    assert not any("without a model" in warning for warning in result.warnings)
    assert result.summary["without_model"]["filter"] == found.filter


@pytest.mark.exhaustive
def test_a_wrong_model_is_worse_than_none_and_a_warning_says_so(log):
    wrong = NOISE | {"parameters.mass": [1.0, 2.0]}
    result = covariant.estimate("pendulum_chain", log, overrides=wrong, anyway=True)
    found = result.without_model
    assert found is not None
    assert found.is_better
    assert found.own > 2 * found.error
    (warning,) = (each for each in result.warnings if "without a model" in each)
    assert f"estimate with the observer {found.filter}" in warning
    assert str(result).count("without a model") == 1


@pytest.mark.exhaustive
def test_equal_velocities_cannot_be_told_apart(log):
    result = covariant.estimate("pendulum_chain", log, score=True, overrides=NOISE)
    known, loaded = result.without_model, result.loaded
    assert known is not None
    name = known.filter
    # The estimate of the winner itself, by an independent route: its observer, run row by row.
    sheet = log_sheet(loaded.file, loaded)
    observer = loaded.kind.tuned(lambda: sheet, loaded.rate, (name,), trial_part(loaded)[0])[name]
    free = np.asarray(observers.run(observer, loaded.record).estimate)[:, 2:]
    found = without_model(loaded, free)
    assert found is not None
    assert found.filter == name
    assert abs(found.own / found.error - 1) < 0.01
    assert "cannot tell" in found.verdict


@pytest.mark.parametrize("observer", [observers.SavitzkyGolay(9, 2), observers.PLL(30.0)], ids=["window", "recursive"])
def test_a_filter_by_its_weights_is_the_observer_that_runs(observer, log):
    y = np.asarray(log.y)
    run = observers.run(observer, log)
    t = np.asarray(log.t)
    even, by_weights = even_velocity(observer.weights(100.0), 100.0, t, y)
    settled = even > 3.0
    np.testing.assert_allclose(by_weights[settled], np.asarray(run.estimate)[: len(even)][settled, 2:], atol=1e-6)


@pytest.mark.exhaustive
def test_the_filter_is_judged_with_the_outliers_that_it_would_read(log):
    random, y = np.random.default_rng(0), np.array(log.y)
    wrong = random.random(y.shape) < 0.02
    wrong[0] = False
    spoilt = log._replace(y=y + wrong * random.normal(0, 0.15, y.shape))
    result = covariant.estimate("pendulum_chain", spoilt, score=True, overrides=NOISE)
    found, loaded = result.without_model, result.loaded
    assert found is not None
    sheet = log_sheet(loaded.file, loaded)
    observer = loaded.kind.tuned(lambda: sheet, loaded.rate, (found.filter,), trial_part(loaded)[0])[found.filter]
    run = np.asarray(loaded.model.motion(observers.run(observer, loaded.record).estimate).v)
    again = without_model(loaded, run)
    assert again is not None
    assert again.own == pytest.approx(again.error, rel=1e-6)
    assert again.error == pytest.approx(found.error, rel=1e-9)


def test_nothing_is_said_where_nothing_can_be_judged(log):
    short = covariant.estimate("pendulum_chain", log, overrides=NOISE, until=1.0)
    free = covariant.estimate("pendulum_chain", log, overrides=NOISE, observer="savitzky-golay")
    quiet = covariant.estimate("pendulum_chain", log, alpha=10.0, beta=50.0)
    assert short.without_model is None
    assert free.without_model is None
    assert quiet.without_model is None
