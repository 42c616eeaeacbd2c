"""Velocity errors of a smoother, of its filter and of slopes, with a right and a wrong model: the table in
docs/smoothing.md.

    python benchmarks/smoothing.py
"""

import tempfile
from pathlib import Path

import numpy as np

import covariant

MODEL = """
system = "pendulum_chain"
[parameters]
mass = [1.0]
length = [0.5]
viscous = [0.05]
[columns]
t = "t"
q = ["q1"]
u = ["u1"]
[measurement]
std = 2e-3
[uncertainty]
acceleration = 0.5
"""
TICK = 2 * np.pi / 2**16
ENCODER = {"measurement.quantum": TICK}
TRUSTING = {"measurement.std": TICK / 12**0.5, "uncertainty.acceleration": 0.005}
WRONG = {"parameters.mass": [0.95], "parameters.viscous": [0.065]}
CASES = (
    ("100 Hz, noise of 2 mrad", {"rate": 100.0, "noise": 2e-3}, {}),
    ("100 Hz, no noise", {"rate": 100.0, "noise": 1e-7}, {}),
    ("500 Hz, encoder of 16 bits", {"rate": 500.0, "quantum": TICK}, ENCODER),
    ("the same, acceleration a hundredth", {"rate": 500.0, "quantum": TICK}, TRUSTING),
)


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        model, log = Path(folder) / "pendulum.toml", Path(folder) / "log.csv"
        model.write_text(MODEL)
        for name, sensor, overrides in CASES:
            simulated = covariant.simulate(model, duration=10.0, q0=[1.0], amplitude=[1.0], seed=1, **sensor)
            simulated.save(log)
            true = simulated.columns["true_v1"]
            for which, change in (("right", {}), ("wrong", WRONG)):
                result = covariant.smooth(model, log, overrides=overrides | change, score=True)
                slopes = result.smoothed.loaded.reference.v
                errors = (
                    np.sqrt(np.mean((v[50:-50, 0] - true[50:-50]) ** 2))
                    for v in (result.filtered.velocity, result.velocity, slopes)
                )
                print(
                    f"{name}, model {which}: filter, smoother, slopes",
                    *(f"{error:.2g}" for error in errors),
                    f"rad/s; the smoother says {np.median(result.velocity_std):.2g}, NIS {result.summary['nis']:.4g}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
