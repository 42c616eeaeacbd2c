"""What the prover proves, what it rejects, and that it would notice if it were wrong."""

import functools
import math
import tomllib
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import (
    ErrorSystem,
    Statement,
    certify,
    contraction,
    contraction_matrix,
    error_system,
    falsify,
    in_coordinates,
    lyapunov,
    rate_of,
    tangent_metric,
)
from covariant.certificates.base._error_system import Point
from covariant.certificates.base._region import _inputs
from covariant.geometry import hyperbolic
from covariant.observers import Intrinsic
from covariant.papers._errata import PrintedBallAndBeam
from covariant.proofs import Box, _judge, _prove, box, prove

ALPHA, BETA = math.sqrt(2), 0.5
PAPER = lyapunov(ALPHA, BETA)
ZERO = jnp.zeros(())


@functools.cache
def hyperbolic_plane():
    return models.Lagrangian(hyperbolic(), lambda q: jnp.zeros(()), coordinates=("x", "y"), units=("", ""))


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


@pytest.mark.exhaustive
def test_the_observer_of_the_paper_is_proved_and_its_spoiled_forms_are_not():
    about, region = ball_and_beam_region(1.0)
    found = prove(contraction(about, 0.2), region)
    assert found.verdict == "holds"
    assert found.seconds < 60
    assert prove(contraction(about, 0.3853), region).verdict == "fails"
    spoiled = error_system(Intrinsic(models.ball_and_beam(), ALPHA, BETA, curvature=False), PAPER)
    assert prove(contraction(spoiled, 0.01), region).verdict == "fails"


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
        _inputs(models.ball_and_beam(), (1.0, 2.0, 3.0), 2)
    with pytest.raises(ValueError, match="must be finite, the lower one first"):
        box(x=(1.0, 0.0))


@pytest.mark.exhaustive
def test_worker_processes_find_the_same_tree(monkeypatch):
    about, region = ball_and_beam_region(1.5, 0.01, 0.2)
    alone = prove(contraction(about, 0.2), region)
    monkeypatch.setattr(_prove, "PATIENCE", 0)
    shared = prove(contraction(about, 0.2), region, processes=2)
    assert alone.verdict == shared.verdict == "holds"
    assert [level.tolist() for level in alone.levels] == [level.tolist() for level in shared.levels]


def hole(z):
    """Positive but for a hole a thousandth wide, which no sample falls into."""
    return jnp.reshape(1 - 1.001 * jnp.exp(-(((z[0] - 0.31234567) / 3e-5) ** 2)), (1, 1))


PROVER = SimpleNamespace(enclose=_judge.enclose, definite=_judge.definite)
BLIND = {
    "without remainders": (
        "enclose",
        lambda lowered, a, b, engine: PROVER.enclose(lowered, *[(a + b) / 2] * 2, engine),
    ),
    "without widths": ("definite", lambda middle, radius, terms=None: PROVER.definite(middle, 0 * radius)),
}


@pytest.mark.parametrize("name", BLIND)
def test_a_narrow_hole_is_found_and_a_prover_that_is_blind_would_miss_it(name, monkeypatch):
    domain = box(z=(0.0, 1.0))
    assert prove(hole, domain).verdict != "holds"
    monkeypatch.setattr(_judge, *BLIND[name])
    assert prove(hole, domain, engine="numpy").verdict == "holds"


def test_where_nothing_is_bounded_the_middle_of_a_box_says_which_variable_to_halve():
    """Only x matters, at whose zero there is a kink; the slope in y, none in the middle, is steep at the border."""

    def matrix(z):
        return jnp.reshape(1 + jnp.abs(z[0]) - 0.99 * z[0] + z[1] ** 4 / 10, (1, 1))

    found = prove(matrix, box(x=(-1.0, 3.0), y=(-1.0, 1.0)))
    assert found.verdict == "holds"
    assert [level.tolist() for level in found.levels] == [[0], [-1, -1]]


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
