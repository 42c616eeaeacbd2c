"""What takes long of `test_leaf.py`."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from test_leaf import FIVE_BAR, FOUR_BAR, GRAVITY, LINKAGES, Link, Linkage, inputs, linkages, made, vectors

from covariant import Record, models, observers
from covariant.engine import run_log
from covariant.geometry import Budget, Leaf, lie
from covariant.geometry._leaf import _EveryLeaf
from covariant.signals import StepCode

FROM_RELATIVE = np.array([[1.0, 0, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]])
"""Angles of each bar in space, from those of the joints."""


FIVE_BAR_IN_SPACE = FIVE_BAR._replace(
    start=tuple((FROM_RELATIVE @ np.array(FIVE_BAR.start)).tolist()), change=np.linalg.inv(FROM_RELATIVE)
)


CUT_ELSEWHERE = Linkage(
    (*FIVE_BAR.links[:2], Link(1, (0.0, 0.0), 0.35, 0.5, 0.01), FIVE_BAR.links[2]),
    (2, 3),
    (-1.9, 0.94, 1.97, -1.1),
    (0, 3),
    (1.2, -1.0),
    (0.0,) * 4,
)
"""The five-bar, opened at the elbow of its second arm."""


@pytest.mark.exhaustive
@linkages
def test_connection_has_no_torsion_and_keeps_vectors_along_each_leaf(name):
    system, q, _ = made(name)
    space, aside = system.space, jnp.asarray(q) + 0.1  # on another leaf
    a, b = jnp.asarray(np.random.default_rng(0).normal(size=(2, len(q))))
    np.testing.assert_allclose(space.connection(aside, a, b), space.connection(aside, b, a), atol=1e-11)
    change = jax.jvp(lambda x: jax.jacobian(space.constraint)(x) @ b, (aside,), (a,))[1]
    rows = jax.jacobian(space.constraint)(aside)
    np.testing.assert_allclose(rows @ space.connection(aside, a, b), change, atol=1e-11)


@pytest.mark.exhaustive
@linkages
def test_connection_keeps_lengths(name):
    system, q, _ = made(name)
    space, q = system.space, jnp.asarray(q)
    a, b, c = vectors(system, q, 3)

    def field(w):
        return lambda x: space.projected(x, w)

    def derivative(w):
        value, change = jax.jvp(field(w), (q,), (a,))
        return change + space.connection(q, a, value)

    change = jax.jvp(lambda x: space.inner(x, field(b)(x), field(c)(x)), (q,), (a,))[1]
    np.testing.assert_allclose(change, space.inner(q, derivative(b), c) + space.inner(q, b, derivative(c)), atol=1e-11)


@pytest.mark.exhaustive
@linkages
def test_curvature_by_gauss_is_that_of_the_connection(name):
    system, q, _ = made(name)
    a, b, c = vectors(system, jnp.asarray(q), 3)
    every = _EveryLeaf(system.space)
    by_definition = jax.jit(lambda *w: every.curvature(jnp.asarray(q), *w))(a, b, c)
    by_gauss = jax.jit(lambda *w: system.space.curvature(jnp.asarray(q), *w))(a, b, c)
    np.testing.assert_allclose(by_gauss, by_definition, atol=1e-11)
    if name == "five-bar":  # a line has no curvature
        assert np.abs(by_gauss).max() > 1e-2


def pinned() -> tuple[models.MechanicalSystem, models.GroupSystem, Callable]:
    """A rigid body with a pinned point, the same as a top, and the velocity of the first from that of the second."""
    mass, inertia, point = 1.7, np.diag([0.1, 0.2, 0.25]), jnp.array([0.3, -0.2, 0.4])
    body = models.GroupSystem(lie.SE3, jnp.asarray(np.diag([*[mass] * 3, *np.diag(inertia)])))
    turned = lie.SO3.exp(jnp.array([0.3, -0.5, 0.2]))
    pose = jnp.eye(4).at[:3, :3].set(turned).at[:3, 3].set(-turned @ point)
    leaf = Leaf(body.space, lambda g: g[:3, 3] + g[:3, :3] @ point, pose)
    about = inertia + mass * (float(point @ point) * np.eye(3) - np.outer(point, point))
    top = models.GroupSystem(lie.SO3, jnp.asarray(about), lambda r: -mass * GRAVITY * (r @ point)[2])
    system = models.MechanicalSystem(leaf, lambda g: mass * GRAVITY * g[2, 3])
    return system, top, lambda w: jnp.concatenate([-jnp.cross(w, point), w])


@pytest.mark.exhaustive
def test_a_body_with_a_pinned_point_is_a_top():
    system, top, twist = pinned()
    g, turned = system.space.assembly, system.space.assembly[:3, :3]
    a, b, c = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)))
    along = system.space.connection(g, twist(a), twist(b))
    np.testing.assert_allclose(along, twist(top.space.connection(turned, a, b)), atol=1e-13)
    bent = system.space.curvature(g, twist(a), twist(b), twist(c))
    np.testing.assert_allclose(bent, twist(top.space.curvature(turned, a, b, c)), atol=1e-13)
    x, y = jnp.asarray(np.random.default_rng(1).normal(size=(2, 6)))
    torsion = system.space.connection(g, x, y) - system.space.connection(g, y, x)
    np.testing.assert_allclose(torsion, system.manifold.bracket(g, x, y), atol=1e-13)


@pytest.mark.exhaustive
@linkages
def test_flow_is_that_of_the_equations_with_multipliers(name):
    linkage = LINKAGES[name]
    system, (_, q, v) = linkage.system(), made(name)
    space, n, count = system.space, len(q), len(linkage.motors)

    @jax.jit
    def with_multipliers(t, x):
        place, rate = x[:n], x[n:]
        mass = jax.hessian(linkage.energy, 1)(place, rate)
        turning = jax.jvp(lambda p: jax.grad(linkage.energy, 1)(p, rate), (place,), (rate,))[1]
        force = jax.grad(linkage.energy)(place, rate) - turning - jax.grad(linkage.potential)(place)
        force = force - jnp.array(linkage.drag) * rate + system.force(t, place, inputs(t, count))
        rows = jax.jacobian(space.constraint)(place)
        change = jax.jvp(lambda p: jax.jacobian(space.constraint)(p) @ rate, (place,), (rate,))[1]
        zero = jnp.zeros((len(rows), len(rows)))
        solved = jnp.linalg.solve(jnp.block([[mass, rows.T], [rows, zero]]), jnp.concatenate([force, -change]))
        return jnp.concatenate([rate, solved[:n]]), -solved[n:]

    def slopes(t, x):
        return np.asarray(with_multipliers(t, x)[0])

    duration, steps = 0.2, 400
    reference = solve_ivp(slopes, (0, duration), np.r_[q, v], method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]

    @jax.jit
    def run(q, v):
        def step(motion, k):
            h = duration / steps
            motion = models.advance(system, k * h, motion, lambda t, x: inputs(t, count), h, 1)
            return motion, jnp.max(jnp.abs(space.constraint(motion.q)))

        return jax.lax.scan(step, models.Motion(q, v), jnp.arange(steps, dtype=float))

    end, gaps = run(jnp.asarray(q), jnp.asarray(v))
    np.testing.assert_allclose(end.q, reference[:n], atol=1e-10)
    np.testing.assert_allclose(end.v, reference[n:], atol=1e-10)
    assert gaps.max() < 1e-14
    # The force in the joint that closes the loop.
    force = models.applied_force(system, jnp.zeros(()), jnp.asarray(q), inputs(jnp.zeros(()), count))
    force = force - jnp.array(linkage.drag) * v
    load = space.load(jnp.asarray(q), jnp.asarray(v), force)
    np.testing.assert_allclose(load, with_multipliers(0.0, jnp.r_[q, v])[1], atol=1e-9)


@functools.cache
def log(count=60, h=2.5e-3) -> tuple[Record, np.ndarray]:
    """A motion of the five-bar: all its angles, and their rates."""
    system, q, v = made("five-bar")

    @jax.jit
    def run(q, v):
        def step(now, k):
            u = inputs(k * h, 2)
            return models.advance(system, k * h, now, u, h, 4), (now, u)

        return jax.lax.scan(step, models.Motion(q, v), jnp.arange(count, dtype=float))[1]

    motion, u = run(jnp.asarray(q), jnp.asarray(v))
    return Record(np.arange(count) * h, np.asarray(u), np.asarray(motion.q)), np.asarray(motion.v)


def masked(y, measured):
    return np.where(np.isin(np.arange(y.shape[1]), measured), y, np.nan)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["geodesic", "kalman"])
def test_estimates_are_the_same_in_other_angles_and_for_another_cut(kind):
    """With the exact logarithm: the loop opened elsewhere has other coordinates, and another tree."""
    record, v = log()

    def estimate(linkage, y):
        model = linkage.system(damped=False)
        if kind == "geodesic":
            observer = observers.Geodesic(model, 20.0, 150.0, Budget(newton=4, steps=8), substeps=8)
        else:
            observer = observers.IntrinsicKalman(model, 1e-2, 4e-6 * np.eye(4), 2.0, gate=None, substeps=8)
        run, _ = run_log(observer, Record(record.t, record.u, masked(y, linkage.motors)), ())
        return np.asarray(run.estimate)[:, 4:]

    by_joints = estimate(FIVE_BAR._replace(drag=(0.0,) * 4), record.y)
    in_space = estimate(FIVE_BAR_IN_SPACE, record.y @ FROM_RELATIVE.T)
    np.testing.assert_allclose(in_space, by_joints @ FROM_RELATIVE.T, atol=1e-9)
    other = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [-1, -1, 1, 1], [0, 0, 1, 0]])
    cut = estimate(CUT_ELSEWHERE, record.y @ other.T + np.array([0, 0, np.pi, 0]))
    np.testing.assert_allclose(cut[1:], by_joints[1:] @ other.T, atol=1e-9)
    assert np.abs(by_joints - v)[1].max() > 1e-3 > np.abs(by_joints - v)[-1].max() or kind == "geodesic"


@pytest.mark.exhaustive
def test_constant_gains_find_the_motion_from_the_motors_and_stay_on_the_leaf():
    record, v = log()
    system, *_ = made("five-bar")
    record = Record(record.t, record.u, masked(record.y, FIVE_BAR.motors))
    run, _ = run_log(observers.Intrinsic(system, 120.0, 7200.0, substeps=1), record)
    assert np.abs(run.estimate[-1, 4:] - v[-1]).max() < 1e-3
    assert np.abs(jax.vmap(system.space.constraint)(jnp.asarray(run.estimate[:, :4]))).max() < 1e-14
    assert set(run.info.result.tolist()) == {0}


NOISE, PROCESS = 2e-3, 1e-2


@functools.cache
def noisy(runs=12, count=30, h=0.01):
    """White forces and noisy encoders: true motions (runs, count, 4) and readings of the five-bar."""
    system, q, v = made("five-bar")
    random = np.random.default_rng(11)
    space = system.space
    white = jnp.asarray(random.normal(size=(runs, count, 4)))
    first = jnp.asarray(random.normal(size=(runs, 2, 4)))

    def force(t, q, u):
        return system.force(t, q, u[:2]) + u[2:]

    driven = models.MechanicalSystem(space, system.potential, force, inputs=6)

    @jax.jit
    @jax.vmap
    def run(white, first):
        # In an orthonormal frame of the leaf, so that both are isotropic in the metric.
        def isotropic(q, w):
            return space.projected(q, jnp.linalg.solve(jnp.linalg.cholesky(space(q)).T, w))

        def step(now, data):
            k, w = data
            # The acceleration of white forces that are isotropic in the metric, held over the step.
            noise = space.lower(now.q, isotropic(now.q, w)) * (PROCESS / h) ** 0.5
            u = jnp.concatenate([inputs(k * h, 2), noise])
            return models.advance(driven, k * h, now, u, h, 2), now

        begin = space.manifold.retract(jnp.asarray(q), isotropic(jnp.asarray(q), first[0]) * NOISE)
        speed = space.projected(begin, jnp.asarray(v)) + isotropic(begin, first[1]) * 0.3
        return jax.lax.scan(step, models.Motion(begin, speed), (jnp.arange(count, dtype=float), white))[1]

    true = run(white, first)
    return true, np.asarray(true.q) + NOISE * random.normal(size=(runs, count, 4))


def squares(model, estimate, root, true) -> float:
    """Normalised square of the error, on the four dimensions of configurations and velocities of the leaf."""
    space = model.space
    q, v = jnp.asarray(estimate[:4]), jnp.asarray(estimate[4:])
    e = space.manifold.ambient.local(q, true.q)
    xi = space.projected(q, e + space.space.connection(q, e, e) / 2)
    zeta = space.projected(q, true.v + space.connection(q, e, true.v)) - v
    basis = np.linalg.svd(np.asarray(space.normals(q).rows))[2][2:]
    both = np.kron(np.eye(2), basis)
    error, spread = both @ np.r_[xi, zeta], both @ root
    return float(error @ np.linalg.solve(spread @ spread.T, error))


@pytest.mark.exhaustive
def test_a_covariance_is_made_regular_across_the_leaf_alone():
    model, q, _ = made("four-bar")
    observer = observers.IntrinsicKalman(model, jnp.asarray(PROCESS), NOISE**2 * jnp.eye(3), 1.0)
    state = observer.init(jnp.asarray(q))
    whole, part = (np.asarray(root @ root.T) for root in (observer.regular_root(state), state.root))
    along = np.kron(np.eye(2), np.stack([np.asarray(model.space.projected(state.q, a)) for a in jnp.eye(3)], axis=1))
    np.testing.assert_allclose(along @ (whole - part), 0.0, atol=1e-12)
    assert [np.linalg.matrix_rank(each, tol=1e-10) for each in (part, whole)] == [2, 6]


@pytest.mark.exhaustive
def test_the_filter_knows_its_error_on_a_leaf_and_the_smoother_a_smaller_one():
    true, y = noisy()
    model, *_ = made("five-bar")
    observer = observers.IntrinsicKalman(model, PROCESS, NOISE**2 * np.eye(4), 0.09 + 1.0, gate=None, substeps=2)
    y = masked(y.reshape(-1, 4), FIVE_BAR.motors).reshape(y.shape)
    count, h = y.shape[1], 0.01
    t = np.arange(count) * h
    u = np.asarray(jax.vmap(lambda s: inputs(s, 2))(jnp.asarray(t)))
    filtered, later, errors = [], [], []
    for k in range(len(y)):
        smoothed = observers.smooth(observer, Record(t, u, y[k]))
        at = [jax.tree.map(lambda a, k=k, i=i: a[k, i], true) for i in range(count)]
        last = smoothed.filtered.estimate[-1]
        later += [squares(model, smoothed.run.estimate[i], smoothed.root[i], at[i]) for i in range(5, count, 4)]
        filtered.append(squares(model, last, smoothed.root[-1], at[-1]))
        errors.append([np.abs(run.estimate[15, 4:] - at[15].v).max() for run in (smoothed.run, smoothed.filtered)])
    assert 3.0 < np.mean(later) < 5.0
    assert 2.0 < np.mean(filtered) < 6.5
    assert np.mean(errors, axis=0)[0] < np.mean(errors, axis=0)[1]


def in_line() -> np.ndarray:
    """Crank and coupler of the four-bar in line: the rocker stands, and its angle tells nothing of the others."""
    reach, ground, rocker = 0.15 + 0.4, 0.35, 0.3
    crank = np.arccos((reach**2 + ground**2 - rocker**2) / (2 * reach * ground))
    end = reach * np.array([np.cos(crank), np.sin(crank)]) - [ground, 0.0]
    return np.array([crank, 0.0, np.arctan2(end[1], end[0])])


@pytest.mark.exhaustive
def test_dead_centre_of_what_is_measured_is_said():
    system, *_ = made("four-bar")
    q, rocker = in_line(), np.array([False, False, True])
    assert np.abs(system.space.constraint(jnp.asarray(q))).max() < 1e-12
    assert not system.manifold.told(jnp.asarray(q), jnp.asarray(rocker)).all()
    assert system.manifold.told(jnp.asarray(q), jnp.asarray(np.roll(rocker, 1))).all()
    observer = observers.Intrinsic(system, 20.0, 100.0, substeps=1)
    state = observer.init(jnp.asarray(q))
    y = jnp.where(jnp.asarray(rocker), jnp.asarray(q), jnp.nan)
    info = jax.jit(observer.step)(state, jnp.zeros(1), y, jnp.asarray(1e-4))[1]
    assert StepCode(int(info.result)) == StepCode.NOT_RECONSTRUCTIBLE
    with pytest.raises(ValueError, match="dead centre"):
        observer.init(y)


def test_another_assembly_than_the_given_one_is_not_reached():
    with pytest.raises(ValueError, match="cannot be reached"):
        made("four-bar")[0].manifold.checked(jnp.array([np.nan, np.nan, 0.0]))


def test_rows_that_are_always_zero_are_left_out():
    system, q, _ = made("four-bar")

    def in_space(x):
        gap = FOUR_BAR.constraint(x)
        return jnp.stack([gap[0], gap[0] - gap[1], 0.0 * gap[0]])

    leaf = Leaf.closing(system.space.space, in_space, jnp.asarray(q))
    assert leaf.constraint(jnp.asarray(q)).shape == (2,)
    a = jnp.arange(3.0)
    np.testing.assert_allclose(leaf.projected(leaf.assembly, a), system.space.projected(leaf.assembly, a), atol=1e-9)


def test_filters_with_errors_in_coordinates_refuse_a_loop():
    system, *_ = made("four-bar")
    for make in (
        lambda: observers.EKF(system, jnp.eye(3), jnp.eye(3)),
        lambda: observers.UKF(system, jnp.eye(3), jnp.eye(3)),
    ):
        with pytest.raises(ValueError, match="closed loop"):
            make()
