"""The certificate of a workboat with a rudder, by the command of its page; what is changed in it is refused."""

import tomllib

import numpy as np
import pytest
from forging import forged, put, together

import covariant
from covariant import models
from covariant.certificates import certify, check, error_system, parse, trajectories
from covariant.certificates.base import value_graph
from covariant.certificates.checking import _check
from covariant.certificates.checking._saved import observer_from
from covariant.geometry.lie import SE2
from covariant.observers import Intrinsic

pytestmark = pytest.mark.long
HULL = """
system = "ship"

[parameters]
mass = [1650.0, 2300.0, 4200.0]
drag = [60.0, 1500.0, 5000.0]
quadratic_drag = [45.0, 500.0, 3500.0]
rudder = 110.0
rudder_arm = 2.6
"""
BOUNDS = {"alpha": 4.0, "beta": 10.0, "velocity": (3.0, 0.5, 0.3), "error": (0.2, 0.2, 0.1)}
REGION = {"rudder": (-0.35, 0.35), "thrust": (0.0, 600.0)}


@pytest.fixture(scope="module")
def proved(tmp_path_factory):
    path = tmp_path_factory.mktemp("boat") / "boat.toml"
    path.write_text(HULL)
    return covariant.certify(path, **BOUNDS, region=REGION, checker="all")


@pytest.fixture(scope="module")
def saved(proved, tmp_path_factory):
    return proved.save(tmp_path_factory.mktemp("boat") / "boat.json")


def test_the_workboat_holds_and_its_file_is_checked(proved, saved):
    assert proved.certificate.statement.short == "holds (proved)"
    assert proved.certificate.rate == pytest.approx(4 / 3, rel=1e-5)
    assert proved.certificate.boxes < 100
    assert "true positions: any, since nothing depends on them" in str(proved)
    assert check(saved).leaves == sum(level.count(".") for claim in parse(saved).claims for level in claim.levels)


def test_simulated_distances_fall_as_stated(proved):
    assert trajectories(proved.certificate).distances.holds


MUTANTS = {
    "rudder reversed": (put("recipe.parameters.rudder", -110.0), "graph: it must be", False),
    "damping of sway reversed": (put("recipe.parameters.drag[1]", -1500.0), r"claims\[0\] is not shown", True),
    "rudder thirty times": (put("recipe.parameters.rudder", 3300.0), r"claims\[0\] is not shown", True),
    "mass three times": (put("recipe.parameters.mass[1]", 7000.0), r"claims\[0\] is not shown", True),
    "rate three times": (put("rate", lambda rate: 3 * rate), r"claims\[0\] is not shown", False),
    "half the rudder in the box": (
        together(put("box.low[9]", -0.17), put("box.high[9]", 0.17)),
        "box: it must hold all given values of rudder",
        False,
    ),
    "no rudder in the box": (together(put("driven"), put("box.low[9]"), put("box.high[9]")), "box", False),
}


@pytest.mark.parametrize("name", MUTANTS)
def test_mutants_are_refused(saved, tmp_path, monkeypatch, name):
    change, reason, mended = MUTANTS[name]
    monkeypatch.setattr(_check, "DEPTH", 2)
    path = forged(saved, tmp_path, change)
    if mended:
        path = forged(path, tmp_path, put("graph", value_graph(error_system(*observer_from(parse(path))))))
    with pytest.raises(ValueError, match=reason):
        check(path)


def test_too_fast_at_low_gains_is_refuted():
    boat = models.marine.ship(**tomllib.loads(HULL)["parameters"])
    faster = {"velocity": (3.0, 0.6, 0.4), "error": (0.3, 0.3, 0.1), "position": REGION}
    assert certify(Intrinsic(boat, 2.0, 2.0), **faster).statement.verdict == "fails"


def test_cybership_holds_with_the_drag_that_was_identified():
    """Its drag does not dissipate energy in every motion; in the region it is small beside the gains."""
    craft = models.marine.cybership()
    drag = {"dissipation": lambda g, v: -craft.damping(v) @ v, "velocities": craft.velocities}
    ship = models.GroupSystem(SE2, np.asarray(craft.mass), **drag, units=craft.velocity_units)
    bounds = {"velocity": (0.4, 0.1, 0.2), "error": 0.05, "input": [2.0, 2.0, 1.0]}
    found = certify(Intrinsic(ship, 10.0, 50.0), **bounds, checker="all")
    assert found.statement.short == "holds (proved)"
