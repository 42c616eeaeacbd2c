"""The checker alone: what a prover that was blind, or a liar, would have certified it refuses: what takes long."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_checker import RECIPE, certified, harmless, line, shown_as

from covariant import models
from covariant.certificates import certify, check
from covariant.certificates.checking import _check
from covariant.geometry import lie
from covariant.observers import Intrinsic
from scalargraph.proofs import _prove


def test_another_force_is_not_within_its_bounds_or_not_defined(harmless, monkeypatch):
    monkeypatch.setattr(_check, "DEEPEST", 12)
    for force, reason in (
        (lambda t, q, u: u + q, "bound of the force is not shown"),
        (lambda t, q, u: u + 0 * jnp.sqrt(q), "definedness of the force is not shown"),
    ):
        with pytest.raises(ValueError, match=reason):
            shown_as(harmless, line(lambda q, v: -v, force=force), monkeypatch)
    jumping = line(lambda q, v: -v, force=lambda t, q, u: jnp.where(q > 0, u, u / 2))
    assert shown_as(harmless, jumping, monkeypatch).leaves  # a known force may


KINKS = {
    "drag": lambda q, v: -v * jnp.abs(v),
    "one-sided": lambda q, v: -jnp.maximum(v, 0.0) - v,
    "saturated": lambda q, v: -jnp.clip(v, -0.5, 0.5),
}


@pytest.mark.parametrize("name", KINKS)
def test_kinks_that_brake_are_proved_and_checked(tmp_path, name):
    model = line(KINKS[name])
    assert check(certified(model).save(tmp_path / "kink.json"), model=model).leaves


@pytest.mark.exhaustive
def test_noise_and_its_slopes_are_checked(tmp_path, monkeypatch):
    """A certificate for a soft spring says nothing about a stiff one, though the force stays within the same bounds."""
    soft = line(lambda q, v: -v, potential=lambda q: 2 * q[0] ** 2)
    noisy = certified(soft, noise=1e-3, disturbance=0.01)
    assert noisy.statement.claim.endswith(", under measurement errors up to 0.001 and unknown forces up to 0.01")
    assert "under" not in certified(soft).statement.claim
    path = noisy.save(tmp_path / "noisy.json")
    assert check(path, model=soft).leaves
    monkeypatch.setattr(_check, "DEEPEST", 12)
    slopes, jumps = "bound of the force's slopes is not shown", "smoothness of the force is not shown"
    for force, reason in (
        (lambda q: jnp.sin(60 * q), slopes),
        (lambda q: jax.lax.stop_gradient(jnp.sin(60 * q)), slopes),
        (lambda q: jnp.where(q > 0, 1.0, -1.0), jumps),
    ):
        with pytest.raises(ValueError, match=reason):
            shown_as(path, line(lambda q, v: -v, force=lambda t, q, u, f=force: u + f(q)), monkeypatch)


@pytest.mark.exhaustive
def test_a_rotation_that_jumps_at_the_estimate_is_refused_by_prover_and_checker(tmp_path, monkeypatch):
    """In the chart about the estimate the jump is at a variable that is held fixed."""

    def step(g, v):
        return -v + 50 * jnp.where(v > 0, 1.0, -1.0)

    def wheel(dissipation):
        return models.GroupSystem(lie.SO2, np.eye(1), dissipation=dissipation)

    given = {"velocity": 1.0, "error": 0.1, "recipe": RECIPE}
    assert certify(Intrinsic(wheel(step), 10.0, 50.0), **given).statement.verdict == "undecided"
    honest = _prove._reason
    monkeypatch.setattr(_prove, "_reason", lambda formed, domain: "")
    careless = certify(Intrinsic(wheel(step), 10.0, 50.0), **given, checker="off")
    monkeypatch.setattr(_prove, "_reason", honest)
    assert careless.statement.verdict == "holds"
    with pytest.raises(ValueError, match="definedness of the observer, without jumps, is not shown"):
        check(careless.save(tmp_path / "careless.json"), model=wheel(step))
