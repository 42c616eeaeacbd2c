"""How often the sentence of `estimate`, on whether the model helps, is right: on simulated logs, against the truth.

Each log is of a pendulum with one or two links, whose model file has other masses, lacks friction, or states another
noise; readings are noisy or ticks. Run `python benchmarks/judging.py 200` from the repository's root.
"""

import sys
from typing import NamedTuple

import numpy as np

import covariant
from covariant import models
from covariant.signals import Record
from covariant.verbs.base.without_model import WithoutModel

CLEAR = 1.1
"""Ratio of true errors from which a sentence has to be right."""


class Case(NamedTuple):
    """The true ratio of the errors with and without the model on the judged rows, and what the sentence said of it."""

    seed: int
    truth: float
    free: WithoutModel

    @property
    def right(self) -> bool:
        """Whether the sentence names the better one."""
        return self.free.verdict.is_better if self.truth < 1 else self.free.verdict.is_worse

    @property
    def wrong(self) -> bool:
        """Whether it names the worse one."""
        return self.free.verdict.is_worse if self.truth < 1 else self.free.verdict.is_better


def case(seed: int) -> Case:
    """Simulate a log and estimate its velocities by a file that is wrong in something."""
    random = np.random.default_rng(seed)
    links = int(random.integers(1, 3))
    mass, length = random.uniform(0.3, 1.0, links), random.uniform(0.2, 0.5, links)
    true = {"mass": mass, "length": length, "viscous": random.choice([0.0, 0.02], links)}
    rate, std = float(random.choice([50.0, 100.0, 200.0, 400.0])), float(10 ** random.uniform(-4, -2.5))
    sensor = {"noise": std} if random.random() < 0.6 else {"quantum": std * np.sqrt(12)}
    log = covariant.simulate(
        models.pendulum_chain(**true),
        duration=float(random.uniform(3.0, 10.0)),
        rate=rate,
        q0=random.uniform(-1.2, 1.2, links).tolist(),
        amplitude=(random.uniform(0.0, 0.4, links) * mass * length * 9.81).tolist(),
        frequency=float(random.uniform(0.3, 1.5)),
        seed=seed,
        **sensor,
    ).record
    stated = mass * np.exp(random.normal(0, random.choice([0.0, 0.1, 0.4]), links))
    file = models.ModelFile(
        "pendulum",
        models.pendulum_chain(mass=stated, length=length),
        measurement_std=std * float(np.exp(random.normal(0, 0.3))),
        acceleration_std=float(10 ** random.uniform(-1, 1.3)),
        correlation_time=0.02,
    )
    result = covariant.estimate(file, Record(log.t, log.u, log.y), anyway=True, progress=lambda *_: None)
    free, v = result.without_model, np.asarray(log.x)[:, links:]
    assert isinstance(free, WithoutModel), free
    rows = free.judged
    size = np.sqrt(np.mean(v[rows] ** 2, axis=0))
    own, other = (np.sqrt(np.mean(((each - v)[rows] / size) ** 2)) for each in (result.velocity, free.velocity))
    return Case(seed, float(own / other), free)


def main() -> None:
    """Print the logs on which the sentence is not right, and how often it is."""
    clear = []
    for seed in range(int(sys.argv[1]) if len(sys.argv) > 1 else 200):
        one = case(seed)
        if max(one.truth, 1 / one.truth) < CLEAR:
            continue
        clear.append(one)
        if not one.right:
            print(f"seed {seed}: truth {one.truth:.3g}; {one.free.sentence('intrinsic')}")
    right, wrong = (np.array([getattr(each, name) for each in clear]) for name in ("right", "wrong"))
    print(
        f"{len(clear)} logs with a true ratio outside {1 / CLEAR:.2g} to {CLEAR:g}: right {100 * right.mean():.3g} %, "
        f"wrong {100 * wrong.mean():.3g} %, cannot tell {100 * (1 - right.mean() - wrong.mean()):.3g} %"
    )


if __name__ == "__main__":
    main()
