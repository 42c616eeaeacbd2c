"""The exact observer (2): its distance from (5), against the true flows of both, and its certificate against starts."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from forging import forged, put, together

from covariant import models, observers
from covariant.certificates import ContractionCertificate, certify, check, optimal_lyapunov, tangent_metric
from covariant.certificates.base import UNPROVED, Remainder, RemainderClaim
from covariant.certificates.base._remainder import gain_length
from covariant.certificates.checking import _matrices
from covariant.geometry import Budget
from covariant.models import applied_force
from scalargraph.errors import InputError

BEAM, ZERO = models.ball_and_beam(), jnp.zeros(())
FAST, SLOW = (8.0, 32.0), (0.1, 0.01)
RUNGE_KUTTA = jnp.array([[0.0, 1.0], [0.5, 2.0], [0.5, 2.0], [1.0, 1.0]])
"""How far along the last slope each of the four slopes is taken, and its weight in sixths."""
REGION = {"position": (-0.3, 0.3), "velocity": 0.3, "error": 0.05, "input": 0.5}


@pytest.fixture(scope="module")
def certificate():
    recipe = models.recipe("ball_and_beam")
    return certify(observers.Geodesic(BEAM, *FAST), **REGION, recipe=recipe, checker="off")


def norms(space, q, v, f):
    """The lengths of the five tensors at a point, by textbook formulas in coordinates and singular values."""

    def christoffel(q):
        slope = jax.jacfwd(space)(q)
        first = (slope.transpose(1, 0, 2) + slope.transpose(1, 2, 0) - slope.transpose(2, 0, 1)) / 2
        return jnp.einsum("kl,lij->kij", jnp.linalg.inv(space(q)), first)

    def curved(q):
        gamma, slope = christoffel(q), jax.jacfwd(christoffel)(q)
        half = jnp.einsum("kwzu->kzuw", slope) + jnp.einsum("kum,mwz->kzuw", gamma, gamma)
        return jnp.einsum("kzuw,w,z->ku", half - half.transpose(0, 1, 3, 2), v, v)

    root = jnp.linalg.cholesky(space(q))

    def size(tensor):
        tensor = jnp.tensordot(root.T, tensor, 1)
        for axis in range(1, tensor.ndim):
            tensor = jnp.moveaxis(jnp.tensordot(tensor, jnp.linalg.inv(root).T, (axis, 0)), -1, axis)
        return jnp.linalg.norm(tensor.reshape(len(q), -1), 2)

    source = jnp.linalg.solve(space(q), f)
    parts = christoffel(q), jax.jacfwd(christoffel)(q), source, curved(q), jax.jacfwd(curved)(q)
    return jnp.stack([size(part) for part in parts])


@functools.cache
def flows(model, curvature):
    """|f₂ − f₅|_G/d² and d of the true flows at a point, and the lengths of the tensors there."""

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, None, 0, 0, 0, 0))
    def at(gains, matrix, q, near, v, u):
        exact = observers.Geodesic(model, *gains, Budget(), curvature=curvature)
        close = observers.Intrinsic(model, *gains)
        first, second = (o.flow(ZERO, o.init(near)._replace(q=near, v=v, t=ZERO), u, q) for o in (exact, close))
        gap = jnp.concatenate([first.q - second.q, first.v - second.v])
        xi, zeta = gap[: len(q)], gap[len(q) :] + model.space.connection(near, v, gap[: len(q)])
        frame = jnp.stack([xi, zeta])
        d = model.space.norm(near, (first.q - v) / exact.alpha)
        length = jnp.sqrt(jnp.sum(matrix * (frame @ model.space(near) @ frame.T)) / 2)
        f = applied_force(model, ZERO, q, u)
        return length / d**2, d, jnp.maximum(norms(model.space, q, v, f), norms(model.space, near, v, f))

    return at


def sampled(model, gains, low, high, error, speed, push, curvature=True, count=1000):
    """Their largest values at random points, after Q."""
    rng, n = np.random.default_rng(0), len(low)
    q = rng.uniform(low, high, (count, n))
    near, v = q + error * rng.uniform(-1, 1, (count, n)), speed * rng.uniform(-1, 1, (count, n))
    u = push * rng.uniform(-1, 1, (count, 1))
    matrix = optimal_lyapunov(*gains, -4 / 3 * np.roots([1.0, *gains]).real.max())
    at = flows(model, curvature)
    return matrix, *(np.asarray(each).max(0) for each in at(jnp.array(gains), matrix, q, near, v, u))


def bound(gains, matrix, sizes, d):
    """L₂ from the lengths of the tensors."""
    radius = d / np.sqrt(2 * matrix[1, 1] / np.linalg.det(matrix))
    claims = [RemainderClaim(UNPROVED, row, float(size) ** 2 + 1e-300) for row, size in enumerate(sizes)]
    remainder = Remainder.of(gains, matrix, claims, radius)
    assert remainder.rate < np.inf
    return remainder.rate * radius / d**2


# Where the term of a tensor is most of L₂: without it the bound is violated.
PLACES = {
    "the logarithm": ((0,), models.oscillator("r"), FAST, (1.0,), (1.05,), 0.05, 0.1, 0.1),
    "the transport": ((1, 2), BEAM, SLOW, (-0.01, -0.3), (0.01, 0.3), 0.05, 0.01, 20.0),
    "the curvature": ((4,), BEAM, SLOW, (0.5, -0.3), (0.51, 0.3), 0.02, 3.0, 0.5),
}


@pytest.mark.long
@pytest.mark.parametrize("name", PLACES)
def test_the_flows_differ_by_no_more_than_the_bound_and_by_more_without_its_term(name):
    rows, model, gains, *where = PLACES[name]
    matrix, ratio, d, sizes = sampled(model, gains, *where)
    assert 0.4 * bound(gains, matrix, sizes, d) < ratio <= bound(gains, matrix, sizes, d)
    for row in rows:
        assert ratio > bound(gains, matrix, np.where(np.arange(5) == row, 0.0, sizes), d)


@pytest.mark.long
def test_half_of_the_bound_and_another_curvature_term_are_noticed():
    _, model, gains, *where = PLACES["the logarithm"]
    matrix, ratio, d, sizes = sampled(model, gains, *where)
    assert ratio > bound(gains, matrix, sizes, d) / 2
    matrix, ratio, d, sizes = sampled(BEAM, FAST, (-0.3, -0.3), (0.3, 0.3), 0.01, 0.3, 0.5, curvature=False)
    assert ratio > bound(FAST, matrix, sizes, d)


@pytest.mark.long
def test_the_exact_observer_has_a_certificate(certificate):
    statement = certificate.statement
    assert statement.short == "holds (proved)"
    assert certificate.rate / 4 <= certificate.decay < certificate.rate / 2
    premise = next(h.text for h in statement.hypotheses if "`info.distance`" in h.text)
    remainder = Remainder.of(FAST, certificate.q, certificate.claims, certificate.radius)
    assert f"shorter than {remainder.distance:.4g}" in premise
    assert f"adds {gain_length(FAST, certificate.q):.4g} r to the flow" in premise
    matrix, ratio, d, sizes = sampled(BEAM, FAST, (-0.3, -0.3), (0.3, 0.3), 0.03, 0.3, 0.5)
    np.testing.assert_allclose(matrix, certificate.q)
    assert d < remainder.distance
    assert 0.3 < ratio * remainder.distance**2 / certificate.radius / remainder.rate < 1
    squares = [claim.square for claim in certificate.claims if isinstance(claim, RemainderClaim)]
    assert (sizes <= np.sqrt(squares)).all()


@pytest.mark.long
def test_its_file_is_checked_with_the_same_tensors_formed_anew(certificate, tmp_path, monkeypatch):
    path = certificate.save(tmp_path / "exact.json")
    assert check(path).statement.claim == certificate.statement.claim
    read = ContractionCertificate.load(path)
    assert isinstance(read.observer, observers.Geodesic)
    assert read.decay == certificate.decay
    pretended = {"kind": "disturbance", "square": 1.0, "levels": ["."]}
    disturbed = together(
        put("given.disturbance", [0.1, 0.1]), put("claims", lambda claims: [*claims[:10], pretended, *claims[10:]])
    )
    with pytest.raises(InputError, match="given: noise and disturbance are not covered"):
        check(forged(path, tmp_path, disturbed))
    # A prover that forgets what the observers differ by is contradicted by the checker's own sum.
    monkeypatch.setattr(Remainder, "of", classmethod(lambda cls, *_: cls()))
    with pytest.raises(InputError, match="radius: the exact observer may lose"):
        check(path)


@pytest.mark.parametrize("row", range(5))
@pytest.mark.long
def test_a_tensor_that_is_longer_than_a_file_says_is_refused(certificate, tmp_path, row):
    path = certificate.save(tmp_path / "exact.json")
    with pytest.raises(InputError, match=rf"claims\[{5 + row}\]"):
        check(forged(path, tmp_path, put(f"claims[{5 + row}].square", lambda square: square / 2)))


def test_prover_and_checker_have_the_same_sum(certificate):
    assert certificate.statement.short == "holds (proved)"
    bounds = [float(np.sqrt(claim.square)) for claim in certificate.claims if isinstance(claim, RemainderClaim)]
    gains = {"alpha": FAST[0], "beta": FAST[1]}
    document = SimpleNamespace(q=certificate.q, radius=certificate.radius, observer=gains)
    remainder = Remainder.of(FAST, certificate.q, certificate.claims, certificate.radius)
    assert _matrices.remainder_rate(document, bounds) == pytest.approx(remainder.rate, rel=1e-4)
    # Where K d or K'd² is so large that a second geodesic may lead to the measurement, both say nothing.
    for sizes in ((3.0, 0.01, 0, 0, 0), (0.01, 1e3, 0, 0, 0), (100.0, 0.01, 0, 0, 0)):
        claims = [RemainderClaim(UNPROVED, row, size**2) for row, size in enumerate(sizes)]
        assert Remainder.of(FAST, certificate.q, claims, 0.1).rate == np.inf
        assert _matrices.remainder_rate(SimpleNamespace(**vars(document) | {"radius": 0.1}), list(sizes)) == np.inf


def starts(certificate, count, seed=0):
    """The largest share of the bound `ε e^(−μt)` that distances of estimates from their motions take, from the border.

    Distances are lengths of straight lines, which are no shorter, by fixed Runge–Kutta steps.
    """
    rng, radius, n = np.random.default_rng(seed), certificate.radius, 2
    metric = tangent_metric(BEAM.space, certificate.q)
    observer = certificate.observer
    dt, steps = 0.02, 50

    def distance(a, b):
        nodes, weights = np.polynomial.legendre.leggauss(3)
        points = [b + (a - b) * (1 + s) / 2 for s in nodes]
        return sum(w / 2 * jnp.sqrt((a - b) @ metric(ZERO, p) @ (a - b)) for w, p in zip(weights, points, strict=True))

    @jax.jit
    @jax.vmap
    def follow(truth, direction, u):
        step = 1e-6 * direction
        for _ in range(4):
            step = step * radius / distance(truth + step, truth)
        begin, start = truth + step, observer.init(truth[:n])

        def rate(both):
            x, state = both
            f = applied_force(BEAM, ZERO, x[:n], u)
            moved = jnp.concatenate([x[n:], BEAM.space.acceleration(x[:n], x[n:], f)])
            return moved, observer.flow(ZERO, state, u, x[:n])

        def advance(both, _):
            def after(k, h):
                return jax.tree.map(lambda a, b: a + h * b, both, k)

            def stage(carry, numbers):
                slope, total = carry
                slope = rate(after(slope, numbers[0] * dt))
                return (slope, jax.tree.map(lambda a, b: a + numbers[1] / 6 * b, total, slope)), None

            nothing = jax.tree.map(jnp.zeros_like, both)
            (_, slope), _ = jax.lax.scan(stage, (nothing, nothing), RUNGE_KUTTA)
            both = after(slope, dt)
            x, state = both
            inside = (jnp.abs(x[:n]) <= REGION["position"][1]).all() & (jnp.abs(x[n:]) <= REGION["velocity"]).all()
            return both, (distance(jnp.concatenate([state.q, state.v]), x), inside)

        _, (d, inside) = jax.lax.scan(advance, (truth, start._replace(q=begin[:n], v=begin[n:])), None, steps)
        return jnp.where(jnp.cumprod(inside), d, 0.0), inside.sum()

    truth = np.concatenate([rng.uniform(-0.25, 0.25, (count, n)), rng.uniform(-0.2, 0.2, (count, n))], axis=1)
    truth, direction = jnp.asarray(truth), jnp.asarray(rng.normal(size=(count, 2 * n)))
    d, inside = follow(truth, direction, jnp.asarray(rng.uniform(-0.5, 0.5, (count, 1))))
    assert np.mean(np.asarray(inside)) > 5
    allowed = radius * np.exp(-certificate.decay * dt * np.arange(1, steps + 1))
    return float((np.asarray(d) / allowed).max())


@pytest.mark.long
@pytest.mark.parametrize("kind", [observers.Geodesic, observers.Intrinsic])
def test_no_start_within_the_radius_converges_slower_than_claimed(certificate, kind):
    proved = certificate if kind is observers.Geodesic else certify(kind(BEAM, *FAST), **REGION, checker="off")
    assert 0.1 < starts(proved, 200) <= 1


@pytest.mark.exhaustive
def test_none_of_a_hundred_thousand_starts_converges_slower_than_claimed(certificate):
    assert max(starts(certificate, 10_000, seed) for seed in range(1, 11)) <= 1


def test_what_is_not_covered_is_refused_and_too_large_a_difference_is_undecided():
    observer = observers.Geodesic(BEAM, *FAST)
    for bounds in ({"noise": 0.001}, {"disturbance": 0.1}):
        with pytest.raises(InputError, match="not covered for Geodesic; leave them out, or certify Intrinsic"):
            certify(observer, **REGION, **bounds)
    statement = certify(observer, **REGION, rate=0.004, checker="off").statement
    assert statement.verdict == "undecided"
    assert "ask for a higher rate, give a smaller velocity, error, position or input" in statement.claim
