"""A certificate that is not right is refused with the reason, and a prover with a mistake would be found out."""

import ast
import json
from pathlib import Path

import balls
import pytest
from forging import forged, put, together

from covariant import models
from covariant.certificates import AbstractClaim, certify, check, error_system, parse
from covariant.certificates.base import CLAIMS, value_graph
from covariant.certificates.checking import _check, _check_sampled, _matrices
from covariant.certificates.checking._saved import observer_from
from covariant.observers import Intrinsic


def prove(recipe, alpha, beta, **bounds):
    """A certificate that holds, of a model by its recipe."""
    found = certify(Intrinsic(models.from_recipe(recipe), alpha, beta), **bounds, recipe=recipe)
    assert found.statement.verdict == "holds"
    return found


OSCILLATOR = {"system": "oscillator", "parameters": {"chart": "r"}}
BOUNDS = {"velocity": 0.2, "error": 0.05, "position": (0.8, 1.2), "input": 0.1}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A certificate of a system of one coordinate, whose metric depends on it."""
    return prove(OSCILLATOR, 4.0, 8.0, **BOUNDS).save(tmp_path_factory.mktemp("oscillator") / "certificate.json")


def forge(path, folder, change):
    """A forged certificate, with the graph of its observer or metric where they are others."""
    before, made = json.loads(path.read_text(encoding="utf-8")), forged(path, folder, change)
    after = json.loads(made.read_text(encoding="utf-8"))
    if "system" in after["recipe"] and any(before[key] != after[key] for key in ("recipe", "observer", "q")):
        return forged(made, folder, put("graph", value_graph(error_system(*observer_from(parse(made))))))
    return made


def finely(letters="abcd", depth=14):
    """A tree of 2^depth leaves in place of that of the first claim."""
    return put("claims[0].levels", [letters[k % len(letters)] * 2**k for k in range(depth)] + ["." * 2**depth])


@pytest.mark.exhaustive("abcd", "dbca")
@pytest.mark.long("abcd")
@pytest.mark.parametrize("letters", ["abcd", "dbca"])
def test_a_large_tree_only_says_where_to_look(saved, tmp_path, letters):
    """Whichever variables it halves: it is another proof of the same statement."""
    path = forge(saved, tmp_path, finely(letters))
    assert check(path).leaves > 2**14


FORGERIES = {
    "rate": (put("rate", 6.0), r"claims\[0\] is not shown to hold where"),
    "radius": (put("radius", lambda r: 1.01 * r), "which its box|may reach"),
    "radius and limit": (
        together(put("radius", lambda r: 3 * r), put("claims[1].limit", 1.0), put("claims[2].limit", 1.0)),
        "outside of",
    ),
    "limit": (put("claims[1].limit", lambda w: 1.01 * w), "of room"),
    "square": (put("claims[1].square", lambda s: s / 4), r"claims\[1\] is not shown|may reach"),
    "box beyond the metric": (
        put("box.low[0]", lambda v: -v),
        "definedness of the observer, without jumps, is not shown",
    ),
    "box enlarged": (put("box.high[1]", lambda v: 40 * v), r"claims\[\d\] is not shown to hold where"),
    "box without the error": (put("box.high[0]", lambda v: v - 0.01), "r may be .* which its box"),
    "force box": (put("box.high[3]", lambda v: 0.5 * v), "the bound of the force is not shown"),
    "velocity": (put("velocity[0]", lambda v: v + 0.1), "v_r may be"),
    "position": (put("given.positions.high[0]", 1.3), "r may be"),
    "input": (put("given.inputs.high[0]", 0.2), "the bound of the force is not shown to hold"),
    "Q": (put("q", lambda q: [[1.0, 0.0], [0.0, 1.0]]), r"claims\[0\] is not shown to hold where"),
    "gain": (put("observer.alpha", 0.1), r"claims\[0\] is not shown to hold where"),
    "leaves joined": (put("claims[0].levels", ["."]), r"claims\[0\] is not shown to hold where"),
}
"""What reads well, and is not true; files that do not read well are in `tests/attacks/test_files.py`."""


@pytest.mark.exhaustive("radius and limit", "box beyond the metric", "box enlarged", "rate")
@pytest.mark.core(1)
@pytest.mark.long("Q", "gain", "leaves joined", "radius and limit", "square")
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forger_who_mends_the_digest_is_refused_with_the_reason(saved, tmp_path, monkeypatch, name):
    change, reason = FORGERIES[name]
    if name in ("leaves joined", "rate", "gain", "Q"):
        monkeypatch.setattr(_check, "DEPTH", 2)
    with pytest.raises(ValueError, match=reason):
        check(forge(saved, tmp_path, change))


# Regions that are not geodesically convex: the sector of a ring in polar coordinates, whose chords leave it inwards.


# The check is small, and shares with the prover the description of an observer alone.


SHARED = """
    certificates.checking._check_sampled certificates.checking._matrices certificates.checking._saved.observer_from
    certificates.checking._saved.system_of certificates.base.Document certificates.base.Resolved certificates.base.parse
    certificates.base.first_velocity certificates.base.Intrinsics certificates.base.check_unique
    certificates.base.configuration_shape certificates.base.friction_of certificates.base.reach_squares
    certificates.base.select certificates.base.value_graph certificates.base.ErrorSystem certificates.base.corrections
    certificates.base.values certificates.base.Recursion certificates.sampled.Prediction
    certificates.sampled.defect_matrix certificates.sampled.step_values certificates.sampled.sampled_prediction
    _errors.InputError models.MechanicalSystem models.applied_force models.input_count
"""
"""Beside claims as a file states them: a file with its observer, the steps of predictions without their series, and the
recursion that composes claims, as numbers."""


@pytest.mark.parametrize("module", [_check, _check_sampled, _matrices])
def test_the_check_shares_with_the_prover_the_observer_alone(module):
    imported = set()
    for node in ast.walk(ast.parse(Path(module.__file__).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported |= {f"{node.module}.{alias.name}" for alias in node.names}
    own = {name for name in imported if name.startswith("covariant")}
    kinds = {f"certificates.base.{kind.__name__}" for kind in (AbstractClaim, *CLAIMS.values())}
    allowed = {f"covariant.{name}" for name in (*SHARED.split(), *kinds, "_errors.InputError")}
    assert {name for name in own if not name.startswith("scalargraph.proofs.checker.")} <= allowed


def test_each_kind_of_claim_has_a_matrix_of_the_prover_and_one_of_the_checker():
    assert set(CLAIMS) == set(_matrices.MATRICES) == set(balls._FORMS)
    assert all(kind.kind == name for name, kind in CLAIMS.items())
