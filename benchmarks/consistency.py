"""From what size of error on the intrinsic Kalman filter is no longer as accurate as it says: NEES and NIS by size.

A thousand runs for each size, the truth drawn as the filter believes it is, as in the tests. Run
`python benchmarks/consistency.py` from the repository's root. With `--bands` it prints instead how often the 95 % band
of velocities holds the truth, on logs of a double pendulum of which the model does not know something.
"""

import sys

import numpy as np

import covariant

sys.path.append("tests/observers")

from test_consistency import MODELS, RUNS, STEPS, Sizes, bound, consistency

NOISES = [(0.01, 1.0), (0.03, 1.0), (0.1, 1.0), (0.2, 1.0), (0.3, 1.0), (0.5, 1.0)]
SPEEDS = [(0.01, 3.0), (0.01, 10.0), (0.01, 20.0)]


NOISE = 2e-4
MACHINE = {"mass": [1.0, 0.7], "length": [0.5, 0.4], "com": [0.25, 0.2], "inertia": [0.02, 0.01]}
FRICTION = {"viscous": [0.1, 0.05], "coulomb": [0.1, 0.05]}
PUSHED, SMALL = [0.6, 0.3], [0.02, 0.01]
UNKNOWN = {
    "nothing": ({}, None, [0.2, 0.1]),
    "pushes of three times the size in the file": ({}, PUSHED, [0.2, 0.1]),
    "masses 5 % off, and these pushes": ({"mass": [1.05, 0.665]}, PUSHED, [0.2, 0.1]),
    "friction": (FRICTION, None, [0.2, 0.1]),
    "friction, forces in the file ten times smaller": (FRICTION, None, SMALL),
    "the same, and masses 10 % off": (FRICTION | {"mass": [1.1, 0.63]}, None, SMALL),
}
"""Parameters of the machine that differ, the largest push [N m], and the usual size of forces in the file [N m]."""


def band(parameters: dict, push: list[float] | None, size: list[float], seed: int) -> np.ndarray:
    """Part of the true velocities of each joint in its band: (2, 2), in all rows and in its fastest tenth."""

    def overrides(values: dict) -> dict:
        return {f"parameters.{name}": value for name, value in values.items()}

    log = covariant.simulate(
        "pendulum_chain",
        duration=20.0,
        rate=200.0,
        amplitude=[3.0, 0.8],
        frequency=0.5 + 0.1 * seed,
        noise=NOISE,
        seed=seed,
        push=push,
        overrides=overrides(MACHINE | parameters),
    ).record
    noise = {
        "measurement.std": NOISE,
        "uncertainty.acceleration": 0.3,
        "uncertainty.external_force_std": size,
        "uncertainty.external_force_time": 0.3,
    }
    result = covariant.estimate(
        "pendulum_chain", log, observer="intrinsic-kalman", overrides=overrides(MACHINE) | noise
    )
    true = log.x[200:, 2:]
    inside = np.abs(result.velocity[200:] - true) < 1.96 * result.velocity_std[200:]
    fast = np.abs(true) >= np.quantile(np.abs(true), 0.9, axis=0)
    return np.stack([inside.mean(axis=0), np.mean(inside, axis=0, where=fast)])


def print_bands() -> None:
    """Print the table of bands, means over three logs each, losses first."""
    rows = {name: np.mean([band(*case, seed) for seed in range(3)], axis=0) for name, case in UNKNOWN.items()}
    print("| what the model does not know | all rows | fastest tenth |\n|---|--:|--:|")
    for name, (everywhere, fast) in sorted(rows.items(), key=lambda row: row[1].min()):
        print(f"| {name} | {everywhere[0]:.2f}, {everywhere[1]:.2f} | {fast[0]:.2f}, {fast[1]:.2f} |")


def main() -> None:
    """Print NEES and NIS by size."""
    print("| machine | noise | first velocity | NEES | NIS |\n|---|--:|--:|--:|--:|")
    for name, (model, q0) in MODELS.items():
        n = model.manifold.zero(q0).shape[0]
        for measurement, speed in (*NOISES, *SPEEDS):
            nees, nis = consistency(name, Sizes(measurement=measurement, speed=speed))
            late = nis[:, STEPS // 2 :]
            # Of runs that end so far off that no geodesic leads to the truth there is no error.
            marks = [
                f"{values.mean():.3f}{'' if abs(values.mean() - 1) < bound(count) else ' *'}"
                for values, count in ((nees, 2 * n * RUNS), (late, n * late.size))
            ]
            print(f"| {name} | {measurement} | {speed} | {' | '.join(marks)} |", flush=True)
    print("A star: outside the bounds that 95 of 100 consistent filters keep.")


if __name__ == "__main__":
    print_bands() if "--bands" in sys.argv else main()
