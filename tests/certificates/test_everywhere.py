"""Certificates of all first errors: simulated starts keep to them, the checker accepts them, mutants are refused."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models, observers
from covariant.certificates import certify_globally, check_globally
from covariant.certificates.base import lowered_christoffel
from covariant.certificates.everywhere import _coupling
from covariant.models import Lagrangian
from covariant.observers import MeasuredCoefficients
from scalargraph.proofs import digest

RECIPE = models.recipe("pendulum_chain")
ARM = models.from_recipe(RECIPE)
STEP, ROWS = 0.001, 2000
LOST = 1


@pytest.fixture(scope="module")
def proved():
    return certify_globally(ARM, velocity=1.0, interval=(STEP, STEP), lost=LOST, recipe=RECIPE)


def test_turns_of_circles_are_counted(proved):
    """An estimate two turns off comes back, and measurements that wrap do not move it."""
    angles = np.linspace(0.0, 8.0, ROWS)[:, None] * [1.0, -1.0]
    wrapped = np.mod(angles + np.pi, 2 * np.pi) - np.pi
    observer = MeasuredCoefficients(Lagrangian(lambda q: jnp.eye(2), circles=(0, 1)), 40.0, 800.0, 5.0)
    first = np.array([[4 * np.pi, -4 * np.pi], [4.0, -4.0]])
    state = observer.init(jnp.asarray(wrapped[0]))
    state = state._replace(q=state.q + first[0])
    step = jax.jit(observer.step)
    for y in wrapped[1:]:
        state, _ = step(state, jnp.zeros(2), jnp.asarray(y), STEP)
    np.testing.assert_allclose(state.q, angles[-1], atol=1e-6)
    np.testing.assert_allclose(state.v, [8.0 / (ROWS - 1) / STEP, -8.0 / (ROWS - 1) / STEP], atol=1e-5)


def test_the_prediction_and_correction_are_the_linear_step_of_the_proof(proved):
    from covariant.certificates.everywhere._channel import Channel

    unit = Lagrangian(lambda q: jnp.eye(1), inputs=1)
    observer, omega, tau = MeasuredCoefficients(unit, 30.0, 500.0), 500.0**0.5, 0.013
    channel = Channel.of(30.0, 500.0, tau)
    state = observer.init(jnp.zeros(1))._replace(q=jnp.array([0.3]), v=jnp.array([-2.0]))
    d, n = jnp.array([1.7]), jnp.array([0.02])
    after, _ = observer.correct(observer.predict(state, d, tau), d, n)
    x = jnp.array([omega * 0.3, -2.0])
    expected = channel.flow @ x + channel.force * d[0] / omega + channel.noise * omega * n[0]
    np.testing.assert_allclose([omega * after.q[0], after.v[0]], expected, rtol=1e-12)


def saved(certificate, tmp_path, **changes):
    content = certificate.document.document() | changes
    content["digest"] = digest(content)
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.core(4)
def test_the_checker_accepts_what_is_proved(proved, tmp_path):
    checked = check_globally(proved.document.save(tmp_path / "arm.json"))
    assert checked is not None
    assert checked.statement.proved
    assert checked.statement.claim == proved.statement.claim
    assert check_globally("other.json", b'{"format": "other"}') is None


MUTANTS = {
    "a lower coupling": lambda d: {"coupling": 0.8 * d.coupling},
    "a faster rate": lambda d: {"rate": 3 * d.rate},
    "a smaller gain of one joint": lambda d: {
        "alpha": [d.alpha[0], d.alpha[1] / 2],
        "beta": [d.beta[0], d.beta[1] / 4],
    },
    "a gain of 1/ω": lambda d: {"alpha": (1 / d.alpha).tolist(), "beta": (1 / d.beta).tolist()},
    "other weights": lambda d: {"weights": [d.weights[0], 4 * d.weights[1]]},
    "another metric": lambda d: {"metrics": [np.eye(2).tolist()] * 2},
    "a faster arm": lambda d: {"velocity": (2 * d.velocity).tolist()},
    "longer samples": lambda d: {"interval": [0.001, 0.5]},
    "a tree of one box that is not proved": lambda d: {"levels": ["?"]},
    "a tree that lacks a box": lambda d: {"levels": list(d.levels[:-1])},
    "another arm": lambda d: {"recipe": {"system": "pendulum_chain", "parameters": {"mass": [1.0, 9.0]}}},
}


@pytest.mark.core(4)
@pytest.mark.parametrize("case", MUTANTS)
def test_a_changed_file_is_refused(proved, tmp_path, case):
    with pytest.raises(ValueError, match=r"changed\.json"):
        check_globally(saved(proved, tmp_path, **MUTANTS[case](proved.document)))


def test_a_changed_file_without_its_digest_is_refused(proved, tmp_path):
    path = proved.document.save(tmp_path / "arm.json")
    path.write_text(path.read_text().replace('"lost": 1', '"lost": 2'))
    with pytest.raises(ValueError, match="digest"):
        check_globally(path)


@pytest.mark.core(3)
def test_a_prover_with_another_sign_does_not_prove(monkeypatch):
    """Of the symbols: they are compared with the connection that the observer computes."""
    monkeypatch.setattr(_coupling, "lowered_christoffel", lambda d: lowered_christoffel(d) + d)
    assert not certify_globally(ARM, velocity=1.0, interval=(STEP, STEP)).statement.proved


@pytest.mark.core(3)
@pytest.mark.parametrize("what", ["half of the speeds", "a joint that is missing", "M for its inverse"])
def test_a_prover_that_is_wrong_is_refused_by_the_checker(monkeypatch, tmp_path, what):
    right = _coupling.coupling_of

    def wrong(document, t, inverse):
        if what == "half of the speeds":
            return right(document._replace(velocity=document.velocity / 2), t, inverse)
        if what == "a joint that is missing":
            return right(document, t, inverse) * np.array([[1.0, 0.0], [1.0, 1.0]])
        return right(document, t * 0.3, inverse)

    monkeypatch.setattr(_coupling, "coupling_of", wrong)
    made = certify_globally(ARM, velocity=1.0, interval=(STEP, STEP), recipe=RECIPE)
    monkeypatch.undo()
    assert made.statement.proved
    with pytest.raises(ValueError, match="is not shown"):
        check_globally(made.document.save(tmp_path / "wrong.json"))


def test_gains_that_do_not_suffice_are_undecided():
    weak = MeasuredCoefficients(ARM, 3.0, 4.0, 1.0)
    made = certify_globally(weak, interval=(STEP, STEP))
    assert made.statement.verdict == "undecided"
    assert "is needed" in str(made.statement)


def test_a_small_effort_gives_the_bound_so_far(proved):
    some = certify_globally(ARM, velocity=1.0, interval=(STEP, STEP), boxes=10)
    assert some.proof.boxes <= 10
    assert not some.statement.proved or some.document.omega.max() > proved.document.omega.max()


@pytest.mark.core(3)
def test_dry_friction_is_an_unknown_force_and_viscous_friction_couples():
    drag = {"parameters.viscous": [0.2, 0.1]}
    viscous = certify_globally(models.load("pendulum_chain", drag).model, velocity=1.0, interval=(STEP, STEP))
    np.testing.assert_allclose(viscous.document.viscous, [0.2, 0.1], rtol=1e-10)
    assert (viscous.document.dry == 0).all()
    dry = certify_globally(
        models.load("pendulum_chain", drag | {"parameters.coulomb": [0.05, 0.05]}).model,
        velocity=1.0,
        interval=(STEP, STEP),
    )
    assert dry.statement.proved
    # Between velocities of −1 and 1 rad/s, 0.05 atan(100 v) differs by this.
    np.testing.assert_allclose(dry.document.dry, 0.1 * np.arctan(100.0), rtol=0.05)
    assert dry.document.radius() > 0
    assert viscous.document.radius() < 1e-3


def test_one_coordinate_that_does_not_couple_converges_at_any_gains(tmp_path):
    recipe = models.recipe("oscillator")
    observer = MeasuredCoefficients(models.from_recipe(recipe), 4.0, 8.0, 1.0)
    bounds = {"position": (-1.0, 1.0), "interval": (0.001, 0.002), "noise": 1e-4}
    made = certify_globally(observer, lost=2, recipe=recipe, **bounds)
    assert made.statement.proved
    assert check_globally(made.document.save(tmp_path / "one.json")) is not None
    with pytest.raises(ValueError, match="any gains do"):
        certify_globally(observer.model, velocity=1.0, **bounds)


def of_friction(dissipation):
    return Lagrangian(
        lambda q: jnp.array([[2.0, 0.3 * jnp.cos(q[1])], [0.3 * jnp.cos(q[1]), 1.0]]),
        dissipation=dissipation,
        circles=(1,),
        coordinates=("a", "b"),
        inputs=2,
    )


@pytest.mark.parametrize(
    ("dissipation", "message"),
    [
        (lambda q, v: -jnp.sign(v), "jumps"),
        (lambda q, v: -v[::-1], "couples coordinates"),
        (lambda q, v: -(2 + jnp.cos(q[1])) * v, "depends on the position"),
        (lambda t, q, v, u: -v * (1 + u**2), "depends on u1"),
    ],
)
def test_friction_that_is_not_covered_is_refused(dissipation, message):
    with pytest.raises(ValueError, match=message):
        certify_globally(of_friction(dissipation), velocity=1.0, interval=(STEP, STEP), position=(-1.0, 1.0))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: certify_globally(models.free_body(), velocity=1.0, interval=(0.1, 0.1)), "coordinates"),
        (lambda: certify_globally(ARM, interval=(0.1, 0.1)), "velocity is missing"),
        (lambda: certify_globally(models.oscillator(), velocity=1.0, interval=(0.1, 0.1)), "has no limits"),
        (lambda: certify_globally(observers.ModelCopy(ARM, 1.0, 1.0), velocity=1.0, interval=(0.1, 0.1)), "ModelCopy"),
        (
            lambda: certify_globally(MeasuredCoefficients(ARM, 30.0, 400.0, 2.0), velocity=1.0, interval=(0.1, 0.1)),
            "differs from the speed",
        ),
    ],
)
def test_what_is_not_covered_is_refused(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()
