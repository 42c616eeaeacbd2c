"""What takes long of `test_joint_by_joint.py`: the checker accepts what is proved, and refuses mutants."""

import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from test_joint_by_joint import branching, certified

from covariant import models
from covariant.certificates import certify_globally, check_globally
from covariant.certificates.everywhere import _certify, _chain
from covariant.observers import MeasuredCoefficients
from scalargraph.errors import InputError
from scalargraph.proofs import digest


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    return branching(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def made(recipe):
    return certified(recipe)


def saved(certificate, tmp_path, **changes):
    content = certificate.document.document() | changes
    content["digest"] = digest({key: value for key, value in content.items() if key != "digest"})
    path = tmp_path / "arm.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def changed(rows, i, j, factor):
    rows = np.array(rows)
    rows[i, j] *= factor
    return rows.tolist()


MUTANTS = {
    "least": (lambda d: {"inertia": changed(d["inertia"], 3, 0, 1.1)}, "inertia is not shown"),
    "floors": (lambda d: {"inertia": changed(d["inertia"], slice(1, 4), slice(1, 22), 0.9)}, "inertia is not shown"),
    "ceilings": (lambda d: {"inertia": changed(d["inertia"], 2, slice(22, 43), 0.9)}, "inertia is not shown"),
    "masses": (lambda d: {"inertia": changed(d["inertia"], 1, slice(43, 49), 0.0)}, "negative masses"),
    "coupling": (lambda d: {"coupling": 0.99 * d["coupling"]}, "coupling: it is shown"),
    "speed": (lambda d: {"velocity": [1.02 * v for v in d["velocity"]]}, "coupling: it is shown"),
    "force": (lambda d: {"disturbance": [1.02 * f for f in d["disturbance"]]}, "coupling: it is shown"),
    "rows": (lambda d: {"inertia": d["inertia"][:3]}, "no rows, or 4"),
}


@pytest.mark.core(15)
def test_the_checker_accepts_what_is_proved(made, tmp_path):
    checked = check_globally(made.document.save(tmp_path / "arm.json"))
    assert checked is not None
    assert checked.statement.proved


@pytest.mark.core(15)
@pytest.mark.parametrize("case", MUTANTS)
def test_a_changed_file_is_refused(made, tmp_path, case):
    change, message = MUTANTS[case]
    with pytest.raises(InputError, match=message):
        check_globally(saved(made, tmp_path, **change(made.document.document())))


def test_masses_that_no_body_has_prove_nothing(made):
    """Moments about the axis that are smaller than those along it cannot be completed by what the carrier shares."""
    chain, inertia = _chain.Chain.of(made.observer.model.space), _chain.InertiaBounds.of(made.document.inertia)
    second = np.array(chain.space.tree.second)
    second[1, 0, 0] = -0.01
    space = eqx.tree_at(lambda s: s.tree.second, chain.space, jnp.asarray(second))
    assert chain.prove(inertia, made.proof.box).verdict == "holds"
    assert chain._replace(space=space).prove(inertia, made.proof.box).verdict == "undecided"


PROVERS = {
    "half of the speeds": ("reach", lambda old: lambda *a: 0.5 * old(*a), "coupling: it is shown"),
    "what a body carries is missing": (
        "whole",
        lambda old: lambda self, i, _: self.inertias[i],
        "inertia is not shown",
    ),
    "frames that do not turn": ("map", lambda old: lambda self, i, _: old(self, i, 0.0), "inertia is not shown"),
}


@pytest.mark.core(15)
@pytest.mark.parametrize("what", PROVERS)
def test_a_prover_that_is_wrong_is_refused_by_the_checker(monkeypatch, recipe, tmp_path, what):
    name, wrong, message = PROVERS[what]
    monkeypatch.setattr(_chain.Chain, name, wrong(getattr(_chain.Chain, name)))
    made = certified(recipe)
    assert made.statement.proved
    with pytest.raises(InputError, match=message):
        check_globally(made.document.save(tmp_path / "arm.json"))


@pytest.mark.core(30)
def test_gains_that_are_given_are_proved_without_boxes(monkeypatch, recipe):
    monkeypatch.setattr(_certify, "FEW", 1)
    model, speed = models.from_recipe(recipe), jnp.array([1.0, 1.5, 0.5, 2.0])
    fast, slow = (MeasuredCoefficients(model, 1.4 * w, w**2, speed) for w in (300.0, 20.0))
    proved = certify_globally(fast, interval=(1e-3, 1e-3))
    assert proved.statement.proved
    assert len(proved.document.inertia)
    assert certify_globally(slow, interval=(1e-3, 1e-3), boxes=50).statement.verdict == "undecided"


@pytest.mark.core(15)
def test_samples_that_are_too_far_apart_are_told_beside_the_gains_that_are_needed(monkeypatch, recipe):
    monkeypatch.setattr(_certify, "FEW", 1)
    made = certify_globally(models.from_recipe(recipe), velocity=4.0, interval=(0.1, 0.1), boxes=50)
    assert made.statement.verdict == "undecided"
    coupling, gain = made.statement.hypotheses[:2]
    assert coupling.verdict == "holds"
    assert "or more is needed, at samples closer than 1/ω" in str(gain)


@pytest.mark.core(15)
def test_joints_on_other_branches_do_not_couple(made):
    chain = _chain.Chain.of(made.observer.model.space)
    inertia = _chain.InertiaBounds.of(made.document.inertia)
    only_last = chain.reach(inertia.ceilings, np.array([0.0, 0.0, 0.0, 1.0]))
    assert only_last[1] == only_last[2] == 0.0
    sliding = chain.reach(inertia.ceilings, np.array([0.0, 0.0, 1.0, 0.0]))
    assert sliding[2] == 0.0 < sliding[1]
