"""What the functions refuse, each with one line that names the argument; `test_bad_input.py` has it of the commands."""

from pathlib import Path

import numpy as np
import pytest

import covariant
from covariant import logs, many, models, verbs
from covariant.signals import Record
from covariant.verbs import fit, simulate, smooth, tune
from scalargraph.errors import InputError

ARM = {"columns.q": ["shoulder", "elbow"], "parameters.mass": [1.0, 0.5], "parameters.length": [0.5, 0.4]}
T = np.arange(0, 3.0, 0.01)
SWING = Record(T, np.zeros((len(T), 1)), np.cos(T)[:, None])
TURNED = Record(T[:50], np.zeros((50, 3)), np.tile(np.eye(3), (50, 1, 1)))
BODY = models.ModelFile("body", models.free_body((1.0, 2.0, 3.0)), logs.Columns(quaternion_wxyz=("a", "b", "c", "d")))
NOISE = {"measurement.std": 1e-3, "uncertainty.acceleration": 0.2}
ROBOT, LOG = "double_pendulum", Path(__file__)
LATE = {"overrides": NOISE | {"measurement.delay": 0.05}}


def simulated(**arguments):
    return lambda: simulate("pendulum_chain", overrides=ARM, **arguments)


def smoothed(**arguments):
    return lambda: smooth("oscillator", SWING, **({"overrides": NOISE} | arguments))


REFUSED = [
    (simulated(amplitude=[1.0]), r"amplitude needs 2 finite numbers, for u1, u2; got 1"),
    (simulated(amplitude=[np.nan, 1.0]), "amplitude must be finite numbers; got nan, 1"),
    (simulated(quantum=[1e-3] * 3), "quantum needs one number, or 2 finite numbers, for shoulder, elbow"),
    (simulated(quantum=-1e-3), "quantum: bounds must not be negative"),
    (simulated(duration=0.0), "0.0 s at 500.0 Hz do not hold two samples"),
    (simulated(rate=-5.0), "rate must be positive .*-5"),
    (simulated(seed=-1), "seed must be a whole number ≥ 0; got -1"),
    (simulated(q0="up"), "q0: 'up' is not a list of numbers"),
    (simulated(push=[1.0]), "push needs 2 finite numbers"),
    (lambda: simulate("duffing", duration=1.0, push=[1.0]), "pushes are for mechanical ones"),
    (smoothed(observer="intrinsic"), "observer intrinsic cannot be smoothed; these can: intrinsic-kalman, ekf, ukf, "),
    (smoothed(observer="covariance-ekf"), "covariance-ekf does not fit oscillator"),
    (smoothed(lag=-1.0), "`lag` must be a time"),
    (smoothed(**LATE), "late .*shift the positions"),
    (smoothed(**LATE, observer="joint-kalman"), "late .*shift the positions"),
    (smoothed(lag=1e-9), "`lag=1e-09` is less than half a row of the log"),
    (smoothed(overrides={}), "measurement.std"),
    (lambda: fit(models.oscillator(), LOG, "mass"), "takes a model file, a name .* no finished Lagrangian"),
    (lambda: fit("pendulum_chain", [Path("absent.csv")], "mass"), r"absent\.csv"),
    (lambda: tune("oscillator", Path("absent.csv")), r"absent\.csv"),
    (lambda: tune("oscillator", []), "log: no log is given"),
    (lambda: tune("oscillator", ()), "log: no log is given"),
    (lambda: verbs.reproduce_paper("nobody"), r"unknown paper 'nobody'\. Known: aghannan-rouchon"),
    (
        lambda: many.over_logs("check", "oscillator", ["log.csv"], workers=2, scheduler="tcp://localhost:1"),
        "give scheduler or workers, not both",
    ),
    (
        lambda: fit("oscillator", [SWING, SWING], "stiffness", each="stiffness"),
        "each: a log in memory does not say of which machine it is",
    ),
    (
        lambda: fit("oscillator", {"a": SWING}, "stiffness", each="mass", overrides={"parameters.stiffness": 2.0}),
        r"each: unknown number 'mass'\. Known: stiffness",
    ),
    (
        lambda: many.over_logs("fit", "oscillator", [SWING], parameters="stiffness", each="stiffness"),
        "`each` is for logs that are fitted together",
    ),
    (
        lambda: fit("oscillator", [SWING, SWING], "stiffness", overrides=[{"inputs.lag": lag} for lag in (0.1, 0.2)]),
        r"overrides make inputs\.lag others than those of record",
    ),
    (
        lambda: fit(
            "oscillator", [SWING] * 2, "stiffness", overrides=[{"parameters.stiffness": k} for k in (1.0, 2.0)]
        ),
        r"overrides make \[parameters\] others than those of record",
    ),
    *(
        (lambda nothing=nothing: fit(ROBOT, LOG, nothing), "no number is named; name some of friction, armature")
        for nothing in ("", " , ", [])
    ),
    (
        lambda: fit(ROBOT, LOG, "friction,inputs.lag"),
        r"unknown group of numbers 'inputs'\. Known: friction, armature, payload",
    ),
    (lambda: models.load("oscillator", {"measurement.period": [0.1, 0.2]}), r"measurement\.period lists 2 numbers"),
    (lambda: covariant.check(BODY._replace(period=1.0), TURNED), r"measurement\.period is for coordinates"),
]


@pytest.mark.core(14)
@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_what_makes_no_sense_is_named(call, message):
    with pytest.raises((InputError, FileNotFoundError), match=message):
        call()


def test_an_estimate_that_left_the_finite_numbers_is_named_by_its_row():
    log = verbs.simulate("oscillator", duration=2.0, rate=100.0, q0=1.0, noise=1e-3).record
    u = np.array(log.u)
    u[100] = 1e200
    numbers = ("measurement.std=1e-3", "uncertainty.acceleration=1")
    with pytest.raises(ValueError, match="row 102: the estimate left the finite numbers; look at the inputs just"):
        verbs.estimate("oscillator", log._replace(u=u), overrides=numbers, anyway=True)
