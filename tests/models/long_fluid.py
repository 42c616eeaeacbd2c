"""What takes long of `test_fluid.py`."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_fluid import POINTS, SMOOTH, X1, X2, clock_and_shift, d, laplacian, relative, values, velocity

from covariant import models
from covariant.geometry.lie import SU
from covariant.models import Motion, fluid
from covariant.observers import Intrinsic

OTHER = np.sin(X1) + 0.4 * np.cos(X2) - 0.2 * np.sin(X1 - X2)


UNSTABLE = np.cos(2 * X1)
"""A shear flow, steady but unstable from n = 5 on."""


ROUGH = 0.5 * np.cos(X1 + X2 + 1.0) - 0.3 * np.cos(X1 - 2 * X2) + 0.4 * np.sin(2 * X2) - 0.6 * np.cos(X2 + 0.2)


STEPS = 1000


system = functools.cache(fluid.ideal_fluid)


def casimirs(n, v):
    """Casimirs `(2π)²/n · tr Ωᵏ` for k = 2, …, n, Ω = Σ ω_m T_m: the discrete counterpart of `∫ωᵏdx`."""
    eigenvalues = jnp.linalg.eigvalsh(fluid._matrix(n, fluid.vorticity_modes(n, v)))
    return (2 * np.pi) ** 2 / n * jnp.sum(eigenvalues[:, None] ** jnp.arange(2.0, n + 1)[None], axis=0)


def repeated(step, start, samples, count):
    """As `lax.scan` over samples of which there are STEPS, but only the first `count`: the other rows stay zero."""

    def one(k, carry):
        state, rows = carry
        state, row = step(state, jax.tree.map(lambda a: a[k], samples))
        return state, jax.tree.map(lambda all_, new: all_.at[k].set(new), rows, row)

    shapes = jax.eval_shape(lambda: step(start, jax.tree.map(lambda a: a[0], samples))[1])
    rows = jax.tree.map(lambda part: jnp.zeros((STEPS, *part.shape), part.dtype), shapes)
    return jax.lax.fori_loop(0, count, one, (start, rows))[1]


@eqx.filter_jit
def path(model, start, dt, count):
    """Motion and energy after each of the first `count` of `STEPS` steps of dt."""

    def step(motion, _):
        after = models.advance(model, 0.0, motion, jnp.zeros(0), dt, 1)
        return after, (after, models.energy(model, *after))

    return repeated(step, start, None, count)


def path_from(n, v, dt, count=STEPS):
    return path(system(n), Motion(system(n).group.identity(), v), jnp.asarray(dt), jnp.asarray(count))


@functools.cache
def smooth_path(n):
    """Ten seconds of a smooth flow."""
    return path_from(n, velocity(n, SMOOTH), 0.01)[0]


def order(sizes, errors):
    return np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(errors)), 1)[0]


@pytest.mark.exhaustive
def test_bracket_tends_to_the_poisson_bracket_at_second_order():
    poisson = d(SMOOTH, 0) * d(OTHER, 1) - d(SMOOTH, 1) * d(OTHER, 0)
    sizes = (9, 17, 33)
    bracket = eqx.filter_jit(lambda n, v, w: fluid.field(fluid.stream_modes(n, SU(n).lie_bracket(v, w)), POINTS))
    errors = [relative(bracket(n, velocity(n, SMOOTH), velocity(n, OTHER)), poisson) for n in sizes]
    assert order(sizes, errors) == pytest.approx(-2, abs=0.1)
    assert errors[-1] < 0.01


@pytest.mark.exhaustive
def test_derivative_of_the_logarithm_is_that_of_the_dense_group():
    n, rng = 5, np.random.default_rng(1)
    x, y, dx = jnp.asarray(rng.normal(size=(3, n**2 - 1)))
    fast, dense = system(n).group.right_jacobian_inverse, jax.jit(SU(n).right_jacobian_inverse)
    slope = jax.jit(lambda at: jax.jvp(lambda p: fast(p, y), (at,), (dx,)))
    for at in (x, jnp.zeros_like(x)):  # at zero all eigenvalues are equal
        value, rate = slope(at)
        assert relative(value, dense(at, y)) < 1e-12
        assert relative(rate, (dense(at + 1e-5 * dx, y) - dense(at - 1e-5 * dx, y)) / 2e-5) < 1e-7


@pytest.mark.exhaustive
def test_inertia_is_the_dense_one():
    n = 5
    inertia, one = fluid.Laplacian(n), jnp.eye(n**2 - 1)
    basis = np.asarray(jax.vmap(SU(n).hat)(one))
    expected = np.zeros((n**2 - 1, n**2 - 1))
    for a in range(-2, 3):
        for b in range(-2, 3):
            t = clock_and_shift((a, b), n)
            parts = np.einsum("jk,ijk->i", t.conj(), basis) / n / fluid._unit(n)  # coefficients of the mode
            expected += (2 * np.pi) ** 2 * (a * a + b * b) * np.outer(parts.conj(), parts).real
    matrix = np.asarray(jax.vmap(inertia)(one))
    assert relative(matrix, expected) < 1e-13
    assert relative(matrix, matrix.T) < 1e-13
    assert np.linalg.eigvalsh(matrix)[0] > 0
    assert relative(jax.vmap(inertia.solve)(matrix), one) < 1e-13


@pytest.mark.exhaustive
def test_energy_and_the_square_of_the_vorticity_are_integrals_over_the_torus():
    n = 9
    v = jnp.asarray(np.random.default_rng(2).normal(size=n**2 - 1))
    psi = np.asarray(eqx.filter_jit(lambda v: fluid.field(fluid.stream_modes(n, v), POINTS))(v))
    area = (2 * np.pi / POINTS) ** 2
    energy = eqx.filter_jit(lambda v: models.energy(system(n), system(n).group.identity(), v))(v)
    assert energy == pytest.approx(area / 2 * np.sum(d(psi, 0) ** 2 + d(psi, 1) ** 2), rel=1e-12)
    omega = np.asarray(values(n, v, POINTS))
    assert eqx.filter_jit(casimirs)(n, v)[0] == pytest.approx(area * np.sum(omega**2), rel=1e-12)


def test_casimirs_tend_to_integrals_of_powers_of_the_vorticity_at_second_order():
    sizes = (9, 17, 33)
    omega = np.asarray(values(9, velocity(9, SMOOTH), POINTS))
    found = np.asarray([eqx.filter_jit(casimirs)(n, velocity(n, SMOOTH))[:3] for n in sizes])
    for k, casimir in zip((2, 3, 4), found.T, strict=True):
        exact = (2 * np.pi / POINTS) ** 2 * np.sum(omega**k)
        if k == 2:
            np.testing.assert_allclose(casimir, exact, rtol=1e-12)
        else:
            assert order(sizes, np.abs(casimir - exact)) == pytest.approx(-2, abs=0.15)


@pytest.mark.exhaustive
@pytest.mark.parametrize("stream", [np.cos(X1) + np.cos(X2), np.cos(2 * X1 + X2) - 0.4 * np.sin(X1 - 2 * X2)])
def test_flows_of_a_single_wave_number_are_steady(stream):
    n = 9
    v = velocity(n, stream)
    space, here = system(n).space, system(n).group.identity()
    assert np.abs(eqx.filter_jit(lambda v: space.connection(here, v, v))(v)).max() < 1e-13 * np.abs(v).max() ** 2
    # What rounding starts may grow, as many steady flows are unstable.
    assert relative(path_from(n, v, 0.01)[0].v[-1], v) < 1e-9


def test_viscosity_damps_each_mode_by_its_wave_number():
    n, nu = 9, 0.03
    viscous = fluid.ideal_fluid(n, nu)
    v = velocity(n, SMOOTH)
    rate = eqx.filter_jit(models.friction)(viscous, jnp.zeros(()), viscous.group.identity(), v, jnp.zeros(0))
    assert relative(values(n, rate, POINTS), nu * laplacian(values(n, v, POINTS))) < 1e-12


@eqx.filter_jit
def kept(n, v, g, last):
    """Eigenvalues of the vorticity before, Casimirs before and after, vorticity as carried along and as found."""
    omega = fluid.vorticity_modes(n, v)
    eigenvalues = jnp.linalg.eigvalsh(fluid._matrix(n, omega))
    carried, found = fluid.carry(n, g, omega), fluid.vorticity_modes(n, last)
    return eigenvalues, casimirs(n, v), casimirs(n, last), carried, found, system(n).group.defect(g)


@pytest.mark.exhaustive
@pytest.mark.parametrize("n", [5, 9, 17, 33])
def test_motion_keeps_casimirs_group_and_vorticity(n):
    v, moved = velocity(n, SMOOTH), smooth_path(n)
    assert relative(moved.v[-1], v) > 0.1  # it does move
    eigenvalues, before, after, carried, found, defect = map(np.asarray, kept(n, v, moved.q[-1], moved.v[-1]))
    powers = np.arange(2, n + 1)
    scale = (2 * np.pi) ** 2 / n * np.sum(np.abs(eigenvalues[:, None]) ** powers, axis=0)  # odd ones may nearly vanish
    drift = np.abs(after - before) / scale
    assert drift[:3].max() < 1e-12
    assert (drift / powers).max() < 5e-13  # powers multiply the drift of the eigenvalues
    assert defect < 1e-12
    assert relative(found, carried) < 1e-11


@pytest.mark.exhaustive
def test_energy_is_kept_at_fourth_order():
    n, steps, errors = 9, (0.16, 0.08, 0.04), []
    for dt in steps:
        energy = np.asarray(path_from(n, velocity(n, 2 * SMOOTH), dt, round(8 / dt))[1])[: round(8 / dt)]
        errors.append(np.abs(energy / energy[0] - 1).max())
    assert order(steps, errors) > 3.8


@pytest.mark.exhaustive
def test_relabelled_particles_move_alike():
    n = 5
    h = system(n).group.exp(velocity(n, ROUGH))
    other = path(system(n), Motion(h, velocity(n, SMOOTH)), jnp.asarray(0.01), jnp.asarray(STEPS))[0]
    assert relative(other.v, smooth_path(n).v) < 1e-12
    assert relative(other.q, h @ smooth_path(n).q) < 1e-12


def pseudo_spectral(vorticity, duration, steps=200):
    """Euler's equation on the torus by Fourier collocation with two thirds of the modes kept, and RK4."""
    k = np.fft.fftfreq(POINTS, 1 / POINTS)
    k1, k2 = k[:, None], k[None]
    square = k1**2 + k2**2
    square[0, 0] = 1
    keep = (np.abs(k1) < POINTS / 3) & (np.abs(k2) < POINTS / 3)

    def rate(w):
        psi = -w / square
        d = [np.fft.ifft2(1j * a * f).real for f in (psi, w) for a in (k1, k2)]
        return -np.fft.fft2(d[0] * d[3] - d[1] * d[2]) * keep

    w, h = np.fft.fft2(vorticity), duration / steps
    for _ in range(steps):
        a = rate(w)
        b = rate(w + h / 2 * a)
        c = rate(w + h / 2 * b)
        w = w + h / 6 * (a + 2 * b + 2 * c + rate(w + h * c))
    return np.fft.ifft2(w).real


@pytest.mark.exhaustive
def test_vorticity_tends_to_that_of_eulers_equation_at_second_order():
    start = np.asarray(values(9, velocity(9, SMOOTH), POINTS))
    exact = pseudo_spectral(start, 1.0)
    sizes = (9, 17, 33)
    errors = [relative(values(n, smooth_path(n).v[99], POINTS), exact) for n in sizes]
    assert relative(start, exact) > 0.15
    assert order(sizes, errors) == pytest.approx(-2, abs=0.3)


@eqx.filter_jit
def follow(observer, start, truth, direction, size, labels, dt, count):
    """|ṽ − v|, |ζ_e| in the metric relative to |v|, after each of the first `count` samples, and result codes."""
    space, group = observer.model.space, observer.model.group
    speed = space.norm(labels, start)
    wrong = direction * (size * speed / space.norm(labels, direction))

    def step(state, x):
        state, info = observer.step(state, jnp.zeros(0), labels @ x.q, dt)
        return state, (space.norm(labels, state.v - x.v) / speed, info.distance / speed, info.result)

    state = observer.init(labels)._replace(q=labels @ group.exp(0.1 * wrong), v=start + wrong)
    return repeated(step, state, truth, count)


def errors_of(n, stream, alpha, dt, curvature=True, size=0.5, labels=None, count=STEPS):
    """Errors of velocity and position (2, count) relative to |v|, from a velocity error of `size` and some of position.

    `labels`: an element of the group that renames the particles.
    """
    model, v, direction = system(n), velocity(n, stream), velocity(n, OTHER + 0.5 * ROUGH)
    truth = path_from(n, v, dt, count)[0]
    h = model.group.identity() if labels is None else labels
    observer = Intrinsic(model, jnp.asarray(alpha), jnp.asarray(0.21 * alpha**2), curvature=curvature, substeps=1)
    numbers = jnp.asarray(size), h, jnp.asarray(dt), jnp.asarray(count)
    off, distance, result = follow(observer, v, truth, direction, *numbers)
    assert not np.any(np.asarray(result))
    return np.asarray([off, distance])[:, :count]


def decay(errors, alpha, dt, between):
    """Rate [1/s] at which the errors shrink between two sizes, position and velocity taken together."""
    length = np.hypot(errors[0], 0.21**0.5 * alpha * errors[1])
    low, high = between
    inside = (length < high) & (length > low)
    assert inside.sum() > 50
    t = dt * np.arange(1, STEPS + 1)
    return -np.polyfit(t[inside], np.log(length[inside]), 1)[0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("n", [5, 9, 17])
def test_velocity_error_shrinks_at_the_slow_root(n):
    """s² + αs + 0.21α² has the roots −0.3α and −0.7α."""
    alpha, dt = 2.4, 0.02
    errors = errors_of(n, 2 * SMOOTH, alpha, dt)
    assert errors[0, 0] > 0.45
    assert decay(errors, alpha, dt, (1e-6, 1e-3)) == pytest.approx(0.3 * alpha, rel=0.02)


@pytest.mark.exhaustive
def test_curvature_term_takes_the_instability_of_the_flow_out_of_the_error():
    """A gain of a fifth of the vorticity: on an unstable flow only the observer with curvature keeps its rate."""
    n, alpha, dt = 9, 0.8, 0.02
    with_term, without = (errors_of(n, UNSTABLE, alpha, dt, curvature, size=1e-3) for curvature in (True, False))
    assert decay(with_term, alpha, dt, (0, 3e-4)) == pytest.approx(0.3 * alpha, rel=0.1)
    assert without[0, -1] > 10 * without[0, 0]


@pytest.mark.exhaustive
def test_curvature_term_hardly_matters_on_stable_flows_or_at_high_gain():
    n, dt = 9, 0.02
    for stream, alpha in ((4 * np.cos(X1), 1.6), (UNSTABLE, 8.0)):
        last = round(8 / alpha / dt)
        ends = [
            errors_of(n, stream, alpha, dt, curvature, size=1e-3, count=last + 1)[0, last]
            for curvature in (True, False)
        ]
        assert 0.5 < ends[1] / ends[0] < 2


@pytest.mark.exhaustive
def test_estimate_does_not_depend_on_labels():
    n = 5
    h = system(n).group.exp(velocity(n, ROUGH))
    one, other = (errors_of(n, SMOOTH, 2.4, 0.02, labels=labels, count=300) for labels in (None, h))
    np.testing.assert_allclose(one[0], other[0], atol=1e-11)
