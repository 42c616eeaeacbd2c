"""Virtual systems, metrics from linear matrix inequalities, and Theorem 3 with its dependence on units."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import cascade, common_metric, contraction, falsify, observer_gain, virtual
from covariant.certificates.base import ErrorSystem, StateMetric, in_coordinates
from covariant.certificates.base._error_system import Point
from covariant.certificates.theory import Constants
from covariant.certificates.theory._cascade import _constants, _forms, _Search
from covariant.observers import Contracting
from covariant.papers.jouffroy_fossen import COUNTEREXAMPLES, Scalar
from scalargraph.errors import InputError
from scalargraph.proofs import Box, blocks, box, prove, prove_at_corners

ZERO = jnp.zeros(())


# Theorem 2


@pytest.mark.parametrize("name", COUNTEREXAMPLES)
def test_print_of_theorem_2_says_the_opposite_of_what_happens(name):
    case = COUNTEREXAMPLES[name]
    assert (case.printed < 0) != (case.true < 0)
    observer = case.observer()
    x, estimate, u = jnp.array([1.0]), jnp.array([0.5]), jnp.array([0.5 * case.g])
    state = observer.init(x)._replace(x=estimate)
    error = x - estimate
    rate = observer.model.f(ZERO, x, u) - observer.flow(ZERO, state, u, x).x
    np.testing.assert_allclose(rate, case.true * error)  # the closed loop, u = gx̂, does what the virtual system says
    assert case.proof(0.1).verdict == ("holds" if case.true < 0 else "fails")


def test_virtual_system_proves_up_to_its_rate_and_no_further():
    slow = Scalar(-1.0, 1.0, 5.0, 0.5)  # squared lengths shrink at 2 · 1.5
    assert slow.proof(2.999).verdict == "holds"
    assert slow.proof(3.001).verdict == "fails"


def test_metric_that_follows_the_measurement_counts_its_change():
    """x' = 0 with M = e^z: where z falls at 1, squared lengths do; a metric without its Ṁ would see nothing."""
    model = models.StateSpace(lambda t, x, u: 0.0 * x, lambda t, x, u: x, coordinates=("x",))
    still = Contracting(model, jnp.zeros((1, 1)), jnp.zeros(1))
    error_system = virtual(still, lambda z, x: jnp.exp(z)[:, None])

    def region(change):
        return Box(error_system.names, error_system.units, np.array([-1.0, -1.0, change]), np.array([1.0, 1.0, change]))

    assert prove(contraction(error_system, 0.9), region(-1.0)).verdict == "holds"
    assert prove(contraction(error_system, 1.1), region(-1.0)).verdict == "fails"
    assert prove(contraction(error_system, 0.0), region(1.0)).verdict == "fails"


# Proofs of parts


def quartered(z):
    """Blocks {0, 2} and {1}, affine in a and b together, curved in c."""
    a, b, c = z
    zero = jnp.zeros_like(a)
    return jnp.stack(
        [
            jnp.stack([2.0 + a, zero, c]),
            jnp.stack([zero, 1.5 - b + c**2, zero]),
            jnp.stack([c, zero, 2.0 + a + b]),
        ]
    )


def test_blocks_are_found_from_zeros_of_the_graph():
    region = box(a=(-0.5, 0.5), b=(-1.0, 1.0), c=(-0.5, 0.5))
    assert sorted(part.tolist() for part in blocks(quartered, region)) == [[0, 2], [1]]


def test_corners_of_affine_variables_stand_for_their_box():
    region = box(a=(-0.5, 0.5), b=(-1.0, 1.0), c=(-0.5, 0.5))
    proofs = prove_at_corners(quartered, region, ("a", "b"))
    assert [proof.verdict for proof in proofs] == ["holds"] * 4
    assert prove(quartered, region).verdict == "holds"
    wider = box(a=(-0.5, 0.5), b=(-1.6, 1.6), c=(-0.5, 0.5))
    assert prove_at_corners(quartered, wider, ("a", "b"))[-1].verdict == "fails"
    unmoved = prove_at_corners(lambda z: quartered(z)[1:2, 1:2], region, ("a", "b"))
    assert len(unmoved) == 2  # a does not enter
    with pytest.raises(ValueError, match="not affine in a, c together"):
        prove_at_corners(lambda z: jnp.eye(2) * (2.0 + z[0] * z[2]), region, ("a", "c"))
    with pytest.raises(ValueError, match="no variable 'd'"):
        prove_at_corners(quartered, region, ("d",))


# Metrics and gains


def test_common_metric_serves_all_jacobians():
    f = np.array([[[-1.0, 4.0], [0.0, -1.0]], [[-1.0, 0.0], [-0.3, -2.0]]])
    design = common_metric(f, 0.5)
    for jacobian in f:
        change = jacobian.T @ design.metric + design.metric @ jacobian + 0.5 * design.metric
        assert np.linalg.eigvalsh(change)[-1] < 1e-6
    values = np.linalg.eigvalsh(design.metric)
    assert values[0] > 1 - 1e-6
    np.testing.assert_allclose(values[-1] / values[0], design.conditioning, rtol=1e-4)
    assert design.gain.shape == (2, 0)


def test_common_metric_is_the_best_conditioned_one():
    """Scaled shear: the best diagonal metric is known, and no random metric of less conditioning serves."""
    f = np.array([[-1.0, 4.0], [0.0, -1.0]])
    best = common_metric(f, 0.0)
    random = np.random.default_rng(0)
    for _ in range(2000):
        root = random.normal(size=(2, 2))
        m = root @ root.T
        values = np.linalg.eigvalsh(m)
        if values[-1] / values[0] < 0.99 * best.conditioning:
            assert np.linalg.eigvalsh(f.T @ m + m @ f)[-1] > 0


def test_gain_from_vertices_is_proved_on_the_whole_polytope():
    """A pendulum: cos q runs over [−1, 1], so two Jacobians span all of them, and a box proves it."""
    model = models.StateSpace(
        lambda t, x, u: jnp.stack([x[1], -4.0 * jnp.sin(x[0]) + u[0]]),
        lambda t, x, u: x[:1],
        coordinates=("q", "v"),
        inputs=1,
        circles=(0,),
    )
    slopes, outputs = (
        jax.vmap(jax.jacfwd(lambda x, g=g: g(0.0, x, jnp.zeros(1))))(jnp.array([[0.0, 0.0], [math.pi, 0.0]]))
        for g in (model.f, model.h)
    )
    design = observer_gain(slopes, outputs, 2.0)
    observer = Contracting(model, jnp.asarray(design.gain), jnp.zeros(2))
    error_system = virtual(observer, design.metric)
    high = np.array([math.pi, 10.0, 1.0, math.pi, 1.0])
    region = Box(error_system.names, error_system.units, -high, high)
    assert prove(contraction(error_system, 1.99), region).verdict == "holds"
    weak = Contracting(model, jnp.asarray(0.2 * design.gain), jnp.zeros(2))
    assert falsify(virtual(weak, design.metric), region, 1.99).verdict == "fails"


NAMELESS = models.StateSpace(lambda t, x, u: -x, lambda t, x, u: x)


@pytest.mark.parametrize(
    ("design", "message"),
    [
        (lambda: virtual(Contracting(NAMELESS, jnp.eye(1), jnp.zeros(1)), np.eye(1)), "states need names"),
        (
            lambda: common_metric(-np.eye(2), 3.0),
            "no constant metric makes 1 Jacobian contract at 3 1/s; lower the rate",
        ),
        (lambda: observer_gain(-np.eye(2), np.ones((1, 3)), 1.0), r"outputs must have the shape \(1, p, 2\)"),
    ],
)
def test_designs_that_cannot_be_are_refused(design, message):
    with pytest.raises(ValueError, match=message):
        design()


def test_the_domain_of_a_design_counts_its_jacobians():
    pair, matrix = (-np.eye(2), np.ones((1, 2))), -np.eye(2)
    for design, words in (
        (observer_gain(*pair, 1.0), "1 pair of Jacobians"),
        (observer_gain(*([each] * 2 for each in pair), 1.0), "2 pairs of Jacobians"),
        (common_metric(matrix, 1.0), "1 Jacobian"),
        (common_metric([matrix] * 3, 1.0), "3 Jacobians"),
    ):
        assert design.statement.domain == f"the hull of {words}"


# Theorem 3


def linear(matrix, form, names):
    """A linear error system with a constant metric, over variables that do not enter but one: its damping."""
    n = len(matrix)

    def at(z):
        f = jnp.asarray(matrix) - z[0] * jnp.eye(n)
        metric: StateMetric = in_coordinates(lambda t, x: jnp.asarray(form))
        return Point(lambda t, x: f @ x, metric, jnp.zeros(n))

    return ErrorSystem(names, ("",), at)


def built(gain=1.0, more=0.0, spread=(0.0, 1.0), **options):
    a, p = np.array([[-1.0, 2.0], [-2.0, -3.0]]), np.diag([4.0, 1.0])
    plant = linear(a, p, ("d",))
    error = linear(np.array([[-2.0, 0.0], [0.0, -1.0]]), np.eye(2), ("d",))
    matrix = gain * np.array([[0.0, 0.0], [1.0, 0.5]])

    def coupling(z):
        return jnp.asarray(matrix) * z[0], jnp.full((2, 2), more)

    region = box(d=spread)
    return cascade((plant, region), (error, region), (coupling, box(k=(0.5, 2.0))), **options)


def test_parts_of_other_plants_are_refused():
    small, large = ((linear(-np.eye(n), np.eye(n), ("d",)), box(d=(0.0, 1.0))) for n in (1, 2))
    coupling = (lambda z: (jnp.zeros((2, 1)), jnp.zeros((2, 2)))), box(k=(0.0, 1.0))
    with pytest.raises(InputError, match="e of the coupling has the size 2, and that of the controller 1"):
        cascade(small, small, coupling)
    with pytest.raises(InputError, match="x̃ of the coupling has the size 1, and that of the observer 2"):
        cascade(large, large, coupling)


def test_constants_are_those_of_the_closed_form():
    found = built()
    a, p = np.array([[-1.0, 2.0], [-2.0, -3.0]]), np.diag([4.0, 1.0])
    c = found.constants
    np.testing.assert_allclose([c.c1, c.c2, c.c4], [0.5, 2.0, 4.0], rtol=1e-9)
    np.testing.assert_allclose(c.c3, np.linalg.eigvalsh(-(p @ a + a.T @ p) / 2)[0], rtol=1e-9)
    np.testing.assert_allclose(c.lambda_q, 2.0, rtol=1e-9)  # V_obs = |x̃|² falls at 2 · 1
    np.testing.assert_allclose(c.gamma1, 2.0 * math.hypot(1.0, 0.5), rtol=1e-9)
    assert c.gamma2 == 0.0
    np.testing.assert_allclose(c.bound, 4 * c.c3 * c.lambda_q / 16, rtol=1e-12)


def test_lyapunov_function_with_kappa_decreases_and_with_less_does_not():
    c = built().constants
    for factor, falls in ((1.01, True), (0.99, False)):
        kappa = factor * c.kappa
        matrix = np.array([[c.c3, -c.c4 * c.gamma1 / 2], [-c.c4 * c.gamma1 / 2, kappa * c.lambda_q]])
        assert (np.linalg.eigvalsh(matrix)[0] > 0) == falls  # (79) with κ on V_obs


def test_printed_condition_is_that_of_the_matrix_in_79():
    random = np.random.default_rng(3)
    for c1, c3, c4, q, g1, g2 in random.uniform(0.1, 2.0, size=(200, 6)):
        c = Constants(c1, 2 * c1, c3, c4, q, g1, 0.3 * g2, 1.0)
        m = np.array([[c3 - c4 * c.gamma2, -c4 * g1 / 2], [-c4 * g1 / 2, q]])
        assert c.printed == bool(np.linalg.eigvalsh(m)[0] > 0)


def test_constants_in_other_units_are_those_of_the_problem_written_in_them():
    a, p, b = np.array([[-1.0, 2.0], [-2.0, -3.0]]), np.diag([4.0, 1.0]), np.array([[0.1, 0.0], [1.0, 0.5]])
    f, m, own = np.array([[-2.0, 0.3], [0.0, -1.0]]), np.array([[2.0, 0.1], [0.1, 1.0]]), np.full((2, 2), 0.01)

    def problem(of_e, of_x):
        e, x = np.diag(of_e), np.diag(of_x)
        back, there = np.diag(1 / of_e), np.diag(1 / of_x)
        plant = linear(e @ a @ back, back @ p @ back, ("d",))
        error = linear(x @ f @ there, there @ m @ there, ("d",))
        coupling = (lambda z: (jnp.asarray(e @ b @ there) * z[0], jnp.asarray(e @ own @ back)), box(k=(0.5, 2.0)))
        return (plant, box(d=(0.0, 1.0))), (error, box(d=(0.0, 1.0))), coupling

    scales = np.array([1e3, 1.0]), np.array([1.0, 57.0])
    search = _Search(2000, 16, 0, False, 1.0)
    ones = np.ones(2), np.ones(2)
    inside, _ = _constants(_forms(*problem(*ones)), scales, search)
    outside, _ = _constants(_forms(*problem(*scales)), ones, search)
    mass = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0, 1.0])  # V_con is an energy
    np.testing.assert_allclose(inside.with_mass(1e-3), mass * np.array(outside), rtol=1e-6)


def test_coupling_to_the_error_itself_limits_both_conditions():
    assert built(more=0.02).verdict == "holds"
    too_much = built(more=2.0)
    assert too_much.verdict == "undecided"
    assert not too_much.printed
    assert math.isinf(too_much.kappa)


def test_growing_observer_error_is_shown_as_a_trajectory():
    found = built(spread=(-3.0, 1.0))
    assert found.verdict == "fails"
    assert found.growth is not None
    np.testing.assert_allclose(found.growth.rate, 2.0, rtol=1e-6)
    np.testing.assert_allclose(found.growth.point["d"], -3.0, rtol=1e-6)
    size = np.linalg.norm(found.growth.error, axis=1)
    np.testing.assert_allclose(np.diff(np.log(size)) / np.diff(found.growth.t), 2.0, rtol=1e-6)


def test_an_error_that_shrinks_slowly_in_a_metric_that_falls_is_not_said_to_grow():
    """Where the motion is, the Jacobian alone grows at 0.2 1/s; along the motion the metric falls at 1 1/s."""

    def at(z):
        metric: StateMetric = in_coordinates(lambda t, x: jnp.exp(-x[0]) * jnp.eye(2))
        return Point(lambda t, x: (0.2 - z[0]) * x + jnp.array([1.0, 0.0]), metric, jnp.zeros(2))

    plant = linear(np.array([[-1.0, 2.0], [-2.0, -3.0]]), np.diag([4.0, 1.0]), ("d",))
    coupling = (lambda z: (z[0] * jnp.eye(2), jnp.zeros((2, 2)))), box(k=(0.5, 2.0))
    region = box(d=(0.0, 1.0))
    found = cascade((plant, region), (ErrorSystem(("d",), ("",), at), region), coupling)
    np.testing.assert_allclose(found.constants.lambda_q, 0.6, rtol=1e-9)
    assert found.growth is None
    assert found.verdict == "holds"


def test_proved_constants_are_on_the_safe_side():
    sampled, proved = built(), built(proved=True)
    a, b = sampled.constants, proved.constants
    assert proved.evidence == "proved"
    assert b.c3 <= a.c3 <= b.c3 / 0.97
    assert b.lambda_q <= a.lambda_q <= b.lambda_q / 0.97
    assert a.gamma1 <= b.gamma1 <= 1.02 * a.gamma1
    assert a.c4 <= b.c4 <= 1.03 * a.c4


def test_a_constant_that_is_not_proved_in_time_decides_nothing():
    assert Constants(1.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.0, 1.0).weighted
    for name, value in (("gamma1", math.inf), ("c4", math.inf), ("c3", -math.inf), ("lambda_q", -math.inf)):
        broken = Constants(1.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.0, 1.0)._replace(**{name: value})
        assert not broken.weighted
        assert not broken.printed
        assert math.isinf(broken.kappa)
