"""Fits to recorded logs, from first values as a drawing gives them: observers are as good as with published numbers."""

from pathlib import Path

import numpy as np
import pytest

from covariant import models
from covariant.calibration import fit, observer_gains
from covariant.observers import Intrinsic
from covariant.verbs.base.inputs import Job, data_sheet, load
from covariant.verbs.base.outcome import drive

EXAMPLES = Path(__file__).parents[2] / "examples"

pytestmark = pytest.mark.data

CASES = {
    "simple pendulum, fitted on ddp, judged on dircol": (
        ("dfki_simple_pendulum.toml", "dfki_simple_pendulum/ddp.csv", "dfki_simple_pendulum/dircol.csv"),
        {"mass": [0.6], "inertia": [0.25], "coulomb": [0.05], "offset": [0.0]},
        ("mass", "inertia", "coulomb", "offset", "inputs.lag"),
        (1, None, None),
    ),
    "free double pendulum, fitted on its first 10 s": (
        ("multiarm_double.toml", "multiarm_pendulum/double.csv", "multiarm_pendulum/double.csv"),
        {"mass": [0.08, 0.15], "inertia": [0.0006, 0.0015], "viscous": [3e-4, 3e-5]},
        ("mass", "com", "inertia", "viscous"),
        (5, 10.0, 25.0),
    ),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("case", CASES)
def test_an_observer_with_fitted_numbers_is_within_5_percent_of_the_published_ones(case, data_folder):
    (name, log, judged), guess, names, (every, fitted_until, judged_until) = CASES[case]
    spec, first = str(EXAMPLES / name), tuple(f"parameters.{key}={value}" for key, value in guess.items())
    columns = dict.fromkeys(("t", "q", "u", "v", "truth"))
    family = models.family(spec, names, first)
    seen = load(Job(spec, data_folder / log, first, every, fitted_until, columns, True))
    record = seen.log.record
    found = fit(family, [record], [seen.reference.v])

    def error(overrides):
        loaded = load(Job(spec, data_folder / judged, tuple(overrides), every, judged_until, columns, True))
        later = np.asarray(loaded.record.t) > (fitted_until or 0.0)
        loaded = loaded._replace(reference=loaded.reference._replace(scored=loaded.reference.scored & later))
        gains = observer_gains(data_sheet(loaded.file), loaded.rate)
        return drive(Intrinsic(loaded.model, gains.alpha, gains.beta), loaded).score.rmse

    content = family.with_values(found.values)
    fitted = [f"parameters.{key}={content['parameters'][key]}" for key in ("mass", "com", "inertia", *guess)]
    fitted += [f"inputs.lag={content['inputs']['lag']}"] if "inputs" in content else []
    published = error(())
    assert np.all(error(first) > 1.5 * published)
    np.testing.assert_array_less(error(fitted), 1.05 * published)
    if "simple" in case:
        assert found.determined[:4].all()
    else:
        assert not found.determined[0], "nothing drives it: the masses are told only relative to each other"
        scaled = np.array([1, 1, 0, 0, 1, 1, 1, 1.0])
        left = scaled - found.undetermined.T @ np.linalg.lstsq(found.undetermined.T, scaled, rcond=None)[0]
        assert np.linalg.norm(left) < 0.05 * np.linalg.norm(scaled), "all masses, inertias and frictions together"
