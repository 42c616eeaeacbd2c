"""Inputs that act by a curve are named on several machines, also by a fit; logs without faults are not doubted."""

import itertools

import numpy as np
import pytest
from curve_logs import MACHINES, log_of

from covariant import fit, simulate
from covariant.calibration import diagnose
from covariant.calibration.diagnosis import misread_input

SIZES = {"pendulum": 1.5, "dry pendulum": 2.0, "two links": 4.0, "oscillator": 2.0, "robot": 2.0}
GUESSES = ("right", "rough")
KINDS = {
    "offset of an input": lambda size, u: u - 0.25 * size,
    "limit of an input": lambda size, u: np.clip(u, -0.4 * size, 0.4 * size),
    "dead band of an input": lambda size, u: u - np.clip(u, -0.15 * size, 0.15 * size),
}
DOUBTS = ("offset", "limit", "dead band", "sign", "lost counts", "zero of", "outliers")


@pytest.mark.parametrize(("name", "guesses"), list(itertools.product(MACHINES, GUESSES)))
@pytest.mark.parametrize("what", KINDS)
def test_a_curve_is_named_on_other_machines(what, name, guesses):
    file, record = log_of(name, 50, lambda u: KINDS[what](SIZES[name], u), guesses=guesses)
    found = [each for each in diagnose(file, record).findings if each.wrong]
    assert (found[0].what, found[0].where) == (what, file.columns.u[0]), found


@pytest.mark.parametrize(("name", "guesses"), list(itertools.product(MACHINES, (*GUESSES, "without friction"))))
def test_a_log_without_faults_has_no_curve(name, guesses):
    for seed, size in ((0, 1.0), (1, 0.5), (2, 2.0)):
        file, record = log_of(name, seed, size=size, guesses=guesses)
        wrong = [each for each in diagnose(file, record).findings if each.wrong]
        assert not [each for each in wrong if each.what.startswith(DOUBTS)], wrong
        assert guesses != "right" or not wrong
        assert misread_input(file, file, record) is None


FAULTS = {
    "reversed": (lambda u: u * [1, -1], "u2 seems to be logged with the other sign"),
    "offset": (lambda u: u + np.array([0.5, 0]), "u1 is logged with an offset of 0.5 "),
    "late": (lambda u: np.roll(u, -6, axis=0), "positions seem to follow u1, u2 by about 0.03 s later"),
}


# On the way the likelihood of a log that no friction explains may overflow.
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fit_of_a_robot_writes_no_number_of_a_log_that_is_misread(fault):
    change, words = FAULTS[fault]
    friction = {"parameters.friction": {"elbow": {"viscous": 0.03, "coulomb": 0.0}}}
    motion = {"duration": 8.0, "rate": 200.0, "amplitude": [2.2, 0.7], "frequency": 0.6}
    log = simulate("double_pendulum", **motion, noise=1e-4, seed=1, overrides=friction).record
    misread = log._replace(u=change(np.asarray(log.u)))
    held = {"inputs.between": "held"}
    result = fit("double_pendulum", [misread], "friction.elbow.viscous", overrides=held, anyway=True)
    assert not result.better
    assert words in result.details["suspicion"]
