"""What takes long of `test_sampled_formulas.py`."""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.certificates import certify, check, contraction, sampled_system
from covariant.certificates.base import Sampling, correction
from covariant.certificates.base._inequalities import (
    at_correction,
    in_frame_along,
    joint_force_bound,
    missing_bound,
    start_bound,
)
from covariant.certificates.checking import _matrices
from covariant.certificates.sampled._prediction import defect_bound, defect_matrix
from covariant.certificates.sampled._sampled_step import sampled_prediction
from covariant.geometry.lie import SO3
from covariant.observers import Intrinsic
from scalargraph import numbers
from scalargraph.proofs.checker import jacobian

H = 0.03


Q = np.array([[0.5, -0.04], [-0.04, 0.02]])


SAMPLING = Sampling(np.array([H, H]), 0, np.array([[[-1.0, 0.2], [0.2, 0.02]]]))


INERTIA = ((0.2, 0.02, 0.01), (0.02, 0.25, -0.01), (0.01, -0.01, 0.1))


ZERO = jnp.zeros(())


class Machine(NamedTuple):
    """A model in a motion, the force and the error there, and what a proof knows of a configuration."""

    model: models.MechanicalSystem
    q: jax.Array
    v: jax.Array
    force: jax.Array
    error: jax.Array
    place: Callable

    @property
    def n(self):
        return len(self.v)

    def observer(self, **options):
        return Intrinsic(self.model, 10.0, 50.0, substeps=8, **options)

    def point(self, q, v, error=None, age=H, rubbing=None):
        """Variables of the box; friction and its slopes are those of the velocity `rubbing`, or v."""
        rubbing, error = v if rubbing is None else rubbing, 0 * v if error is None else error
        pull, slopes = self.model.dissipation(q, rubbing), jax.jacfwd(lambda v: self.model.dissipation(q, v))(rubbing)
        parts = self.place(q), v, error, self.force, self.force + pull, -jnp.diag(slopes), jnp.full(1, age)
        return jnp.concatenate(parts)

    def coframe(self, q, v):
        """From changes of q, in a frame of the manifold, and v to (ξ, ζ)."""
        turn = jnp.stack([self.model.space.connection(q, e, v) for e in jnp.eye(self.n)], 1)
        return np.block([[np.eye(self.n), np.zeros((self.n, self.n))], [np.asarray(turn), np.eye(self.n)]])

    def differences(self, step):
        """Central differences of a step (q, v) -> (q, v) at the motion, between (ξ, ζ) before and after it."""
        (end, speed), manifold = step(self.q, self.v), self.model.manifold

        @jax.jit
        def moved(d):
            q, v = step(manifold.retract(self.q, d[: self.n]), self.v + d[self.n :])
            return jnp.concatenate([manifold.local(end, q), v])

        slopes = np.stack([(moved(1e-5 * e) - moved(-1e-5 * e)) / 2e-5 for e in jnp.eye(2 * self.n)], 1)
        return self.coframe(end, speed) @ slopes @ np.linalg.inv(self.coframe(self.q, self.v))

    def predicted(self, q, v, tau):
        observer = self.observer()
        state = observer.predict(observer.init(q)._replace(q=q, v=v), self.force, tau)
        return state.q, state.v


def two_links():
    """A machine whose metric depends on its configuration, with friction."""
    arm = models.pendulum_chain(mass=(0.6, 0.5), length=(0.3, 0.2), viscous=(0.02, 0.03), coulomb=(0.01, 0.02))
    motion = ([0.4, -0.7], [0.8, -0.5], [0.05, -0.02], [0.2, -0.15])
    return Machine(arm, *map(jnp.array, motion), lambda q: q)


def top():
    """A body without symmetry, whose weight acts aside: the third row of its attitude is known."""
    model = models.heavy_top(inertia=INERTIA, axis=(0.3, -0.5, 0.8), viscous=0.01)
    rng = np.random.default_rng(1)
    q, v = SO3.exp(jnp.asarray(rng.normal(size=3))), jnp.asarray(rng.normal(size=3))
    return Machine(model, q, v, jnp.array([0.1, -0.05, 0.03]), jnp.array([0.3, -0.2, 0.25]), lambda g: g[2])


MACHINES = {"two links": two_links, "top": top}


@functools.cache
def machine_of(name) -> Machine:
    return MACHINES[name]()


OPTIONS, ESTIMATED = ({}, {"order": 2}, {"curvature": False}), ("two links", {"coefficients": "estimated"})


BOTH = pytest.mark.parametrize("name", MACHINES)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("name", "options"), [*itertools.product(MACHINES, OPTIONS), ESTIMATED], ids=str)
def test_the_correction_is_that_of_the_step_that_runs_and_changes_curves_as_its_jacobian_says(name, options):
    machine = machine_of(name)
    observer, (_, q, v, force, error, _) = machine.observer(**options), machine
    y = machine.model.manifold.retract(q, -error)

    @jax.jit
    def step(q, v):
        return tuple(observer.smooth_correction(ZERO, q, v, force, y, jnp.asarray(H)))

    form = at_correction(sampled_system(observer, Q, SAMPLING), lambda before, after, jacobian: jacobian)
    z = machine.point(q, v, error)
    jacobian = numbers(form.graph(z).entries, np.asarray(z)).reshape(2 * machine.n, -1)
    shipped = machine.differences(step)
    assert (np.abs(jacobian - shipped).max(0) < 1e-7 * np.abs(shipped).max(0)).all()
    # The factor 1/(1 + |N| h²/18) is what differs.
    near, age = machine.model.manifold.retract(q, -1e-2 * error), jnp.asarray(H / 10)
    runs = jax.jit(observer.correct)(observer.init(q)._replace(q=q, v=v, age=age), force, near)[0]
    smooth = jax.jit(observer.smooth_correction)(ZERO, q, v, force, near, age)
    assert np.abs(runs.v - smooth.v).max() < 1e-3 * np.abs(smooth.v - v).max()
    np.testing.assert_allclose(runs.q, smooth.q, atol=1e-9)


@pytest.mark.exhaustive
@BOTH
def test_predictions_change_curves_as_their_jacobian_says(name):
    """The transition of F along the motion, by small steps of the midpoint rule."""
    machine, steps = machine_of(name), 30
    span = H if name == "top" else H / 10  # before a joint comes to rest, where dry friction is steep
    shipped = machine.differences(jax.jit(lambda q, v: machine.predicted(q, v, jnp.asarray(span))))
    system = sampled_system(machine.observer(), Q, SAMPLING)
    graph = in_frame_along(system, lambda coframe, gram, change, jacobian: jacobian)
    graph = graph.graph(machine.point(machine.q, machine.v))
    predict, one = jax.jit(machine.predicted), np.eye(2 * machine.n)
    transition = one
    for k in range(steps):
        z = machine.point(*predict(machine.q, machine.v, jnp.asarray((k + 0.5) * span / steps)))
        half = span / steps / 2 * numbers(graph.entries, np.asarray(z)).reshape(one.shape)
        transition = np.linalg.solve(one - half, (one + half) @ transition)
    # Columns of ξ and ζ have different units: each is compared with its own size.
    assert (np.abs(transition - shipped).max(0) < 1e-4 * np.abs(shipped).max(0)).all()


@pytest.mark.exhaustive
@pytest.mark.parametrize("shear", [False, True])
@BOTH
def test_lengths_change_between_samples_as_the_matrix_says(name, shear):
    """The rate of change of a squared length in M_τ along the prediction that runs."""
    machine = machine_of(name)
    model, q, v = machine.model, machine.q, machine.v
    system = sampled_system(machine.observer(), Q, SAMPLING._replace(shear=shear))
    direction = jnp.asarray(np.random.default_rng(2).normal(size=2 * machine.n))

    def frame(q, speed, tau):
        at = system.at(machine.point(q, speed, age=H + tau, rubbing=v))
        return at.metric.coframe(ZERO, at.x), at.metric.gram(ZERO, at.x)

    @jax.jit
    def squared(tau):
        end, speed = machine.predicted(q, v, tau)

        def moved(d):
            place, velocity = machine.predicted(model.manifold.retract(q, d[: machine.n]), v + d[machine.n :], tau)
            return jnp.concatenate([model.manifold.local(end, place), velocity])

        delta = jax.jvp(moved, (jnp.zeros(2 * machine.n),), (direction,))[1]
        theta, gram = frame(end, speed, tau)
        return (theta @ delta) @ gram @ (theta @ delta)

    change = float(squared(jnp.asarray(1e-4)) - squared(jnp.asarray(-1e-4))) / 2e-4
    z = machine.point(q, v)
    matrix = numbers(contraction(system, 0.0).graph(z).entries, np.asarray(z)).reshape(2 * machine.n, -1)
    theta = np.asarray(frame(q, v, 0.0)[0] @ direction)
    assert abs(change + theta @ matrix @ theta) < 1e-4 * abs(change)


@pytest.mark.exhaustive
@pytest.mark.parametrize("shear", [False, True])
@BOTH
def test_prover_and_checker_form_the_same_matrices(name, shear):
    machine, n = machine_of(name), machine_of(name).n
    system = sampled_system(machine.observer(), Q, SAMPLING._replace(shear=shear))
    z = machine.point(machine.q, machine.v, machine.error)
    # The first encoder is exact: Γ has an entry for each of the others.
    noise, squares, force = 1e-3 * np.arange(n), (2e-6,) * (n - 1), np.linspace(0.1, 0.3, n)
    few, many = 1.0 + np.arange(n), 1.0 + np.arange(2 * n)
    for form, checked in (
        (contraction(system, 2.0), _matrices.contraction(system, 2.0)),
        (correction(system), _matrices.correction(system)),
        (correction(system, noise, squares), _matrices.correction(system, noise, squares)),
        (joint_force_bound(system, force, 3.0), _matrices.joint_force(system, force, 3.0)),
        (start_bound(system, many, 2.0), _matrices.start(system, many, 2.0)),
        (missing_bound(system, 3.0, 1.0, few), _matrices.missing(system, 3.0, 1.0, few)),
    ):
        value, reference = numbers(form.graph(z).entries, np.asarray(z)), np.asarray(checked(z))
        assert np.abs(value.reshape(reference.shape) - reference).max() < 1e-9 * np.abs(reference).max()


def vectors(prediction, z, order):
    graph = defect_bound(prediction, 1.0, order).graph(z).entries
    return lambda z: numbers(graph, np.asarray(z)).reshape(prediction.size + 1, -1)[1:, 0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", range(5))
def test_the_defect_of_a_step_is_what_remains_of_its_series(order):
    """Also with dry friction, where a step crosses rest."""
    arm = models.pendulum_chain(mass=(1.0,), length=(0.5,), coulomb=(0.1,))
    check_defect(Intrinsic(arm, 10.0, 50.0, substeps=1), jnp.array([0.7, 0.01, 0.2, 0.01]), order, 1e-3)


@pytest.mark.exhaustive
def test_the_defect_of_a_step_on_rotations_is_what_remains_of_its_series():
    body = machine_of("top")
    check_defect(body.observer(), jnp.concatenate([body.q[2], body.v, body.force, jnp.array([0.01])]), 4, 0.02)


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


@pytest.mark.exhaustive
def test_a_heavy_top_is_proved_at_100_hz(tmp_path):
    recipe = {"system": "heavy_top", "parameters": {"viscous": 0.01}}
    model = models.from_recipe(recipe)
    assert isinstance(model, models.MechanicalSystem)
    result = certify(
        Intrinsic(model, 10.0, 50.0, substeps=4),
        **{"velocity": 1.0, "error": 0.05, "input": 0.1, "interval": (0.01, 0.01), "rate": 2.0, "checker": "off"},
        recipe=recipe,
    )
    assert result.statement.proved, result.statement
    assert [claim.kind for claim in result.claims[-2:]] == ["prediction", "start"]
    assert check(result.save(tmp_path / "top.json")).statement.proved
