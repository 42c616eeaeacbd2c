"""Random friction on a line: no proof is contradicted by a simulation, and most of what is harmless is proved.

Groups and circles have their tables in `test_place.py` and `test_injectivity.py`, other units theirs in
`test_units.py`, noise in `test_noise.py`. `COVARIANT_ATTACKS=500` draws as many laws of each kind, instead of a dozen.
"""

import math
import os
from collections.abc import Callable

import numpy as np
import pytest
from systems import ALPHA, Case, around, excess, line, simulate, verdict

COUNT = int(os.environ.get("COVARIANT_ATTACKS", "12"))
BRAKING: list[Callable] = [
    lambda xp, r: xp.clip(r, -1.0, 1.0),
    lambda xp, r: xp.maximum(r, 0.0),
    lambda xp, r: xp.arctan(r),
]
"""What brakes where it is subtracted."""
KINDS: dict[str, list[Callable]] = {
    "jump": [
        lambda xp, r: xp.where(r > 0, 1.0, 0.0),
        lambda xp, r: xp.sign(r),
        lambda xp, r: xp.floor(r),
        lambda xp, r: xp.arctan2(r, 0 * r - 1.0) / 2,
    ],
    "kink": [
        lambda xp, r: xp.abs(r),
        lambda xp, r: xp.where(r > 0, r, 0.0),
        lambda xp, r: xp.maximum(0.0, 1 - xp.abs(r)),
        *BRAKING[:2],
    ],
    "smooth": [lambda xp, r: xp.sin(r), lambda xp, r: r, lambda xp, r: r * xp.abs(r), BRAKING[2]],
    "undefined": [
        lambda xp, r: 0 * xp.sqrt(r),
        lambda xp, r: xp.log(r) - xp.log(r),
        lambda xp, r: r / r,
        lambda xp, r: r**1.5,
    ],
}


def draw(kind: str, rng, harmless: bool) -> Case:
    """Friction `−damping v + size · shape((v + slant · x − at) / width)` on a region."""

    def spread(low, high):
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    velocity, damping = spread(0.3, 3), spread(0.05, 2)
    width, at = (
        velocity * spread(0.2 if harmless else 0.02, 1),
        velocity * rng.choice([0.0, rng.uniform(-0.9, 0.9), 1.0]),
    )
    shapes, slant = (BRAKING, 0.0) if harmless else (KINDS[kind], rng.choice([0.0, 0.0, rng.normal()]))
    size = width * (-spread(0.05, 3) if harmless else rng.choice([-1, 1]) * ALPHA * spread(0.05, 20))
    shape = shapes[rng.integers(len(shapes))]
    low = rng.uniform(-1.5, 0.5)
    bounds = {"velocity": velocity, "error": spread(0.02, 0.5), "position": (low, low + rng.uniform(0.2, 2))}
    return Case(lambda xp, x, v: -damping * v + size * shape(xp, (v + slant * x - at) / width), speed=at, **bounds)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", KINDS)
def test_no_proof_is_contradicted(kind):
    wrong, proved, count = 0, 0, 192
    for index in range(COUNT):
        rng, harmless = np.random.default_rng([list(KINDS).index(kind), index]), index % 3 == 0
        case = draw(kind, rng, harmless)
        x, v = rng.uniform(*case.position, count), case.velocity * np.clip(rng.uniform(-1.2, 1.2, count), -1, 1)
        v[::3] = case.speed  # where the friction bends or jumps
        run = simulate(case.law, x, v, *around(1e-7, count), hold=True)
        with np.errstate(all="ignore"):
            defined = np.isfinite(case.law(np, x, v)).all()
        false = not defined or excess(run, case) > 1.01
        holds = verdict(line(case.law), **case.bounds()) == "holds"
        assert not (holds and false), (kind, index)
        wrong += false and not harmless
        proved += holds and harmless
    assert wrong >= COUNT // 6, "a generator of harmless laws attacks nothing"
    assert proved >= 0.5 * (COUNT // 3)
