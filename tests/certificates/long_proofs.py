"""What the prover proves, what it rejects, and that it would notice if it were wrong: what takes long."""

import functools
import tomllib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from test_proofs import ALPHA, BETA, PAPER, ball_and_beam_region, flat, margin_of

from covariant import models
from covariant.certificates import Statement, certify, contraction, error_system, falsify
from covariant.certificates.base import in_coordinates, rate_of
from covariant.geometry import hyperbolic
from covariant.observers import Intrinsic
from scalargraph.proofs import Box, _prove, box, prove


@functools.cache
def hyperbolic_plane():
    return models.Lagrangian(hyperbolic(), lambda q: jnp.zeros(()), coordinates=("x", "y"), units=("", ""))


@pytest.mark.exhaustive
def test_the_observer_of_the_paper_is_proved_and_its_spoiled_forms_are_not():
    about, region = ball_and_beam_region(1.0)
    found = prove(contraction(about, 0.2), region)
    assert found.verdict == "holds"
    assert found.seconds < 60
    assert prove(contraction(about, 0.3853), region).verdict == "fails"
    spoiled = error_system(Intrinsic(models.ball_and_beam(), ALPHA, BETA, curvature=False), PAPER)
    assert prove(contraction(spoiled, 0.01), region).verdict == "fails"


@pytest.mark.exhaustive("4.0")
@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0, 4.0, 8.0, 16.0])
def test_the_tube_on_the_hyperbolic_plane_shrinks_with_the_speed(speed):
    """Strict contraction ends at |ξ| |v̂| = 0.130; 0.08 is proved, and no point in the proved set breaks it."""
    about = error_system(Intrinsic(hyperbolic_plane(), ALPHA, BETA), PAPER)
    # By symmetry the estimate sits at the origin and moves along x; lengths are twice the coordinates there.
    proved, broken = (
        Box(about.names, about.units, np.array([0, 0, 0, 0, -e, -e, 0, 0]), np.array([0, 0, speed / 2, 0, e, e, 0, 0]))
        for e in (0.08 / speed / 2, 0.135 / speed / 2)
    )
    assert prove(contraction(about, 0.0), proved).verdict == "holds"
    assert prove(contraction(about, 0.0), broken).verdict == "fails"
    attempts = 1_000_000 if speed == 4.0 else 10_000
    assert falsify(about, proved, 0.0, attempts=attempts).verdict == "holds"


@pytest.mark.exhaustive
def test_a_vehicle_of_twelve_states_is_proved_for_all_attitudes():
    file = tomllib.loads((Path(__file__).parents[2] / "examples/underwater_vehicle.toml").read_text(encoding="utf-8"))
    low, high = -np.ones((4, 4)), np.ones((4, 4))
    low[:3, 3], high[:3, 3] = -10.0, 10.0
    low[3] = high[3] = [0.0, 0.0, 0.0, 1.0]
    bounds = {"velocity": 0.3, "error": 0.005, "position": (low, high), "input": [20.0, 20.0, 20.0, 2.0, 2.0, 2.0]}
    model = models.underwater_vehicle(**file["parameters"])
    found = certify(Intrinsic(model, 10.0, 50.0), **bounds, rate=2.0, boxes=100, checker="off")
    assert found.statement.proved
    assert found.boxes == 13


@pytest.mark.exhaustive
def test_worker_processes_find_the_same_tree(monkeypatch):
    about, region = ball_and_beam_region(1.5, 0.01, 0.2)
    alone = prove(contraction(about, 0.2), region)
    monkeypatch.setattr(_prove, "PATIENCE", 0)
    shared = prove(contraction(about, 0.2), region, processes=2)
    assert alone.verdict == shared.verdict == "holds"
    assert [level.tolist() for level in alone.levels] == [level.tolist() for level in shared.levels]


def test_open_boxes_and_progress_are_told():
    told = []
    found = prove(
        margin_of(lambda t, x: -(x**3), in_coordinates(flat)),
        box(x=(-1.0, 1.0), t=(0.0, 1.0)),
        boxes=4000,
        progress=lambda share, boxes: told.append((share, boxes)),
    )
    assert found.verdict == "undecided"
    assert len(found.open)
    assert told[-1][0] > 0.9
    assert (np.abs(found.open[:, :, 0]).min(axis=1) < 1e-3).all()


@pytest.mark.exhaustive
def test_the_default_metric_is_for_two_thirds_of_the_rate():
    found = certify(
        Intrinsic(models.ball_and_beam(), 4.0, 8.0), velocity=0.3, error=0.01, position=(-0.1, 0.1), input=0.1
    )
    assert isinstance(found.statement, Statement)
    assert found.statement.verdict == "holds"
    assert rate_of(4.0, 8.0, found.q) == pytest.approx(2 * found.rate)
