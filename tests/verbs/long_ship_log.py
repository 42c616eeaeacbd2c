"""From a ship's log to its velocities, in water at rest and in a current: checks, numbers, velocities and bands."""

import runpy
from pathlib import Path

import numpy as np
import pandas
import pytest

import covariant
from covariant import models, verbs

pytestmark = pytest.mark.long
workboat = runpy.run_path(str(Path(__file__).parents[2] / "gallery" / "workboat.py"))
HULLS, NAMES, sail = workboat["HULLS"], workboat["NAMES"], workboat["sail"]
NOISE = {
    "measurement.std": [0.01, 0.01, 0.00524],
    "uncertainty.external_force_time": 0.5,
    "uncertainty.acceleration": 1e-5,
    "uncertainty.correlation_time": 0.1,
    "uncertainty.parameters_drift": 1e-4,
}
"""What tells the velocities of a boat apart from wind and waves; gusts are forces that last half a second."""


def frame(*given, **more):
    table, truth = sail(*given, **more)
    return pandas.DataFrame(table, columns=NAMES), truth


@pytest.fixture
def drafted(tmp_path):
    """A function that drafts the model file of a hull from a log, with its true numbers."""

    def save(hull, log):
        path = verbs.init(log).save(tmp_path / "boat.toml", overwrite=True)
        numbers = {f"parameters.{name}": value for name, value in HULLS[hull]._asdict().items()}
        forces = (workboat["GUST"] * np.array(HULLS[hull].mass)).tolist()
        return path, numbers | NOISE | {"uncertainty.external_force_std": forces}

    return save


def without_a_model(table, truth, late):
    """The least errors (3,) of causal slopes of parabolas over several windows, turned by the measured heading."""
    heading, best = np.unwrap(np.radians(table[:, 3])), np.full(3, np.inf)
    c, s = np.cos(heading), np.sin(heading)
    for rows in (4, 6, 9, 13, 19, 28):
        ages = np.arange(rows) / 5.0
        slope = np.linalg.pinv(np.stack([np.ones(rows), -ages, ages**2], axis=1))[1]
        north, east, turn = (np.convolve(each, slope)[: len(table)] for each in (table[:, 1], table[:, 2], heading))
        off = np.stack([c * north + s * east, c * east - s * north, turn], axis=1) - truth
        best = np.minimum(best, np.sqrt(np.mean(off[late] ** 2, axis=0)))
    return best


@pytest.mark.parametrize("hull", HULLS)
@pytest.mark.parametrize("current", [0.0, 0.5])
def test_a_right_log_has_no_finding_before_the_fit(hull, current, drafted):
    log, _ = frame(HULLS[hull], seed=100, current=current, turns=0.1)
    path, _ = drafted(hull, log)
    mass = np.round(np.array(HULLS[hull].mass) * [1.03, 0.97, 1.0]).tolist()
    result = covariant.check(str(path), log, overrides={"parameters.mass": mass})
    assert str(result).startswith("OK: nothing wrong (0 notes"), str(result)


@pytest.mark.parametrize("circle", [False, True])
def test_velocities_in_a_current_are_as_good_and_as_certain_as_they_say(circle, drafted):
    offs, stds, free = [], [], []
    for seed in (20, 21, 22):
        log, truth = frame(HULLS["workboat"], seed=seed, current=0.5, turns=0.0, circle=circle)
        path, numbers = drafted("workboat", log)
        result = covariant.estimate(str(path), log, observer="intrinsic-kalman", overrides=numbers)
        late = result.t > 20.0
        offs.append((result.velocity - truth)[late])
        stds.append(result.velocity_std[late])
        free.append(without_a_model(log.to_numpy(), truth, late))
    inside = np.mean(np.abs(np.concatenate(offs)) <= 1.96 * np.concatenate(stds))
    assert 0.93 < inside < 0.975
    if not circle:  # a steady circle is easy for a parabola
        assert (np.sqrt(np.mean(np.concatenate(offs) ** 2, axis=0)) < np.mean(free, axis=0) / 9).all()


def test_a_current_is_fitted_with_the_numbers_of_the_ship_and_not_written(drafted, tmp_path):
    log, _ = frame(HULLS["workboat"], seed=4, current=0.5, turns=0.0, seconds=90.0)
    path, numbers = drafted("workboat", log)
    start = {key: value for key, value in numbers.items() if key.startswith("parameters.")}
    start |= {"parameters.rudder": 100.0, "inputs.between": "held", "uncertainty.parameters_drift": 1e-4}
    result = covariant.fit(str(path), log, "rudder", overrides=start)
    values = dict(
        zip(result.columns["parameter"], zip(result.values, result.standard_errors, strict=True), strict=True)
    )
    for name, true in (("rudder", 110.0), ("current[0]", 0.5), ("current[1]", 0.0)):
        value, std = values[name]
        assert abs(value - true) < 3 * std, name
    assert values["current[0]"][1] < 0.02
    fitted = models.load(str(result.save(tmp_path / "fitted.toml")))
    assert np.asarray(fitted.model.parameters["current"].value).tolist() == [0.0, 0.0]
