"""Random systems of every kind: no proof is contradicted by a simulation, and harmless ones are proved.

`COVARIANT_ATTACKS=500` draws as many of each kind, instead of a dozen.
"""

import os
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from generators import KINDS, System, contradiction, draw, is_defined

COUNT = int(os.environ.get("COVARIANT_ATTACKS", "12"))
ALLOWED = 1.01
"""How much simulated distances may exceed a bound, for the integration."""
SHARE = {"discontinuity": 0.9, "kink": 0.6, "place": 0.6, "injectivity": 0.7, "definedness": 0.5}
"""Of the harmless systems of each kind, so many at least are to be proved, or half."""


class Tally(NamedTuple):
    """Of the systems of a kind: how many were proved, of the harmless ones how many, and of how many."""

    proved: int
    harmless_proved: int
    harmless: int


def checked(system: System, index: int) -> bool:
    """Whether a system is proved; fails where a simulation contradicts that."""
    noisy = system.kind == "noise"
    found = system.certify()
    if found is None or found.statement.verdict != "holds":
        return False
    if system.kind == "definedness":
        assert is_defined(system, index), f"friction that is not defined is proved: {system}"
    drift, acting = 0.0, {}
    if noisy:
        drift, acting = found.steady, signals(system, index)
        assert drift < found.radius
    worst = contradiction(system, found, index, drift, **acting)
    assert worst <= ALLOWED, f"number {index}: distances exceed the bound {worst} times: {system}"
    return True


def signals(system: System, seed: int, steps: int = 500, count: int = 192) -> dict[str, np.ndarray]:
    """Noise of the position and unknown forces within their bounds: constant, random, and switching all at once."""
    rng = np.random.default_rng(seed)
    found = {}
    for name, key in (("noise", "noise"), ("unknown", "disturbance")):
        constant = np.ones((steps, count // 3))
        slow = np.sign(np.sin(np.outer(np.arange(steps), rng.uniform(0.005, 0.5, count // 3)) + rng.uniform(0, 6)))
        quick = rng.uniform(-1, 1, (steps, count - 2 * (count // 3)))
        signs = rng.choice([-1.0, 1.0], count)
        found[name] = (system.bounds[key] * signs * np.concatenate([constant, slow, quick], axis=1))[:, None]
    return found


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", KINDS)
def test_no_proof_is_contradicted(kind):
    harmless, proved, both = 0, 0, 0
    for index in range(COUNT):
        system = draw(kind, index)
        held = checked(system, index)
        harmless += system.harmless
        proved += held
        both += held and system.harmless
    tally = Tally(proved, both, harmless)
    print(kind, tally)
    assert tally.harmless_proved >= SHARE.get(kind, 0.5) * tally.harmless, tally


@pytest.mark.exhaustive
def test_simulations_would_notice():
    """Of systems that are meant to be harmful many are: their friction, had it been proved, would be contradicted."""
    for kind in ("discontinuity", "kink", "place"):
        harmful = 0
        for index in range(18):
            system = draw(kind, index)
            if system.harmless:
                continue
            pretended = SimpleNamespace(radius=1e-3 * float(system.bounds["velocity"]), rate=system.bounds["rate"])
            harmful += contradiction(system, pretended, index) > ALLOWED  # pyright: ignore[reportArgumentType]
        assert harmful >= 4, kind
