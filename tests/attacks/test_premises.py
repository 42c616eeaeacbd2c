"""A verdict is never better than its premises: each test takes one premise away from a statement that held."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import io_callback
from systems import linear

from covariant import models
from covariant.certificates import cascade, certify, decay, falsify, observability, virtual
from covariant.certificates.base import ErrorSystem, StateMetric, in_coordinates
from covariant.certificates.base._error_system import Point
from covariant.certificates.theory import detectability_rate
from covariant.models import StateSpace
from covariant.observers import Contracting, Intrinsic
from scalargraph.proofs import Box, prove_at_corners

REGION = {"velocity": 1.0, "error": 0.1, "position": (-0.5, 0.5), "rate": 1.0}


def box(**ends) -> Box:
    low, high = np.array(list(ends.values()), float).T
    return Box(tuple(ends), ("",) * len(ends), low, high)


# The flow that runs is the flow that is certified.


class Backwards(Intrinsic):
    """Corrects away from the measurement."""

    def _correction(self, *arguments):
        return -super()._correction(*arguments)


class Renamed(Intrinsic):
    """The same observer under another name: what a subclass runs is not read."""


@pytest.mark.parametrize("kind", [Backwards, Renamed])
@pytest.mark.parametrize("model", [models.free_body(), models.ball_and_beam()])
def test_a_subclass_may_run_another_flow_and_is_refused(kind, model):
    n = len(model.coordinates or model.velocities)
    bounds = {} if not model.coordinates else {"position": (-0.1 * np.ones(n), 0.1 * np.ones(n))}
    with pytest.raises(TypeError, match=f"flows of Intrinsic and Geodesic themselves; got {kind.__name__}"):
        certify(kind(model, 10.0, 50.0), velocity=0.1, error=0.01, **bounds)


# Friction is a function, and what is left out of it is finite.


def rubbed(friction):
    return Intrinsic(
        models.Lagrangian(lambda q: jnp.eye(1), lambda q: q[0] ** 2, dissipation=friction, coordinates=("q",)), 2.0, 2.0
    )


WIDE = {"velocity": 1.0, "error": 0.1, "position": (-1.0, 1.0)}
NUMBER = jax.ShapeDtypeStruct((1,), jnp.float64)
CALLS = {
    "io_callback": lambda q, v: -v + 0 * io_callback(lambda: np.zeros(1), NUMBER),
    "pure_callback": lambda q, v: -v + jax.pure_callback(lambda: np.zeros(1), NUMBER),
    "io_callback of a known number": lambda q, v: -v * io_callback(lambda x: x, NUMBER, jnp.ones(1)),
    "pure_callback in a loop": lambda q, v: jax.lax.fori_loop(
        0, 2, lambda i, w: w - v * jax.pure_callback(lambda: np.ones(1), NUMBER), 0 * v
    ),
    "debug_print": lambda q, v: (jax.debug.print("here"), -v)[1],
}


@pytest.mark.core(2)
@pytest.mark.parametrize("name", CALLS)
def test_a_call_of_python_is_refused_with_known_arguments_too(name):
    with pytest.raises(NotImplementedError, match=r"'(io_callback|pure_callback|debug_\w+)' has no graph"):
        certify(rubbed(CALLS[name]), **WIDE)


OVERFLOWS = {
    "a product with nought": lambda q, v: -v + 0 * jnp.exp(800 * q),
    "is it finite": lambda q, v: jnp.where(jnp.isfinite(jnp.exp(800 * q)), -v, 100 * v),
    "a difference with itself": lambda q, v: -v + (jnp.exp(800 * q) - jnp.exp(800 * q)),
    "added and taken away": lambda q, v: (jnp.exp(800 * q) - v) - jnp.exp(800 * q),
    "nought by it": lambda q, v: -v + 0 / jnp.exp(800 * q) * jnp.exp(800 * q),
    "does it equal itself": lambda q, v: (
        jnp.where(jnp.exp(800 * q) * 2 == jnp.exp(800 * q) * 2, -v, 100 * v) * 1.0 + 0 * jnp.exp(800 * q)
    ),
    "a cosh": lambda q, v: -v + 0 * jnp.cosh(900 * q),
    "a power": lambda q, v: -v + 0 * (1e200 * q) ** 2,
}


@pytest.mark.core(2)
@pytest.mark.parametrize("name", OVERFLOWS)
def test_what_is_left_out_of_a_proof_must_stay_finite(name):
    found = certify(rubbed(OVERFLOWS[name]), **WIDE)
    assert found.statement.verdict == "undecided"
    assert "stay below 1e+150" in found.statement.claim or "not shown to be defined" in found.statement.claim


# Time.


def pushed(force):
    return Intrinsic(
        models.Lagrangian(lambda q: jnp.eye(1), lambda q: 0.0, force=force, coordinates=("q",)), 10.0, 50.0
    )


@pytest.mark.parametrize(
    "force",
    [
        lambda t, q, u: u + t,
        lambda t, q, u: u * jnp.sin(t),
        lambda t, q, u: jnp.where(t > 1.0, u + 1e3, u),
        lambda t, q, u: u + 0.0 * jnp.sqrt(t - 1.0),
    ],
)
def test_a_force_that_depends_on_time_needs_times(force):
    with pytest.raises(ValueError, match=r"depends on time; give times=\(first, last\)"):
        certify(pushed(force), **REGION)


# Corners.

BENT = {
    "abs": lambda z: jnp.abs(z[0]) - 0.5,
    "max": lambda z: jnp.maximum(z[0], -z[0]) - 0.5,
    "min": lambda z: -jnp.minimum(z[0], -z[0]) - 0.5,
    "a choice": lambda z: jnp.where(z[0] < 0, -z[0], z[0]) - 0.5,
    "sign": lambda z: z[0] * jnp.sign(z[0]) - 0.5,
    "the other variable's": lambda z: jnp.abs(z[0] + z[1]) - 0.5,
    "a step": lambda z: 0.5 + jnp.floor(z[0] + 0.25) * (1.0 - z[0]),
}


@pytest.mark.parametrize("name", BENT)
def test_what_has_a_kink_is_not_affine(name):
    domain = box(a=(-1.0, 1.0), b=(0.0, 0.01))
    with pytest.raises(ValueError, match="not affine"):
        prove_at_corners(lambda z: BENT[name](z)[None, None], domain, ["a"])


def test_a_kink_in_other_variables_does_no_harm():
    domain = box(a=(-1.0, 1.0), b=(-1.0, 1.0))
    found = prove_at_corners(lambda z: (2.0 + z[0] + jnp.abs(z[1]))[None, None], domain, ["a"])
    assert all(proof.verdict == "holds" for proof in found)


# Cascades.


def coupled(plant=(-1.0, 1.0), error=(-1.0, 1.0), regions=((0.0, 1.0), (0.0, 1.0)), **options):
    """Scalar systems e' = a e with V = ½ p e², x̃' = b x̃ with m x̃², coupled by b = x̃."""
    systems = [linear([[rate]], [[form]]) for rate, form in (plant, error)]

    def coupling(z):
        return jnp.ones((1, 1)), jnp.zeros((1, 1))

    first, second = (box(d=ends) for ends in regions)
    return cascade((systems[0], first), (systems[1], second), (coupling, box(k=(0.0, 1.0))), **options)


@pytest.mark.parametrize("proved", [False, True])
def test_the_cascade_holds_while_its_premises_do(proved):
    found = coupled(proved=proved)
    assert found.verdict == "holds"
    assert found.constants.m1 == pytest.approx(1.0, rel=0.03)


@pytest.mark.core(3)
@pytest.mark.parametrize("proved", [False, True])
@pytest.mark.parametrize(
    ("what", "systems"),
    [
        ("an unstable observer with a negative metric", {"error": (1.0, -1.0)}),
        ("an unstable plant with a negative metric", {"plant": (1.0, -1.0)}),
        ("an observer with the metric zero", {"error": (1.0, 0.0)}),
        ("a plant with a metric that is zero", {"plant": (1.0, 0.0)}),
    ],
)
def test_a_metric_that_is_not_positive_proves_nothing(proved, what, systems):
    found = coupled(proved=proved, **systems)
    assert found.verdict != "holds"
    assert not found.printed
    assert re.search(r"- undecided: V_\w+ is positive definite", str(found)) or not found.constants.lambda_q > 0


@pytest.mark.parametrize(
    ("systems", "premise"),
    [
        ({"plant": (0.5, 1.0)}, "the controlled plant alone is stable, c3 > 0"),
        ({"error": (0.0, 1.0)}, "the observer's error shrinks, λ_q > 0"),
        ({"error": (0.5, 1.0)}, "the observer's error shrinks, λ_q > 0"),
    ],
)
def test_a_cascade_names_the_premise_that_is_missing(systems, premise):
    found = coupled(**systems).statement
    assert found.verdict != "holds"
    assert next(h for h in found.hypotheses if h.text == premise).verdict != "holds"


def test_a_coupling_whose_bound_is_not_proved_leaves_a_cascade_open():
    steep = (lambda z: (jnp.tan(1.5 * z[:1, None]) * jnp.sin(40 * z[0]), jnp.zeros((1, 1))), box(k=(0.0, 1.0)))
    stable = linear([[-1.0]], [[1.0]]), box(d=(0.0, 1.0))
    found = cascade(stable, stable, steep, proved=True, boxes=3).statement
    open_ones = [premise.text for premise in found.hypotheses if premise.verdict != "holds"]
    assert open_ones == ["the coupling with the observer's error is bounded, γ1"]
    assert cascade(stable, stable, steep, proved=True, boxes=300).statement.verdict == "holds"


def drifting(rate, form) -> ErrorSystem:
    """The system x' = a(t) x with the metric p(t)."""

    def at(z):
        metric: StateMetric = in_coordinates(lambda t, x: form(t) * jnp.eye(1))
        return Point(lambda t, x: rate(t) * x + 0.0 * z[0], metric, jnp.zeros(1))

    return ErrorSystem(("d",), ("",), at)


DRIFTS = {
    "a flow that grows unstable": (lambda t: -1 + 3 * t, lambda t: 1.0),
    "a metric that vanishes": (lambda t: 0.5 + 0 * t, lambda t: jnp.exp(-3 * t)),
}


@pytest.mark.parametrize("name", DRIFTS)
def test_what_depends_on_time_is_not_judged_by_one_instant(name):
    system, steady = drifting(*DRIFTS[name]), linear([[-1.0]], [[1.0]])
    one, jacobians = box(d=(0.0, 1.0)), (lambda z: (jnp.ones((1, 1)), jnp.zeros((1, 1))), box(k=(0.0, 1.0)))
    for systems in ((system, steady), (steady, system)):
        with pytest.raises(ValueError, match="cascade: the flow or the metric depends on time"):
            cascade(*((each, one) for each in systems), jacobians)
    with pytest.raises(ValueError, match="falsify: the flow or the metric depends on time"):
        falsify(system, one, 1.0)


def test_a_measurement_may_move_and_a_model_may_not_change():
    for drift, refused in ((0.0, False), (3.0, True)):
        model = StateSpace(
            lambda t, x, u, drift=drift: (-1 + drift * t) * x, lambda t, x, u: x, coordinates=("a",), outputs=("a",)
        )
        moving = virtual(Contracting(model, jnp.eye(1), jnp.zeros(1)), lambda z, x: jnp.eye(1) * (2 + jnp.sin(z[0])))
        region = Box(moving.names, moving.units, -np.ones(3), np.ones(3))
        if refused:
            with pytest.raises(ValueError, match="depends on time"):
                falsify(moving, region, 0.1)
        else:
            assert falsify(moving, region, 0.1).verdict == "holds"


def test_the_sets_of_a_cascade_must_be_one():
    with pytest.raises(ValueError, match=r"d is in \[0, 1\] in one box and in \[0, 2\] in another"):
        coupled(regions=((0.0, 1.0), (0.0, 2.0)))


# Observability.


def outputs(h, f=lambda x: -x, n=2):
    return StateSpace(lambda t, x, u: f(x), lambda t, x, u: h(x), coordinates=tuple(f"x{k}" for k in range(n)))


def flat(x):
    return jnp.eye(x.shape[0])


UNSTABLE = {"f": lambda x: jnp.stack([-x[0], 3.0 * x[1]])}
DEPENDENT = {
    "two encoders on one joint": lambda x: jnp.stack([x[0], x[0]]),
    "one encoder through a gear": lambda x: jnp.stack([x[0], 7.0 * x[0]]),
    "a square that is flat there": lambda x: jnp.stack([x[0], x[1] ** 2]),
    "a dead channel": lambda x: jnp.stack([x[0], jnp.zeros(())]),
}


@pytest.mark.parametrize("name", DEPENDENT)
def test_outputs_that_follow_from_others_see_fewer_directions(name):
    system = outputs(DEPENDENT[name], **UNSTABLE)
    at = np.array([[0.3, 0.0]])
    with pytest.raises(ValueError, match=r"dh has rank 1 at \(0.3, 0\), below the number of outputs, 2"):
        observability(system, flat, at)
    assert detectability_rate(system, flat, jnp.asarray(at[0])) == -np.inf


NO_METRIC = r"the metric is not positive definite at \(0, 0\)"
THREE = outputs(lambda x: jnp.stack([x[0], x[1], x[0] + x[1]]))


@pytest.mark.parametrize(
    ("system", "metric", "points", "message"),
    [
        (outputs(lambda x: x[:1]), lambda x: jnp.diag(jnp.array([1.0, -1.0])), np.zeros((1, 2)), NO_METRIC),
        (outputs(lambda x: x), lambda x: jnp.full((2, 2), jnp.nan), np.zeros((1, 2)), NO_METRIC),
        (outputs(lambda x: x[:1]), flat, np.zeros((0, 2)), "at least one"),
        (outputs(lambda x: x[:1]), flat, np.array([[np.nan, 0.0]]), "points must be a finite number"),
        (THREE, flat, np.zeros((1, 2)), r"dh has rank 2 .* below the number of outputs, 3"),
    ],
)
def test_a_metric_that_is_none_and_no_points_are_refused(system, metric, points, message):
    with pytest.raises(ValueError, match=message):
        observability(system, metric, points)


def test_the_sentence_says_that_states_were_sampled():
    found = observability(outputs(lambda x: x[:1]), flat, np.zeros((1, 2)))
    assert found.verdict.endswith("as sampled at the state (0, 0)")


@pytest.mark.exhaustive("saddle")
@pytest.mark.long("mixed")
@pytest.mark.parametrize(
    ("h", "evidence", "hidden"),
    [
        (lambda x: x[:1], "proved", "x1"),
        (lambda x: jnp.stack([x[0] + 0.3 * x[1] ** 2]), "proved", "1 among x0, x1"),
        (lambda x: x, "proved", "none"),
        # Its Jacobian vanishes at the origin, between the points and at none of them.
        (lambda x: jnp.stack([x[0] * x[1]]), "sampled", "1 among x0, x1"),
    ],
    ids=["coordinate", "mixed", "all", "saddle"],
)
def test_independent_outputs_are_proved_between_the_points_or_said_to_be_sampled(h, evidence, hidden):
    at = np.array([[-0.5, -0.4], [0.6, 0.3], [0.3, -0.2]])
    found = observability(outputs(h), flat, at).condition_1
    (rank,) = (premise for premise in found.hypotheses if "rows of dh" in premise.text)
    assert rank.evidence == evidence
    assert ("-0.5 ≤ x0 ≤ 0.6" in rank.text) == (evidence == "proved")
    assert found.about[1] == f"directions that the output does not see: {hidden}"


# Decay.

STILL = (lambda t, x: -x, in_coordinates(lambda t, x: jnp.eye(1)))


@pytest.mark.long("t5")
@pytest.mark.parametrize(
    ("x0", "x1", "t", "what"),
    [
        ([[1.0]], [[2.0]], [1.0, 0.5, 0.0], "each later"),
        ([[1.0]], [[2.0]], [0.0, 0.0], "each later"),
        ([[1.0]], [[2.0]], [0.0], "at least two stamps"),
        ([[1.0]], [[2.0]], [0.0, np.nan], "t must be a finite number"),
        (np.zeros((0, 1)), np.zeros((0, 1)), [0.0, 1.0], "at least one"),
        ([[1.0]], [[1.0]], [0.0, 1.0], "pair 1 has no positive distance"),
    ],
)
def test_decay_needs_pairs_that_differ_and_rising_stamps(x0, x1, t, what):
    with pytest.raises(ValueError, match=what):
        decay(*STILL, 1.0, jnp.asarray(x0), jnp.asarray(x1), jnp.asarray(t))
