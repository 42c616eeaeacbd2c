"""Errors of external forces by filters and their rivals, with right and wrong models: the table in docs/forces.md.

python benchmarks/forces.py
"""

import numpy as np

import covariant
from covariant import workflow

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


def main() -> None:
    """Print the table."""
    for name, machine, sensor, model in CASES:
        motion = {"duration": 30.0, "rate": 200.0, "q0": [1.0, 0.5], "amplitude": [1.0, 0.5], "push": [0.6, 0.3]}
        log = covariant.simulate("pendulum_chain", seed=1, overrides=MODEL | machine, **(motion | sensor))
        result = workflow.compare_force("pendulum_chain", log.to_pandas(), log.force_columns, overrides=MODEL | model)
        print(name, result, sep="\n", flush=True)


if __name__ == "__main__":
    main()
