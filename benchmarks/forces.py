"""Errors of external forces by the filter and by a momentum observer, with right and wrong models: docs/forces.md.

python benchmarks/forces.py
"""

import itertools

import numpy as np
from scipy.signal import lfilter

import covariant
from covariant import models, observers

RATE = 200.0
MODEL = {
    "parameters.mass": [1.0, 0.7],
    "parameters.length": [0.5, 0.4],
    "parameters.viscous": [0.05, 0.02],
    "parameters.coulomb": [0.0, 0.0],
    "measurement.std": 2e-4,
    "uncertainty.acceleration": 0.1,
    "uncertainty.external_force_std": [0.2, 0.1],
    "uncertainty.external_force_time": 0.3,
}
FRICTION = {"parameters.coulomb": [0.03, 0.03], "uncertainty.parameters": {"coulomb": 1.0}}
TICK = 2 * np.pi / 2**16
CASES = (
    ("right model, noise of .2 mrad", {}, {"noise": 2e-4}, {}),
    ("masses 5 % too small", {}, {"noise": 2e-4}, {"parameters.mass": [0.95, 0.665]}),
    ("unknown friction of .1 and .05 N m", {"parameters.coulomb": [0.1, 0.05]}, {"noise": 2e-4}, {}),
    ("the same, estimated along with the motion", {"parameters.coulomb": [0.1, 0.05]}, {"noise": 2e-4}, FRICTION),
    ("right model, encoders of 16 bits", {}, {"quantum": TICK}, {"measurement.std": TICK / 12**0.5}),
)
USUAL_GAIN = 25.0
GAINS, BANDWIDTHS = np.geomspace(1.0, 300.0, 12), np.geomspace(10.0, 1000.0, 9)
HIGH_PASSES = (np.inf, 10.0, 3.0, 1.0, 0.3)
SETTLED = slice(int(RATE), None)


def momentum(model, record, q, v) -> dict:
    """Forces by momentum observers of all `GAINS` and of the usual one."""
    return {
        gain: np.asarray(observers.observed_forces(observers.MomentumObserver(model, gain), *record[:2], q, v))
        for gain in (USUAL_GAIN, *GAINS)
    }


def tuned(model, record, true) -> np.ndarray:
    """The momentum observer whose bandwidth, gain, high-pass and scale are best for the true forces: an oracle."""
    weight, best, least = 1 / np.std(true, axis=0), true, np.inf
    for bandwidth in BANDWIDTHS:
        derivative = observers.FilteredDerivative(bandwidth, circles=(0, 1))
        q, v = np.split(np.asarray(observers.run(derivative, record, ()).estimate), 2, axis=1)
        for force, time in itertools.product(momentum(model, record, q, v).values(), HIGH_PASSES):
            share = -np.expm1(-1 / (RATE * time))
            passed = force - (0 if time == np.inf else lfilter([share], [1, share - 1], force, axis=0))
            seen, wanted = ((each * weight)[SETTLED] for each in (passed, true))
            scale = max(np.sum(seen * wanted) / np.sum(seen**2), 0.0)
            error = np.mean((scale * seen - wanted) ** 2)
            best, least = (scale * passed, error) if error < least else (best, least)
    return best


def columns(table, name) -> np.ndarray:
    """Both entries (T, 2) of what an estimate or a log holds."""
    return np.stack([table[name.format(k)] for k in (1, 2)], axis=1)


def main() -> None:
    """Print root mean square errors [N m] of both joints, and how often the truth is in the 95 % band of the filter."""
    for name, machine, sensor, changes in CASES:
        motion = {"duration": 30.0, "rate": RATE, "q0": [1.0, 0.5], "amplitude": [1.0, 0.5], "push": [0.6, 0.3]}
        log = covariant.simulate("pendulum_chain", seed=1, overrides=MODEL | machine, **(motion | sensor))
        record, true, numbers = log.record, columns(log.columns, "true_external_force{}"), MODEL | changes
        kalman, derivative = (
            covariant.estimate("pendulum_chain", record, observer=observer, overrides=numbers).columns
            for observer in ("intrinsic-kalman", "filtered-derivative")
        )
        model = models.load("pendulum_chain", numbers).model
        filtered, velocity = columns(kalman, "external_force{}"), columns(derivative, "v{}")
        estimates = {
            "none": 0 * true,
            "intrinsic-kalman": filtered,
            "momentum, usual": momentum(model, record, record.y, velocity)[USUAL_GAIN],
            "momentum, tuned to the truth": tuned(model, record, true),
        }
        within = np.abs(filtered - true) <= 1.96 * columns(kalman, "external_force{}_std")
        print(f"{name}: {np.mean(within[SETTLED]):.2f} in the band of the filter")
        for kind, force in estimates.items():
            print(f"  {kind:30}", np.sqrt(np.mean((force - true)[SETTLED] ** 2, axis=0)).round(3), flush=True)


if __name__ == "__main__":
    main()
