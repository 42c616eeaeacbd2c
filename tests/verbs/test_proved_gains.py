"""Gains of each coordinate and a bound of speeds, as `certify` finds them, in the other verbs."""

import re
import shutil

import numpy as np
import pytest

import covariant
from covariant import models
from covariant.calibration import tuned_estimators
from covariant.observers import run
from covariant.verbs.base.sheet import data_sheet

ARM = "pendulum_chain"
NAME = "measured-coefficients"
NOISE = {"measurement.std": 1e-4, "uncertainty.acceleration": 1.0}


@pytest.fixture(scope="module")
def proved():
    return covariant.certify(ARM, velocity=1.0, jerk=1.0)


@pytest.fixture(scope="module")
def log():
    return covariant.simulate(ARM, duration=0.4, q0=[0.1, -0.1], noise=1e-4).record


@pytest.fixture
def file(proved, tmp_path):
    """A model file with the numbers that the statement prints."""
    line = next(line for line in str(proved).splitlines() if line.startswith("observer: "))
    numbers = [f"{key} = {re.search(rf'{key} = (.*?])', line)[1]}" for key in ("alpha", "beta", "speed")]
    path = tmp_path / "arm.toml"
    path.write_text("\n".join([f'system = "{ARM}"', "[design]", f'observer = "{NAME}"', *numbers]))
    return path


def options(proved):
    document = proved.certificate.document
    return {"alpha": document.alpha.tolist(), "beta": document.beta.tolist(), "speed": document.velocity.tolist()}


def test_settings_that_are_printed_are_the_observer_that_is_proved(proved, log, file):
    expected = run(proved.certificate.observer, log).estimate
    for estimates in (covariant.estimate(file, log), covariant.estimate(ARM, log, **options(proved))):
        assert estimates.observer_name == NAME
        np.testing.assert_allclose(estimates.run.estimate, expected, rtol=0, atol=1e-12)


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
def test_they_are_so_in_c(proved, log, file):
    expected = run(proved.certificate.observer, log).estimate
    np.testing.assert_allclose(covariant.estimate(file, log, engine="c").run.estimate, expected, rtol=0, atol=1e-12)


def test_the_comparison_tunes_them_so(proved, file):
    loaded = models.load(file, NOISE)
    tuned = tuned_estimators(loaded.model, 2, data_sheet(loaded), 1000.0, names=(NAME,))[NAME]
    for name, number in options(proved).items():
        np.testing.assert_array_equal(getattr(tuned, name), number)


def test_the_export_has_them(proved, file, tmp_path):
    for name, given in (("a", file), ("b", ARM)):
        settings = {} if given == file else options(proved)
        made = covariant.export(given, tmp_path / name, rate=1000.0, **settings)
        for key, number in options(proved).items():
            np.testing.assert_array_equal(made.program.numbers[key], number)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"alpha": [20.0, 30.0], "beta": 200.0, "observer": "intrinsic"}, f"they do to {NAME}"),
        ({"alpha": 20.0, "beta": 200.0, "speed": 1.0, "observer": "geodesic"}, f"they do to {NAME}"),
        ({"alpha": [20.0, 30.0, 40.0], "beta": 200.0}, "2 finite numbers"),
        ({"alpha": [20.0, -30.0], "beta": 200.0}, "positive numbers"),
        ({"speed": 1.0}, "`speed` with them"),
        ({"overrides": {"design.alpha": 20.0}, "observer": NAME}, "belong together"),
    ],
)
def test_gains_that_do_not_fit_are_refused(log, given, message):
    with pytest.raises(ValueError, match=message):
        covariant.estimate(ARM, log, **given)
