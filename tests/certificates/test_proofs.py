"""What the prover proves, what it rejects, and that it would notice if it were wrong."""

import math
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import certify, contraction, error_system, lyapunov, tangent_metric
from covariant.certificates.base import ErrorSystem, contraction_matrix, in_coordinates
from covariant.certificates.base._error_system import Point
from covariant.certificates.base._region import _inputs
from covariant.observers import Intrinsic
from covariant.papers._errata import PrintedBallAndBeam
from scalargraph.proofs import Box, _judge, box, prove

ALPHA, BETA = math.sqrt(2), 0.5
PAPER = lyapunov(ALPHA, BETA)
ZERO = jnp.zeros(())


def test_matrices_that_are_and_are_not_definite():
    def disc(z):
        return jnp.array([[1.0, 0.0], [0.0, 1.0]]) * (1 - z @ z) + jnp.outer(z, z)

    inside, outside = box(x=(-0.6, 0.6), y=(-0.6, 0.6)), box(x=(-0.6, 0.6), y=(-0.6, 1.2))
    assert prove(disc, inside).verdict == "holds"
    wrong = prove(disc, outside)
    assert wrong.verdict == "fails"
    assert np.linalg.eigvalsh(np.asarray(disc(jnp.asarray(wrong.counterexample[0]))))[0] < 0


def test_a_box_is_told_with_both_its_bounds():
    assert str(box(x=(-1.0, 2.0, "m"), y=(0.0, 0.5))) == "-1 ≤ x ≤ 2 m, 0 ≤ y ≤ 0.5"


@pytest.mark.core(1)
@pytest.mark.parametrize("small", [-1e-17, 0.0, -1e-300])
def test_an_eigenvalue_that_is_not_positive_is_never_proved(small):
    def turned(z):
        c, s = jnp.cos(z[0]), jnp.sin(z[0])
        r = jnp.array([[1.0, 0.0], [0.0, 1.0]]) * c + jnp.array([[0.0, -1.0], [1.0, 0.0]]) * s
        return r @ jnp.diag(jnp.array([1.0, small])) @ r.T

    for matrix in (turned, lambda z: jnp.diag(jnp.array([1.0, small]))):
        assert prove(matrix, box(angle=(0.2, 1.0)), boxes=2000).verdict != "holds"


def margin_of(flow, metric, rate=0.0):
    """`z -> −(condition) − rate M` for flows in the plane or on the line, with time the last variable."""

    def matrix(z):
        t, x = z[-1], z[:-1]
        return -contraction_matrix(flow, metric, t, x) - rate * metric.gram(t, x)

    return matrix


def flat(t, x):
    return jnp.eye(x.shape[0])


@pytest.mark.long("cubic")
@pytest.mark.parametrize(
    ("flow", "metric", "state"),
    [
        (lambda t, x: -(x**3), flat, 1),
        (lambda t, x: -jnp.abs(x) * x, flat, 1),
        (lambda t, x: jnp.stack([-x[1], x[0]]), lambda t, x: jnp.exp(t) * jnp.eye(2), 2),
        (lambda t, x: -x, lambda t, x: jnp.exp(3 * t) * jnp.eye(1), 1),
    ],
    ids=["cubic", "quadratic damping at rest", "rotation in a growing metric", "growing frame"],
)
def test_flows_that_do_not_contract_are_not_proved(flow, metric, state):
    names = [*"abc"[:state], "t"]
    domain = box(**dict.fromkeys(names[:-1], (-1.0, 1.0)), t=(0.0, 1.0))
    assert prove(margin_of(flow, in_coordinates(metric)), domain, boxes=2000).verdict != "holds"


def test_the_same_flows_are_proved_where_they_do():
    domain = box(x=(0.5, 2.0), t=(0.0, 1.0))
    for flow, rate in ((lambda t, x: -(x**3), 1.49), (lambda t, x: -jnp.abs(x) * x, 1.99)):
        assert prove(margin_of(flow, in_coordinates(flat), rate), domain).verdict == "holds"
        assert prove(margin_of(flow, in_coordinates(flat), rate + 0.02), domain).verdict == "fails"


@pytest.mark.parametrize(
    "step", [lambda t, x: jnp.where(x > 0, 1.0, -1.0), lambda t, x: jnp.where(t < 0, x, -x), lambda t, x: jnp.abs(x)]
)
def test_a_jump_at_a_variable_that_is_held_fixed_is_one_all_the_same(step):
    """The state and the time are not boxed here, but zero; what jumps or has a kink at zero does so there."""

    def about(flow):
        metric = in_coordinates(lambda t, x: jnp.eye(1))
        return ErrorSystem(("z",), ("",), lambda z: Point(flow, metric, jnp.zeros(1)))

    smooth = prove(contraction(about(lambda t, x: -0.9 * x), 1.0), box(z=(0.0, 1.0)))
    assert (smooth.verdict, smooth.reason) == ("holds", "")
    assert prove(contraction(about(lambda t, x: -0.9 * x + step(t, x)), 1.0), box(z=(0.0, 1.0))).verdict != "holds"


def ball_and_beam_region(velocity, error=0.005, force=0.1):
    high = np.array([0.3, 0.5, velocity, velocity, error, error, force, force])
    about = error_system(Intrinsic(models.ball_and_beam(), ALPHA, BETA), PAPER)
    return about, Box(about.names, about.units, -high, high)


@pytest.mark.parametrize(("sign", "verdict"), [(-1, "holds"), (1, "fails")])
def test_the_printed_ball_and_beam_is_rejected_and_the_corrected_one_proved(sign, verdict):
    metric, observer = tangent_metric(models.ball_and_beam().metric, PAPER), PrintedBallAndBeam(ALPHA, BETA, sign)

    def matrix(z):
        place, velocity, error, force = jnp.split(z, 4)

        def flow(t, x):
            state = observer.init(x[:2])._replace(q=x[:2], v=x[2:], t=t)
            change = observer.flow(t, state, force[1:], place - error)
            return jnp.concatenate([change.q, change.v])

        x = jnp.concatenate([place, velocity])
        return -contraction_matrix(flow, metric, ZERO, x) - 0.05 * metric.gram(ZERO, x)

    _, region = ball_and_beam_region(1.0)
    assert prove(matrix, region).verdict == verdict


BEAM_BOUNDS = {"velocity": 1.0, "error": 0.01, "position": (-0.1, 0.1)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        *(({"velocity": bad}, "velocity must be a positive, finite bound") for bad in (math.inf, -1.0, math.nan, 0.0)),
        ({"position": None}, "position needs bounds of r, theta"),
        ({"input": np.array([1.0, 2.0])}, "input needs one bound, or 1"),
        ({"error": np.full(3, 0.1)}, "error needs one number, or 2"),
    ],
    ids=str,
)
def test_a_certificate_needs_its_bounds(change, message):
    with pytest.raises(ValueError, match=message):
        certify(Intrinsic(models.ball_and_beam(), ALPHA, BETA), **BEAM_BOUNDS | change)


def test_other_bounds_that_are_none_are_refused():
    with pytest.raises(ValueError, match="a pair of bounds, lower and upper; got 3 entries"):
        _inputs((1.0, 2.0, 3.0), 1)
    with pytest.raises(ValueError, match="must be finite, the lower one first"):
        box(x=(1.0, 0.0))


def hole(z):
    """Positive but for a hole a thousandth wide, which no sample falls into."""
    return jnp.reshape(1 - 1.001 * jnp.exp(-(((z[0] - 0.31234567) / 3e-5) ** 2)), (1, 1))


PROVER = SimpleNamespace(polynomials=_judge.polynomials, definite=_judge.definite)
BLIND = {
    "without remainders": (
        "polynomials",
        lambda graph, a, b, free: PROVER.polynomials(graph, *[(a + b) / 2] * 2, free),
    ),
    "without widths": ("definite", lambda middle, radius, terms: PROVER.definite(middle, 0 * radius, 0 * terms)),
}


@pytest.mark.parametrize("name", BLIND)
def test_a_narrow_hole_is_found_and_a_prover_that_is_blind_would_miss_it(name, monkeypatch):
    domain = box(z=(0.0, 1.0))
    assert prove(hole, domain).verdict != "holds"
    monkeypatch.setattr(_judge, *BLIND[name])
    assert prove(hole, domain).verdict == "holds"


def test_a_box_with_a_kink_is_halved_across_the_variable_of_the_kink():
    """Only x matters, at whose zero there is a kink; the slope in y, none in the middle, is steep at the border."""

    def matrix(z):
        return jnp.reshape(1 + jnp.abs(z[0]) - 0.99 * z[0] + z[1] ** 4 / 10, (1, 1))

    found = prove(matrix, box(x=(-1.0, 3.0), y=(-1.0, 1.0)))
    assert found.verdict == "holds"
    halved = np.concatenate(found.levels)
    assert set(halved[halved >= 0]) == {0}
