"""An estimate says what the best filter without a model would have left, and warns where that is less."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import covariant
from covariant import logs, models, observers
from covariant.calibration.tuning._filters import even_velocity
from covariant.geometry.lie import SO3
from covariant.signals import Record
from covariant.simulation import simulate
from covariant.verbs.base.without_model import WithoutModel, without_model

NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.3}


@pytest.fixture(scope="module")
def log():
    made = covariant.simulate("pendulum_chain", duration=8.0, noise=1e-3, q0=[0.8, 0.5], rate=100.0).record
    return Record(made.t, made.u, made.y)  # without true velocities


def test_a_right_model_helps_and_the_estimate_says_so(log):
    result = covariant.estimate("pendulum_chain", log, overrides=NOISE)
    found = result.without_model
    assert isinstance(found, WithoutModel)
    assert found.verdict.is_better
    assert found.sentence("intrinsic") in str(result)
    assert "the model helps" in str(result)
    assert not any("without a model" in warning for warning in result.warnings)
    assert result.summary["without_model"]["filter"] == found.filter


def test_a_wrong_model_is_worse_than_none_and_a_warning_says_so(log):
    wrong = NOISE | {"parameters.mass": [1.0, 2.0]}
    result = covariant.estimate("pendulum_chain", log, overrides=wrong, anyway=True)
    found = result.without_model
    assert isinstance(found, WithoutModel)
    assert found.verdict.low > 2
    (warning,) = (each for each in result.warnings if "without a model" in each)
    assert f"estimate with the observer {found.filter}" in warning
    assert str(result).count("without a model") == 1


@pytest.mark.exhaustive
def test_the_filter_itself_cannot_be_told_from_the_filter(log):
    loaded = covariant.estimate("pendulum_chain", log, overrides=NOISE).loaded
    first = without_model(loaded, np.zeros((len(log.t), 2)))
    assert isinstance(first, WithoutModel)
    again = without_model(loaded, first.velocity)
    assert isinstance(again, WithoutModel)
    assert again.verdict.error == again.verdict.other
    assert "cannot tell" in again.ruling


@pytest.mark.parametrize("observer", [observers.SavitzkyGolay(9, 2), observers.PLL(30.0)], ids=["window", "recursive"])
def test_a_filter_by_its_weights_is_the_observer_that_runs(observer, log):
    y = np.asarray(log.y)
    run = observers.run(observer, log)
    t = np.asarray(log.t)
    even, by_weights = even_velocity(observer.weights(100.0), 100.0, t, y)
    settled = even > 3.0
    np.testing.assert_allclose(by_weights[settled], np.asarray(run.estimate)[: len(even)][settled, 2:], atol=1e-6)


def missing(rows: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.where(np.isin(np.arange(len(y)), rows)[:, None], np.nan, y)


LOGS = {
    "short": lambda y: (slice(0, 121), y),
    "shorter": lambda y: (slice(0, 60), y),
    "single missing rows": lambda y: (slice(0, 400), missing(np.arange(3, 800, 7), y)),
    "one column at a time": lambda y: (slice(0, 400), np.where(np.arange(2) == np.arange(801)[:, None] % 2, y, np.nan)),
    "holes everywhere": lambda y: (slice(0, 600), missing(np.flatnonzero(np.arange(801) % 40 > 32), y)),
    "outliers": lambda y: (slice(0, 600), y + 0.3 * (np.arange(801) % 50 == 20)[:, None]),
}


@pytest.mark.parametrize("name", LOGS)
def test_every_log_has_a_sentence_that_is_true(name, log):
    rows, y = LOGS[name](np.asarray(log.y))
    y = np.concatenate([np.asarray(log.y)[:1], y[1:]])  # a log begins with a whole measurement
    cut = Record(*(np.asarray(each)[rows] for each in (log.t, log.u, y)))
    for mass, better in (((1.0, 1.0), True), ((1.0, 3.0), False)):
        overrides = NOISE | {"parameters.mass": list(mass)}
        found = covariant.estimate("pendulum_chain", cut, overrides=overrides, anyway=True).without_model
        assert isinstance(found, WithoutModel)
        assert found.verdict.is_better if better else not found.verdict.is_better
        if rows.stop >= 400:
            assert found.verdict.is_worse != better


def test_a_line_says_why_nothing_can_be_judged(log):
    short = covariant.estimate("pendulum_chain", log, overrides=NOISE, until=0.2)
    free = covariant.estimate("pendulum_chain", log, overrides=NOISE, observer="savitzky-golay")
    quiet = covariant.estimate("pendulum_chain", log, alpha=10.0, beta=50.0)
    assert "too few to judge" in str(short)
    assert free.without_model == ""
    assert "tells no noise" in str(quiet)


@pytest.mark.parametrize(("moments", "better"), [((4e-3, 7e-3, 1e-2), True), ((4e-3, 2e-2, 1e-2), False)])
def test_attitudes_have_a_sentence_too(moments, better):
    """A body that tumbles in the air; the model has its moments of inertia, or wrong ones."""
    t, random = np.arange(0, 6, 0.01), np.random.default_rng(0)
    start = models.Motion(SO3.exp(jnp.asarray(random.normal(size=3))), jnp.array([0.5, 9.0, 0.3]))
    true = simulate(models.free_body((4e-3, 7e-3, 1e-2)), start, jnp.asarray(t))
    noise = jax.vmap(SO3.exp)(jnp.asarray(random.normal(0, 2e-3, (len(t), 3))))
    columns = logs.Columns(quaternion_wxyz=("qw", "qx", "qy", "qz"))
    file = models.ModelFile("racquet", models.free_body(moments), columns, measurement_std=2e-3, acceleration_std=1.0)
    result = covariant.estimate(file, Record(t, np.zeros((len(t), 3)), np.asarray(true.y @ noise)), anyway=True)
    found, v = result.without_model, np.asarray(true.x.v)
    assert isinstance(found, WithoutModel)
    assert found.filter == "tracking-loop"
    own, free = (np.mean((each - v)[found.judged] ** 2) for each in (result.velocity, found.velocity))
    assert (own < free) == better
    assert found.verdict.is_better if better else found.verdict.is_worse
