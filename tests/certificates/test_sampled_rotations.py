"""The sampled step on rotations contracts as its matrices say, and its Runge–Kutta steps err as little as claimed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import Sampling, certify, check, contraction, correction, sampled_system
from covariant.certificates.base._inequalities import at_correction, in_frame_along, missing_bound
from covariant.certificates.checking import _matrices
from covariant.certificates.sampled._prediction import defect_bound, defect_matrix
from covariant.certificates.sampled._sampled_step import sampled_prediction
from covariant.geometry.lie import SO3
from covariant.lowering import numbers
from covariant.observers import Intrinsic
from covariant.proofs.checker import jacobian, series

H = 0.03
Q = np.array([[0.5, -0.04], [-0.04, 0.02]])
SAMPLING = Sampling(np.array([H, H]), 0, np.array([[[-1.0, 0.2], [0.2, 0.02]]]))
INERTIA = ((0.2, 0.02, 0.01), (0.02, 0.25, -0.01), (0.01, -0.01, 0.1))


def top(**options):
    """A body without symmetry, whose weight acts aside."""
    model = models.heavy_top(inertia=INERTIA, axis=(0.3, -0.5, 0.8), viscous=0.01)
    return Intrinsic(model, 10.0, 50.0, substeps=8, **options)


RNG = np.random.default_rng(1)
START, SPEED, TORQUE = (
    SO3.exp(jnp.asarray(RNG.normal(size=3))),
    jnp.asarray(RNG.normal(size=3)),
    jnp.array([0.1, -0.05, 0.03]),
)
ERROR = jnp.array([0.3, -0.2, 0.25])


def point(g, v, error=0 * ERROR, total=0 * ERROR, age=H):
    """Variables of the box: the third row of the attitude, which the weight reads, and the rest."""
    return jnp.concatenate([g[2], v, error, TORQUE, total, jnp.full(3, 0.01), jnp.full(1, age)])


def coframe(v):
    """From (δθ, δv) in the body frame to (ξ, ζ)."""
    turn = jnp.stack([top().model.space.connection(jnp.eye(3), e, v) for e in jnp.eye(3)], 1)
    return np.block([[np.eye(3), np.zeros((3, 3))], [np.asarray(turn), np.eye(3)]])


def differences(step, g, v):
    """Central differences of a step (g, v) -> (g, v), in the body frames before and after it."""
    end = step(g, v)[0]

    @jax.jit
    def moved(d):
        new_g, new_v = step(g @ SO3.exp(d[:3]), v + d[3:])
        return jnp.concatenate([SO3.log(end.T @ new_g), new_v])

    return np.stack([(moved(1e-5 * e) - moved(-1e-5 * e)) / 2e-5 for e in jnp.eye(6)], 1)


def predicted(g, v, tau):
    state = top().predict(top().init(g)._replace(q=g, v=v), TORQUE, tau)
    return state.q, state.v


@pytest.mark.exhaustive("options0", "options1")
@pytest.mark.long
@pytest.mark.parametrize("options", [{}, {"order": 2}, {"curvature": False}])
def test_the_correction_changes_curves_as_its_jacobian_says(options):
    observer = top(**options)
    y = START @ SO3.exp(-ERROR)

    def step(g, v):
        return tuple(observer.smooth_correction(jnp.zeros(()), g, v, TORQUE, y, jnp.asarray(H)))

    after = coframe(step(START, SPEED)[1])
    shipped = after @ differences(step, START, SPEED) @ np.linalg.inv(coframe(SPEED))
    z = point(START, SPEED, ERROR)
    form = at_correction(sampled_system(observer, Q, SAMPLING), lambda before, after, jacobian: jacobian)
    jacobian = numbers(form.graph(z).entries, np.asarray(z)).reshape(6, 6)
    assert (np.abs(jacobian - shipped).max(0) < 1e-8 * np.abs(shipped).max(0)).all()


@pytest.mark.exhaustive
def test_predictions_change_curves_as_their_jacobian_says():
    predict = jax.jit(predicted)
    shipped = differences(lambda g, v: predicted(g, v, jnp.asarray(H)), START, SPEED)
    shipped = coframe(predict(START, SPEED, jnp.asarray(H))[1]) @ shipped @ np.linalg.inv(coframe(SPEED))
    system = sampled_system(top(), Q, SAMPLING)
    graph = in_frame_along(system, lambda coframe, gram, change, jacobian: jacobian).graph(point(START, SPEED))
    transition, steps = np.eye(6), 30
    for k in range(steps):
        g, v = predict(START, SPEED, jnp.asarray((k + 0.5) * H / steps))
        z = point(g, v, total=TORQUE - 0.01 * v)
        half = H / steps / 2 * numbers(graph.entries, np.asarray(z)).reshape(6, 6)
        transition = np.linalg.solve(np.eye(6) - half, (np.eye(6) + half) @ transition)
    assert (np.abs(transition - shipped).max(0) < 1e-6 * np.abs(shipped).max(0)).all()


@pytest.mark.exhaustive
def test_lengths_change_between_samples_as_the_matrix_says():
    """With the shear, the rate of change of a squared length in M_τ along the prediction that runs."""
    system, direction = sampled_system(top(), Q, SAMPLING._replace(shear=True)), jnp.asarray(RNG.normal(size=6))
    total = TORQUE - 0.01 * SPEED

    def frame(g, v, tau):
        metric = system.at(point(g, v, total=total, age=H + tau)).metric
        x = jnp.concatenate([jnp.zeros(3), v])
        return metric.coframe(jnp.zeros(()), x), metric.gram(jnp.zeros(()), x)

    @jax.jit
    def squared(tau):
        end = predicted(START, SPEED, tau)[0]

        def moved(d):
            g, v = predicted(START @ SO3.exp(d[:3]), SPEED + d[3:], tau)
            return jnp.concatenate([SO3.vee(end.T @ g), v])

        delta = jax.jvp(moved, (jnp.zeros(6),), (direction,))[1]
        theta, gram = frame(end, predicted(START, SPEED, tau)[1], tau)
        return (theta @ delta) @ gram @ (theta @ delta)

    change = float(squared(jnp.asarray(1e-4)) - squared(jnp.asarray(-1e-4))) / 2e-4
    z = point(START, SPEED, total=total)
    matrix = numbers(contraction(system, 0.0).graph(z).entries, np.asarray(z)).reshape(6, 6)
    theta = np.asarray(frame(START, SPEED, 0.0)[0] @ direction)
    assert abs(change + theta @ matrix @ theta) < 1e-5 * abs(change)


@pytest.mark.exhaustive
def test_prover_and_checker_form_the_same_matrices():
    system, z = sampled_system(top(), Q, SAMPLING._replace(shear=True)), point(START, SPEED, ERROR)
    reach = np.array([1.0, 2.0, 3.0])
    for form, checked in (
        (contraction(system, 2.0), _matrices.contraction(system, 2.0)),
        (correction(system), _matrices.correction(system)),
        (missing_bound(system, 3.0, 1.0, reach), _matrices.missing(system, 3.0, 1.0, reach)),
    ):
        value, reference = numbers(form.graph(z).entries, np.asarray(z)), np.asarray(checked(z))
        assert np.abs(value.reshape(reference.shape) - reference).max() < 1e-9 * np.abs(reference).max()


def vectors(prediction, z, order):
    graph = defect_bound(prediction, 1.0, order).graph(z).entries
    return lambda z: numbers(graph, np.asarray(z)).reshape(prediction.size + 1, -1)[1:, 0]


@pytest.mark.exhaustive("0", "3")
@pytest.mark.parametrize("order", range(5))
def test_the_defect_of_a_step_is_what_remains_of_its_series(order):
    """Also with dry friction, where a step crosses rest."""
    arm = models.pendulum_chain(mass=(1.0,), length=(0.5,), coulomb=(0.1,))
    check_defect(Intrinsic(arm, 10.0, 50.0, substeps=1), jnp.array([0.7, 0.01, 0.2, 0.01]), order, 1e-3)


@pytest.mark.exhaustive
def test_the_defect_of_a_step_on_rotations_is_what_remains_of_its_series():
    check_defect(top(), jnp.concatenate([START[2], SPEED, TORQUE, jnp.array([0.01])]), 4, 0.02)


def check_defect(observer, z, order, longest):
    """δ(s)/s^k is a mean of the k-th derivatives over k!, in the metric at the end of the step."""
    prediction = sampled_prediction(observer, Q, SAMPLING)
    assert prediction.has_series
    z = jnp.concatenate([z, jnp.full(2, longest)])
    whole, derivative = vectors(prediction, z, 0), vectors(prediction, z, order)
    means = []
    for r in (longest, longest / 2):
        # The weights of the mean are k(s − r)^(k−1)/s^k; of order 0 it is the value at the end.
        nodes, weights = np.polynomial.legendre.leggauss(10) if order else (np.ones(1), np.full(1, 2.0))
        r_at = r * (nodes + 1) / 2
        parts = order * (r - r_at) ** (order - 1) * r / r**order if order else np.ones(1)
        mean = sum(
            w / 2 * part * derivative(z.at[-1].set(at).at[-2].set(r))
            for w, part, at in zip(weights, parts, r_at, strict=True)
        )
        means.append(np.abs(whole(z.at[-2:].set(r)) / r**order - mean).max() / np.abs(mean).max())
    assert max(means) < 1e-4
    matrix = np.asarray(jax.jit(defect_matrix(prediction, 1.0, jacobian, order))(z))
    assert np.abs(matrix[1:, 0] - derivative(z)).max() < 1e-9 * np.abs(matrix).max()


def test_series_of_a_choice_that_the_number_does_not_make():
    chosen = np.array([[True, False], [False, True]])

    def function(r):
        return jnp.where(chosen, jnp.sin(r), r * r)

    coefficients = series(function, 3)(jnp.array(0.3))
    for k, expected in enumerate(([np.sin(0.3), 0.09], [np.cos(0.3), 0.6], [-np.sin(0.3) / 2, 1.0])):
        assert np.allclose(coefficients[k], np.where(chosen, *expected))
    with pytest.raises(ValueError, match="'gt' has no known expansion"):
        series(lambda r: jnp.where(r > 0, r, r * r), 2)(jnp.array(0.5))


def test_series_refuse_kinks():
    with pytest.raises(ValueError, match="has no known expansion"):
        series(jnp.abs, 2)(jnp.array(0.5))


@pytest.mark.exhaustive
def test_a_heavy_top_is_proved_at_100_hz(tmp_path):
    recipe = {"system": "heavy_top", "parameters": {"viscous": 0.01}}
    model = models.from_recipe(recipe)
    assert isinstance(model, models.MechanicalSystem)
    result = certify(
        Intrinsic(model, 10.0, 50.0, substeps=4),
        velocity=1.0,
        error=0.05,
        input=0.1,
        interval=(0.01, 0.01),
        rate=2.0,
        recipe=recipe,
        checker="off",
    )
    assert result.statement.proved, result.statement
    assert [claim.kind for claim in result.claims[-2:]] == ["prediction", "start"]
    assert check(result.save(tmp_path / "top.json")).statement.proved
