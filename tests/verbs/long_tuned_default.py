"""`tune` keeps noise with which a filter would be worse, and writes the observer that `estimate` then takes."""

import numpy as np
import pytest

import covariant
from covariant import models
from covariant.calibration import ErrorRatio
from covariant.signals import Record
from covariant.verbs.base.aligned import aligned
from covariant.verbs.base.inputs import Job
from covariant.verbs.base.trial import judging_reference
from covariant.verbs.base.tune_to_logs import confirm
from covariant.verbs.base.without_model import WithoutModel

RIGHT = models.ModelFile("arm", models.pendulum_chain(), measurement_std=1e-3, acceleration_std=0.3)
"""What is known of a double pendulum; the model is right."""


@pytest.fixture(scope="module")
def log():
    return covariant.simulate(models.pendulum_chain(), duration=8.0, noise=1e-3, q0=[0.8, 0.5], rate=100.0).record


@pytest.fixture(scope="module")
def tuned(log):
    return covariant.tune(RIGHT, Record(*log[:3]))


@pytest.fixture(scope="module")
def loaded(log):
    one = aligned(Job(RIGHT, Record(*log[:3]))).loaded
    return one._replace(reference=judging_reference(one))


def test_noise_with_which_a_filter_is_worse_is_not_written(tuned, loaded):
    noise = tuned.tuning.noise
    wrong = tuned.tuning._replace(noise=noise._replace(acceleration=1e4 * noise.acceleration + 30.0), noise_kept="")
    kept, taken = (confirm([loaded], each) for each in (wrong, tuned.tuning))
    assert kept.tuning.noise_kept == "velocities"
    assert set(kept.tables) == {"design"}
    assert kept.tuning.after.likelihood == kept.tuning.before.likelihood
    assert not taken.tuning.noise_kept
    assert set(taken.tables) == {"measurement", "uncertainty", "design"}


def test_a_filter_that_is_clearly_better_is_the_default_and_estimate_says_so(tuned, loaded, log):
    """Gains that are far too fast, which no filter has."""
    fast = tuned.tuning._replace(natural_frequency=60.0, damping=0.3)
    assert confirm([loaded], tuned.tuning).tables["design"]["observer"] == "intrinsic"
    confirmed = confirm([loaded], fast)
    assert confirmed.tables["design"]["observer"] == "intrinsic-kalman"
    pairs = {f"{table}.{key}": value for table, each in confirmed.tables.items() for key, value in each.items()}
    file = models.load(RIGHT, pairs)
    result = covariant.estimate(file, Record(*log[:3]))
    assert result.observer_name == "intrinsic-kalman"
    assert "The model file chooses intrinsic-kalman." in str(result)
    assert covariant.estimate(file, Record(*log[:3]), observer="intrinsic").observer_name == "intrinsic"


def test_tune_estimate_and_compare_name_one_filter_and_what_they_say_is_true(tuned, log):
    file = models.load(
        RIGHT, {f"{table}.{key}": value for table, each in tuned.lines.items() for key, value in each.items()}
    )
    result = covariant.estimate(file, Record(*log[:3]))
    free, named = result.without_model, tuned.summary["without_model"]["filter"]
    assert isinstance(free, WithoutModel)
    assert free.filter == named
    assert f"by {named}," in covariant.compare(file, Record(*log[:3])).without_model
    true = np.asarray(log.x)[:, 2:]
    errors = ([np.mean((v - true)[free.judged] ** 2, axis=1)] for v in (result.velocity, free.velocity))
    truth = ErrorRatio.of(*errors)
    assert truth.is_better
    assert free.verdict.is_better
    low, high = tuned.tuning.same
    assert low <= tuned.tuning.natural_frequency <= high


def test_many_short_logs_are_tuned_as_one():
    """121 rows each, which begin at speed: alone each is too short."""
    each = [
        covariant.simulate(
            models.pendulum_chain(), duration=1.2, noise=1e-3, q0=[0.4 + 0.2 * k, 0.3], v0=[2.0, -1.0], rate=100.0
        )
        for k in range(4)
    ]
    records = [Record(*log.record[:3]) for log in each]
    result = covariant.tune(RIGHT, records, overrides={"measurement.std": 4e-3})
    assert result.tuning.rows == 4 * 55
    np.testing.assert_allclose(result.lines["measurement"]["std"], 1e-3, rtol=0.3)
    assert result.summary["held_out"]["after"]["relative"][1] < 0.05
    with pytest.raises(ValueError, match="too short to tune on"):
        covariant.tune(RIGHT, records[0])


def test_each_component_of_a_pose_has_its_own_noise():
    log = covariant.simulate("hovercraft", duration=8.0, noise=1e-3, rate=50.0, amplitude=[1.0, 0.5]).record
    result = covariant.tune(
        "hovercraft", Record(*log[:3]), overrides={"measurement.std": 1e-3, "uncertainty.acceleration": 0.3}
    )
    assert np.shape(result.lines["measurement"]["std"]) == (3,)
