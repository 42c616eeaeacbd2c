"""Proofs by compiled C are those by NumPy: the same verdicts and the same trees of boxes."""

import functools
import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st

from scalargraph.intervals import Enclosure
from scalargraph.proofs import box, prove
from scalargraph.proofs._definite import definite, weights
from scalargraph.proofs._enclosure import enclosed_by
from scalargraph.proofs._tests_in_c import CompiledTests, source

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")


@functools.cache
def compiled():
    return CompiledTests()


def margin(z):
    """A matrix with a steep friction, a kink and a quotient, whose intervals are wider than its values."""
    x, y, t = z
    off = 2 * jnp.sin(3 * x) * jnp.cos(3 * x) * jnp.cos(y) + jnp.arctan(20 * t) * jnp.abs(y) / (5 + jnp.cos(3 * t))
    return jnp.array([[1.2 + x**2 / 9, off], [off, 1.2 + jnp.exp(-(x**2)) / 9]])


@pytest.mark.parametrize(
    ("bounds", "verdict"),
    [
        ({"x": (-2.0, 2.0), "y": (-0.3, 0.36), "t": (-0.1, 0.1)}, "holds"),
        ({"x": (-1.0, 1.0), "y": (-0.1, 0.2), "t": (0.02, 0.02)}, "holds"),
        ({"x": (-1.0, 1.0), "y": (-1.0, 6.0), "t": (0.0, 1.0)}, "fails"),
        ({"x": (-1.0, 1.0), "y": (-1.0, 1.0), "t": (0.0, 1.0)}, "undecided"),
    ],
)
def test_verdicts_and_trees_are_those_of_numpy(bounds, verdict):
    domain = box(**bounds)
    c, right = (prove(margin, domain, boxes=250, engine=engine) for engine in ("c", "numpy"))
    assert c.verdict == right.verdict == verdict
    assert [level.tolist() for level in c.levels] == [level.tolist() for level in right.levels]
    np.testing.assert_array_equal(c.open, right.open)
    assert (c.boxes, c.reason) == (right.boxes, right.reason)
    assert verdict == "fails" or c.boxes > 40


ODD = (0.0, -0.0, np.inf, -np.inf, np.nan, 1e-320, 1e300, -1e300)


@settings(max_examples=40, phases=[Phase.explicit, Phase.generate])
@given(st.integers(1, 5), st.integers(0, 4), st.integers(1, 140), st.integers(0, 2**32 - 1))
def test_tests_on_boxes_have_the_same_bits(n, f, boxes, seed):
    rng, k = np.random.default_rng(seed), n * (n + 1) // 2

    def bounds(count):
        low = rng.normal(size=(count, boxes)) * 10.0 ** rng.uniform(-3, 1, (count, 1))
        low[:k] += np.eye(n)[np.tril_indices(n)][:, None] * 4
        high = low + rng.exponential(size=low.shape) * 10.0 ** rng.uniform(-9, 0, boxes)
        for side in (low, high):
            side[rng.random(side.shape) < 0.01] = rng.choice(ODD)
        return Enclosure(low.T, high.T, rng.random(boxes) < 0.9)

    at, on = bounds(k + f * k), bounds(k + f * k + f * (f + 1) // 2 * k)
    half = rng.exponential(size=(f, boxes)) * 0.1
    with np.errstate(all="ignore"):
        right, found = enclosed_by(at, on, half, k), compiled().enclosed(at, on, half, k)
        for a, b in zip(found, right, strict=True):
            np.testing.assert_array_equal(a, b)
        for arguments in ((right.centre, right.rest, right.terms), (right.middle, right.radius)):
            (proved, c), (expected, _) = compiled().definite(*arguments), definite(*arguments)
            np.testing.assert_array_equal(proved, expected)
        ways = (f(c, right.terms, right.shares) for f in (compiled().weights, weights))
        np.testing.assert_array_equal(*ways)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("LARGER(up, down) * (1.0 + ROUND) + TINY", "LARGER(up, down)"),  # a radius that is not rounded up
        ("sum[i] += x[i] * y[i]", "sum[i] -= x[i] * y[i]"),
        ("<= MOST * x[a][i]", "<= 2.0 * x[a][i]"),
    ],
)
def test_tests_that_round_in_another_way_are_refused(monkeypatch, old, new):
    assert old in source()
    monkeypatch.setattr("scalargraph.proofs._tests_in_c.EXACT", ("-std=c99", "-O0", "-fPIC", "-shared"))
    with pytest.raises(OSError, match="in another way than NumPy"):
        CompiledTests(source().replace(old, new))
