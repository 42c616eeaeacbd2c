"""How often `covariant check` calls a log wrong that is right: 100 simulated logs of two machines, no two alike.

Run `python benchmarks/false_alarms.py` from the repository's root. Each log has another start, other torques, noise or
ticks, jitter and missing cells; the model file says what they are.
"""

from collections import Counter

import jax.numpy as jnp
import numpy as np

from covariant.calibration import diagnose, misfit
from covariant.models import load
from covariant.signals import Record
from covariant.simulation import PositionSensor, hold, sense, simulate, stamps

FILES = ("examples/demo_double_pendulum.toml", "examples/dfki_simple_pendulum.toml")
RATE, SECONDS = 250.0, 6.0

if __name__ == "__main__":
    wrong: Counter = Counter()
    refused = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        std = 10 ** rng.uniform(-4.5, -3)
        sensor = PositionSensor(RATE, noise_std=std, dropout=0.02 * (seed % 3), jitter=2e-4 * (seed % 2))
        file = load(FILES[seed % 4 == 3], (f"measurement.std={std}", "inputs.lag=0"))
        n = file.dimension
        t = stamps(sensor, SECONDS, seed)
        sizes = np.array([0.4, 0.2]) if n == 2 else np.array([3.0])
        phases = rng.uniform(0, 2 * np.pi, (n, 3))
        u = sizes * np.mean([np.sin(w * t[:, None] + phases[:, k]) for k, w in enumerate((2.0, 5.0, 11.0))], axis=0)
        start = jnp.asarray(rng.uniform(-2, 2, 2 * n))
        made = simulate(file.model, start, jnp.asarray(t), hold(jnp.asarray(t), jnp.asarray(u)), rtol=1e-7, atol=1e-9)
        record = Record(t, u, sense(sensor, np.asarray(made.y), seed))
        found = [finding for finding in diagnose(file, record).findings if finding.wrong]
        wrong.update(finding.what for finding in found)
        refused += misfit(file, record) is not None
        for finding in found:
            print(f"seed {seed}: {finding.what} {finding.where}: {finding.evidence}", flush=True)
        if seed % 10 == 9:
            print(f"after {seed + 1}: wrong {dict(wrong)}, refused {refused}", flush=True)
