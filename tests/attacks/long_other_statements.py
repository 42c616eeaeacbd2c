"""What takes long of `test_other_statements.py`."""

import os

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from systems import linear

from covariant.certificates import at_corners, cascade, common_metric, decay, observability, observer_gain
from covariant.certificates.base import in_coordinates
from covariant.models import StateSpace
from scalargraph.proofs import as_form, box

COUNT = int(os.environ.get("COVARIANT_ATTACKS", "8"))


def random_metric(rng, n: int) -> np.ndarray:
    """Mostly positive definite; one in four has a negative direction."""
    a = rng.normal(size=(n, n))
    return a @ a.T + 0.1 * np.eye(n) - (rng.uniform() < 0.25) * 8 * np.diag(np.eye(n)[0])


def holds_in_one_of(count: int, verdicts: list[str]) -> None:
    """A generator whose statements never hold, or always do, attacks nothing."""
    assert 0 < verdicts.count("holds") < count, verdicts


@pytest.mark.parametrize("proved", [False, True])
def test_a_cascade_that_holds_is_stable(proved):
    """By the eigenvalues of plant and observer together, a linear system."""
    verdicts = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 3))
        plant, error, through = rng.normal(size=(3, n, n))
        plant, error = plant - rng.uniform(0, 3) * np.eye(n), error - rng.uniform(0, 3) * np.eye(n)
        itself = rng.uniform(0, 1) * rng.normal(size=(n, n))
        metrics = [random_metric(rng, n) for _ in range(2)]
        if seed % 2:  # those that fit
            metrics = [scipy.linalg.solve_continuous_lyapunov(a.T, -np.eye(n)) for a in (plant, error)]
        found = cascade(
            (linear(plant, metrics[0]), box(d=(0.0, 1.0))),
            (linear(error, metrics[1]), box(d=(0.0, 1.0))),
            (lambda z, b=through, c=itself: (jnp.asarray(b), jnp.asarray(c)), box(k=(0.0, 1.0))),
            proved=proved,
            attempts=500,
            starts=8,
        )
        verdicts.append(found.verdict)
        whole = np.block([[plant + itself, through], [np.zeros((n, n)), error]])
        grows = np.linalg.eigvals(whole).real.max()
        assert found.verdict != "holds" or grows < 0, (seed, grows, str(found))
        assert found.verdict != "fails" or np.linalg.eigvalsh(metrics[1])[0] < 0 or grows > -10
        if found.verdict == "holds":  # the weight that it gives makes one function of both decrease
            kappa = 1.01 * found.kappa + 1e-9
            p = scipy.linalg.block_diag(metrics[0] / 2, kappa * metrics[1])
            assert np.linalg.eigvalsh(whole.T @ p + p @ whole)[-1] < 1e-9, seed
    holds_in_one_of(COUNT, verdicts)


@pytest.mark.exhaustive
def test_what_is_observable_has_an_observer_that_converges():
    """With a large gain along P⁻¹ dh, as inequality (2) promises; near each of the points, by eigenvalues."""
    verdicts = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        n, p = int(rng.integers(2, 4)), int(rng.integers(1, 3))
        a, c = rng.normal(size=(n, n)) - rng.uniform(0, 2.5) * np.eye(n), rng.normal(size=(p, n))
        bend = rng.choice([0.0, 0.3]) * rng.normal(size=(n, n))
        b = rng.normal(size=(n, n))
        metric = jnp.asarray(b @ b.T + 0.2 * np.eye(n))
        model = StateSpace(
            lambda t, x, u, a=a, bend=bend: jnp.asarray(a) @ x + jnp.asarray(bend) @ jnp.sin(x),
            lambda t, x, u, c=c: jnp.asarray(c) @ x,
            coordinates=tuple(f"x{k}" for k in range(n)),
        )
        points = rng.uniform(-1, 1, (5, n))
        found = observability(model, lambda x, m=metric: m, points)
        verdicts.append(found.condition_1.verdict)
        for x in points:
            slope = a + bend * np.cos(x)[None]
            closed = slope - 1e6 * np.linalg.solve(np.asarray(metric), c.T @ c)
            if found.condition_1.verdict == "holds":
                assert np.linalg.eigvals(closed).real.max() < 0, (seed, found.verdict)
    holds_in_one_of(COUNT, verdicts)


@pytest.mark.exhaustive
def test_decay_says_of_linear_flows_what_exponentials_of_matrices_say():
    verdicts = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, 4))
        a, b = rng.normal(size=(2, n, n))
        a, form = a - rng.uniform(1, 3) * np.eye(n), b @ b.T + 0.3 * np.eye(n)
        t, starts = np.linspace(0.0, 2.0, 9), rng.normal(size=(2, 4, n))
        rate = rng.uniform(0.2, 1.5) * -2 * np.linalg.eigvals(a).real.max()
        found = decay(
            lambda t, x, a=a: jnp.asarray(a) @ x,
            in_coordinates(lambda t, x, form=form: jnp.asarray(form)),
            rate,
            *map(jnp.asarray, starts),
            jnp.asarray(t),
        )
        moved = np.einsum("tij,kj->kti", np.stack([scipy.linalg.expm(a * s) for s in t]), starts[1] - starts[0])
        lengths = np.sqrt(np.einsum("kti,ij,ktj->kt", moved, form, moved))
        share = (lengths / (lengths[:, :1] * np.exp(-rate * t / 2))).max()
        verdicts.append(found.statement.verdict)
        if abs(share - 1) > 1e-5:
            assert found.holds == (share < 1), (seed, share)
    holds_in_one_of(COUNT, verdicts)


@pytest.mark.exhaustive
def test_a_matrix_that_holds_at_corners_is_definite_between_them():
    """At 300 points; what is not affine is refused in `test_premises.py`."""
    verdicts = []
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        constant, first, second, other = rng.normal(size=(4, 3, 3))
        constant = constant @ constant.T + rng.uniform(0, 3) * np.eye(3)
        first, second, other = (x + x.T for x in (first, second, other))

        def matrix(z, parts=(constant, first, second, other)):
            a, b, c = z
            return parts[0] + parts[1] * a * jnp.cos(c) + parts[2] * b + parts[3] * jnp.sin(c)

        region = box(a=(-0.5, 0.5), b=(-0.5, 0.5), c=(-1.0, 1.0))
        found = at_corners(as_form(matrix), region, ("a", "b"), "", boxes=2000).statement
        verdicts.append(found.verdict)
        points = rng.uniform(-1, 1, (300, 3)) * np.array([0.5, 0.5, 1.0])
        least = np.linalg.eigvalsh(np.stack([np.asarray(matrix(z)) for z in jnp.asarray(points)])).min()
        assert found.verdict != "holds" or least > 0, (seed, least)
        assert found.verdict != "fails" or least < 0.5
    holds_in_one_of(COUNT, verdicts)


def test_a_metric_for_many_jacobians_contracts_however_they_are_switched():
    designed = 0
    for seed in range(COUNT):
        rng = np.random.default_rng(seed)
        k, n = int(rng.integers(2, 5)), int(rng.integers(2, 4))
        f = 0.6 * rng.normal(size=(k, n, n)) - rng.uniform(0.5, 2) * np.eye(n)
        h = rng.normal(size=(k, 1, n))
        rate = rng.uniform(-0.5, 2)
        try:
            design = common_metric(f, rate) if seed % 2 else observer_gain(f, h, rate)
        except ValueError:
            continue
        designed += 1
        assert design.statement.proved, str(design.statement)
        closed = f if seed % 2 else f - design.gain @ h
        error = rng.normal(size=n)
        for _ in range(60):
            step, share = rng.exponential(0.3), rng.dirichlet(np.ones(k))
            moved = scipy.linalg.expm(np.tensordot(share, closed, 1) * step) @ error
            before, after = (x @ design.metric @ x for x in (error, moved))
            assert after <= before * np.exp(-rate * step) * (1 + 1e-9), seed
            error = moved / np.linalg.norm(moved)
    assert designed > 0
