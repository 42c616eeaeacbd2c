"""From what size of error on the intrinsic Kalman filter is no longer as accurate as it says: NEES and NIS by size.

A thousand runs for each size, the truth drawn as the filter believes it is, as in the tests. Run
`python benchmarks/consistency.py` from the repository's root.
"""

import sys

sys.path.append("tests/observers")

from test_consistency import MODELS, RUNS, STEPS, Sizes, bound, consistency

NOISES = [(0.01, 1.0), (0.03, 1.0), (0.1, 1.0), (0.2, 1.0), (0.3, 1.0), (0.5, 1.0)]
SPEEDS = [(0.01, 3.0), (0.01, 10.0), (0.01, 20.0)]

if __name__ == "__main__":
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
