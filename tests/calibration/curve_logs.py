"""Simulated logs of machines whose inputs act by a curve, or whose positions are read wrongly for some of the time."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from logs_with_faults import _moved

from covariant.models import ModelFile, load
from covariant.signals import Record

PERIOD = 0.004
MACHINES: dict[str, tuple[str, dict[str, Any], tuple[float, ...], float]] = {
    "pendulum": (
        "pendulum_chain",
        {"mass": [1.0], "length": [0.5], "com": [0.25], "inertia": [0.02], "viscous": [0.05]},
        (1.5,),
        1.0,
    ),
    "dry pendulum": (
        "pendulum_chain",
        {"mass": [0.6], "length": [0.4], "com": [0.3], "inertia": [0.01], "viscous": [0.02], "coulomb": [0.05]},
        (2.0,),
        1.0,
    ),
    "two links": (
        "pendulum_chain",
        {
            "mass": [1.0, 0.6],
            "length": [0.4, 0.3],
            "com": [0.2, 0.15],
            "inertia": [0.02, 0.01],
            "viscous": [0.05, 0.03],
        },
        (4.0, 1.5),
        0.7,
    ),
    "oscillator": ("oscillator", {"stiffness": 2.0}, (2.0,), 1.0),
    "robot": ("double_pendulum", {}, (2.0, 0.7), 0.7),
}
"""Model, parameters, sizes of the inputs, and how far from zero the motion starts."""


def log_of(
    name: str,
    seed: int,
    curve: Callable[[np.ndarray], np.ndarray] = lambda u: u,
    joint: int = 0,
    size: float = 1.0,
    guesses: str = "right",
) -> tuple[ModelFile, Record]:
    """A model file and the log of a machine, of which one input acts by a curve.

    Args:
        name: Key of `MACHINES`.
        seed: Seed of start, inputs, noise and guesses.
        curve: The input that acts, where one is logged.
        joint: Index of this input.
        size: Size of the inputs, in those of the machine.
        guesses: Whether the numbers of the model file are "right", "rough" by up to 20 %, or those "without friction".
    """
    spec, parameters, push, start = MACHINES[name]
    random = np.random.default_rng([seed, *map(ord, name)])
    std = 10 ** random.uniform(-4.3, -3.0)
    sheet = {"measurement.std": std, "uncertainty.acceleration": 0.5}
    true = load(spec, {f"parameters.{key}": value for key, value in parameters.items()} | sheet)
    n, m = true.dimension, len(push)
    t = PERIOD * np.arange(int(random.integers(1500, 2500)))
    speeds, phases = random.uniform(1.0, 12.0, (4, m)), random.uniform(0, 6.28, (4, m))
    u = np.array(push) * size * np.mean(np.sin(speeds * t[:, None, None] + phases), axis=1) * 1.2
    acting = u.copy()
    acting[:, joint] = curve(u[:, joint])
    begin = random.uniform(-start, start, 2 * n)
    motion = _moved(true.model, *map(jnp.asarray, (t, acting, np.zeros_like(acting[1:]), begin)))
    y = np.asarray(motion)[:, :n] + random.normal(0, std, (len(t), n))
    stated = {
        f"parameters.{key}": (np.asarray(value) * random.uniform(0.8, 1.2, np.shape(value))).tolist()
        if guesses != "right"
        else value
        for key, value in parameters.items()
        if guesses != "without friction" or key not in ("viscous", "coulomb")
    }
    return load(spec, stated | sheet), Record(t, u, y)
