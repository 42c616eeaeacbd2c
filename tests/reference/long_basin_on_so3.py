"""How far the observer of Maithripala, Berg & Dayawansa converges on SO(3): the table of docs/maithripala.md.

A free body has no scale of time of its own: with speeds and α times c, and β times c², the same happens c times as
fast. So the speed is 1 rad/s in all runs, and the table is of α by the speed and of β by α².
"""

import re
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant.geometry.lie import SO3
from covariant.models import acceleration, free_body
from covariant.observers import Intrinsic

BODIES = ((1.0, 1.0, 1.0), (1.0, 2.0, 2.5), (1.0, 1.0, 1.9))
GAINS = tuple((alpha, ratio) for alpha in (2.0, 1.0, 0.5, 0.25) for ratio in (0.25, 1.0))
ANGLES = (1.0, 2.0, 3.0, 3.14)
STARTS = 32
UNITS, STEPS = 30, 2400  # time in units of 2/α, the time constant of the double root of β = α²/4
CLOSE = 1e-3  # rad and rad/s together
PAGE = Path(__file__).parents[2] / "docs/maithripala.md"


def gap(x):
    g, v, estimate, w = x
    return jnp.linalg.norm(SO3.between(g, estimate)) + jnp.linalg.norm(w - v)


def nearest_rotation(g):
    return g @ (3 * jnp.eye(3) - g.T @ g) / 2  # by one step of Newton's method, enough after a small step


@jax.jit
@jax.vmap
def advance(x, inertia, alpha, ratio):
    """The state after `UNITS`, the last time at which the error was not `CLOSE`, and the least error."""
    model = free_body(inertia)
    observer, zero, rest = Intrinsic(model, alpha, ratio * alpha**2), jnp.zeros(()), jnp.zeros(3)
    form, h = observer.init(jnp.eye(3)), 2 * UNITS / alpha / STEPS

    def slope(x):
        g, v, estimate, w = x
        rate = observer.flow(zero, form._replace(q=estimate, v=w), rest, g)
        return g @ SO3.hat(v), acceleration(model, zero, g, v, rest), estimate @ SO3.hat(rate.q), rate.v

    def moved(x, k, step):
        return jax.tree.map(lambda a, b: a + step * b, x, k)

    def step(carry, i):
        x, last, least = carry
        stages = [slope(x)]  # of Runge and Kutta
        for part in (h / 2, h / 2, h):
            stages.append(slope(moved(x, stages[-1], part)))
        g, v, estimate, w = jax.tree.map(lambda a, *k: a + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3]), x, *stages)
        x = nearest_rotation(g), v, nearest_rotation(estimate), w
        off = gap(x)
        return (x, jnp.where(off < CLOSE, last, i + 1), jnp.minimum(least, off)), None

    (x, last, least), _ = jax.lax.scan(step, (x, 0.0, jnp.inf), jnp.arange(1.0 * STEPS))
    return x, last * UNITS / STEPS, least


def starts(angles, velocity_error):
    """States for all bodies, gains, angles and starts, as one batch: speed 1 rad/s."""
    random = np.random.default_rng(0)
    g, axis, v, off = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in random.normal(size=(4, STARTS, 3)))
    shape = (len(BODIES), len(GAINS), len(angles), STARTS)
    b, k, a, s = (i.ravel() for i in np.indices(shape))
    g, e, v, off = jnp.asarray(g[s]), jnp.asarray(np.asarray(angles)[a, None] * axis[s]), jnp.asarray(v[s]), off[s]
    turn = jax.jit(jax.vmap(SO3.exp))
    at = turn(2 * g)
    w = 0 * v if velocity_error is None else v + velocity_error * off
    alpha, ratio = np.asarray(GAINS).T
    arguments = jnp.asarray(BODIES)[b], jnp.asarray(alpha[k]), jnp.asarray(ratio[k])
    return (at, v, at @ turn(e), w), arguments, shape


@cache
def from_rest():
    x, arguments, shape = starts(ANGLES, None)
    x, last, least = advance(x, *arguments)
    return x, arguments, np.asarray(last).reshape(shape), np.asarray(least)


def table():
    """Rows of the page: α by the speed, β/α², and for each body how many converge, with the latest time if all do."""
    _, _, last, _ = from_rest()
    rows = []
    for k, (alpha, ratio) in enumerate(GAINS):
        counts = (last[:, k] < UNITS).sum(axis=(1, 2))
        rows.append((alpha, ratio, counts, last[:, k].max(axis=(1, 2))))
    return rows


@pytest.mark.exhaustive
def test_the_table_says_where_it_converges_and_within_which_time():
    """Motions that do not converge are chaotic, so that another processor may count one or two others."""
    written = re.findall(r"^\| ([\d.]+) \| ([\d.]+) \| (.*) \|$", PAGE.read_text(), re.MULTILINE)
    computed = table()
    assert len(written) == len(computed)
    for (alpha, ratio, cells), (*gains, counts, latest) in zip(written, computed, strict=True):
        assert [float(alpha), float(ratio)] == gains
        for cell, count, time in zip(cells.split(" | "), counts, latest, strict=True):
            if cell.startswith("all"):
                assert count == len(ANGLES) * STARTS
                assert float(cell.split()[2]) == pytest.approx(time, rel=0.1)
            else:
                assert int(cell) == pytest.approx(count, abs=3)


@pytest.mark.exhaustive
def test_a_small_angle_helps_little_if_the_velocity_is_unknown():
    failures = (from_rest()[2] >= UNITS).sum(axis=(0, 1, 3))
    assert failures[0] > 0.7 * failures[-1]


@pytest.mark.exhaustive
def test_what_has_not_converged_by_then_seldom_converges_later_and_else_never_comes_near():
    x, arguments, last, _ = from_rest()
    late = last.ravel() >= UNITS
    rest = [a[late] for a in arguments]
    x, least = jax.tree.map(lambda a: a[late], x), np.inf
    for _ in range(3):
        x, last, nearest = (jax.tree.map(np.asarray, a) for a in advance(x, *rest))
        least = np.minimum(least, nearest)
    later = last < UNITS
    assert later.sum() < 0.1 * len(later)
    assert least[~later].min() > 0.3


@pytest.mark.exhaustive
def test_from_small_errors_of_both_it_converges_for_every_gain():
    """The linear law has s² + αs + β at any speed; 0.01 rad and 0.01 rad/s are small enough for all gains here."""
    x, arguments, _ = starts((0.01,), 0.01)
    assert np.asarray(advance(x, *arguments)[1]).max() < 10


def test_half_a_turn_has_two_logarithms():
    """At exactly π the error of the observer is not defined; a little less is, and converges, see the table."""
    turn = jnp.diag(jnp.array([1.0, -1.0, -1.0]))
    assert not SO3.unique_log(turn)
    assert SO3.unique_log(SO3.exp(jnp.array([3.14, 0.0, 0.0])))
    np.testing.assert_allclose(SO3.exp(-SO3.log(turn)), turn, atol=1e-12)
