"""The checker's arithmetic encloses what it says, shares nothing with the prover, and a mistake in it is found out."""

import ast
import functools
import math
import types
from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from scalargraph import lower, stumpff
from scalargraph.proofs import checker
from scalargraph.proofs._models import polynomials
from scalargraph.proofs.checker import TaylorEnclosure, show_definite
from scalargraph.proofs.checker._definite import definite
from scalargraph.proofs.checker._taylor import UndecidedError, number

FOLDER = Path(checker.__file__).parent
FILES = [FOLDER / f"_{name}.py" for name in ("taylor", "primitives", "tree", "enclosure", "definite")]


def alone(file):
    """A source without what it imports from the other files."""
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    for node in ast.parse("".join(lines)).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("scalargraph.proofs.checker"):
            lines[node.lineno - 1 : node.end_lineno] = [""] * (node.end_lineno - node.lineno + 1)
    return "".join(lines)


def in_one_module(text):
    module = types.ModuleType("one")
    exec(compile(text, "one", "exec"), module.__dict__)
    return module


TEXT = "".join(map(alone, FILES))
CHECKER = in_one_module(TEXT)
"""All of the arithmetic in one module, in which one place can be changed for all the others."""


# Enclosures hold the functions, and a source with a mistake in it is found out.


def loop(z):
    """Through the entries and back: what is carried on, what is kept at each, and what stays as it is."""

    def step(total, x):
        return total / 2 + x * z[1], total - x

    total, kept = jax.lax.scan(step, z[0], z)
    total, kept = jax.lax.scan(step, total, kept, reverse=True)
    return total + kept @ jnp.array([1.0, 2.0, 3.0])


SCALARS = {
    "quotient of choices": lambda z: (
        jnp.where(z[0] < 0, 0.0, 1.0) / jnp.where(z[1] < 0, 1.0, 2.0) * jnp.maximum(z[2], 0)
    ),
    "product of kinks": lambda z: -3 * jnp.abs(z[0]) * z[1] * jnp.minimum(z[2], 0.1) + jnp.exp(jnp.abs(z[1])),
    "product": lambda z: z[0] * z[1] * z[2] + z[0] ** 3,
    "quotient": lambda z: (z[0] + z[1]) / (3 + z[2] * z[0]),
    "power": lambda z: (2.5 + z[1]) ** -2,
    "sine": lambda z: jnp.sin(40 + 2 * z[0] + z[1] * z[2]),
    "cosine": lambda z: jnp.cos(z[0] * z[1] - z[2]),
    "root": lambda z: jnp.sqrt(2.2 + z[0] * z[1] + z[2]),
    "exponential": lambda z: jnp.exp(z[0] - z[1] ** 2) + jnp.tanh(z[2]),
    "logarithm": lambda z: jnp.log(3 + z[0] + z[1] * z[2]),
    "hyperbolic": lambda z: jnp.sinh(z[0]) * jnp.cosh(z[1]) + jnp.expm1(z[2]) - jax.nn.sigmoid(z[0] - z[1]),
    "powers": lambda z: (2 + z[0]) ** z[1] + jax.lax.rsqrt(2 + z[2]) + jnp.log1p(z[0] / 2) + jnp.tan(z[1]),
    "angle": lambda z: jnp.arctan(3 * z[0]) + jnp.arctan2(z[1], 2 + z[2]),
    "matrix": lambda z: (jnp.outer(z, z) @ jnp.eye(3) @ jnp.diag(z)).T[0].sum() + z[::-1][jnp.array([0, 2])] @ z[:2],
    "trigonometric or hyperbolic": lambda z: sum(stumpff(k, 4 + 4 * z[0] + z[1] * z[2]) for k in range(3)),
    "loop": loop,
    "kinks": lambda z: jnp.abs(z[0] - 0.3) * jnp.sign(z[1]) + jnp.maximum(z[0], z[1]) - jnp.clip(z[2], -0.2, 0.2),
    "clamped": lambda z: jax.lax.clamp(-0.3, z[0], 0.2) + jax.lax.clamp(-0.2, z[1] * z[2], 0.1),
    "branches": lambda z: jnp.where((z[0] < 0) & ~(z[1] >= z[2]) | jnp.any(z > 0.5), z[1], 0.2) + jnp.floor(z[0] + 0.4),
    "choice": lambda z: jnp.where(jnp.isnan(z[0]) | (z[1] > 5), z[2], z[jnp.argmax(z + jnp.array([0.0, 9.0, 0.0]))]),
}
BENT = ("kinks", "clamped", "branches", "quotient of choices", "product of kinks")
WIDTHS = (0.0, 1e-9, 0.03, 0.4)


@functools.cache
def places():
    """Boxes within ±1 (B, 3) of several widths, and points in each, at corners too (B, k, 3) of ±1."""
    rng = np.random.default_rng(5)
    half = np.repeat(np.array(WIDTHS), 12)[:, None] * rng.uniform(0.3, 1.0, (48, 3))
    middle = rng.uniform(-0.6, 0.6, (48, 3))
    points = rng.uniform(-1, 1, (48, 24, 3))
    points[:, ::2] = np.sign(points[:, ::2])
    return middle - half, middle + half, points


@functools.cache
def values(name):
    """The function at these points, in doubles."""
    low, high, points = places()
    z = low[:, None] / 2 + high[:, None] / 2 + points * (high - low)[:, None] / 2
    return np.asarray(jnp.vectorize(SCALARS[name], signature="(n)->()")(jnp.asarray(z)))


def basis(m, e):
    """What the term m of a Taylor model stands for, at e (B, k, 3)."""
    return 2 * e[..., m[0]] ** 2 - 1 if len(m) == 2 and m[0] == m[1] else np.prod([e[..., i] for i in m], axis=0)


def beyond(module, name):
    """How far values are outside of what the module says about them; no more than zero if it is right."""
    low, high, e = places()
    whole = -np.ones(3), np.ones(3)
    found = module.TaylorEnclosure(SCALARS[name], *whole, np.zeros(3))(low, high)[()]
    inside = e / (1 + 2.0**-40)  # boxes are enlarged by their rounding
    model = sum(np.reshape(t, (-1, 1)) * basis(m, inside) for part in found.terms for m, t in part.items())
    with np.errstate(invalid="ignore"):
        return np.abs(values(name) - model) - np.reshape(found.radius, (-1, 1)) - 2.0**-50  # doubles are off themselves


@pytest.mark.core(2)
@pytest.mark.parametrize("name", SCALARS)
def test_taylor_models_hold_the_function_and_say_something_about_it(name):
    assert beyond(CHECKER, name).max() <= 0
    low, high, _ = places()
    found = TaylorEnclosure(SCALARS[name], -np.ones(3), np.ones(3), np.zeros(3))(low, high)[()]
    radius = np.broadcast_to(found.radius, len(low))
    thin, wide = radius[:12], radius[24:36]
    assert thin.max() < 1e-9
    assert wide.max() < (1.5 if name in BENT else 3e-2)  # of third order in the width


def test_remainders_are_of_third_order():
    low, high, _ = places()
    sizes = []
    for share in (0.2, 0.1):
        box = (low + high) / 2 - share * (high - low) / 2, (low + high) / 2 + share * (high - low) / 2
        found = TaylorEnclosure(SCALARS["quotient"], -np.ones(3), np.ones(3), np.zeros(3))(*box)[()]
        sizes.append(found.radius[36:].mean())
    assert 6 < sizes[0] / sizes[1] < 10


ERRORS = {"sin": 1, "log": 1, "exp": 0, "atan": 0, "sqrt": 0, "inv": 0}  # absolute or relative
FUNCTIONS = {"sin": mpmath.sin, "log": mpmath.log, "exp": mpmath.exp, "atan": mpmath.atan, "sqrt": mpmath.sqrt}


def worst(module, name):
    """The largest error of a function at points, as a part of what it may be."""
    rng = np.random.default_rng(3)
    x = np.concatenate([rng.uniform(-1, 1, 40), rng.uniform(-999, 999, 60), 10.0 ** rng.uniform(-300, 149, 60)])
    x = np.concatenate([x, math.pi / 2 * np.arange(-12, 13), 2.0 ** np.arange(-30, 30)])
    x = x[abs(x) < 700] if name == "exp" else x[abs(x) < 999] if name == "sin" else x
    x = x[x > 0] if name in ("log", "sqrt", "inv") else x
    x = x[x != 0]
    with mpmath.workdps(40), np.errstate(all="ignore"):
        true = [FUNCTIONS.get(name, lambda v: 1 / v)(mpmath.mpf(v)) for v in x.tolist()]
        found = module.points(name, x)
        allowed = [2.0**-41 * max(abs(t), 1) if ERRORS[name] else 2.0**-41 * abs(t) for t in true]
        return max(float(abs(f - t) / a) for f, t, a in zip(found.tolist(), true, allowed, strict=True))


@pytest.mark.parametrize("name", ERRORS)
def test_elementary_functions_are_as_near_as_stated(name):
    assert worst(CHECKER, name) < 1


FLOATS = st.floats(-1e3, 1e3).filter(lambda x: x == 0 or abs(x) > 1e-200)


@settings(max_examples=40)
@given(st.lists(FLOATS, min_size=4, max_size=4))
def test_thin_sums_and_products_hold_the_exact_ones(numbers):
    assert exact_gap(CHECKER, numbers) <= 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_floor_of_what_may_be_just_below_an_integer_holds_both(sign):
    found = CHECKER.floor(CHECKER.number(np.array([sign * 3.0]), np.array([1e-18])))
    low, high = (float((found.middle + end * found.radius)[0]) for end in (-1, 1))
    assert low <= sign * 3.0 - 1
    assert high >= sign * 3.0
    assert CHECKER.floor(CHECKER.exact(3.0)).middle == 3.0


def exact_gap(module, numbers):
    a, b, c, d = map(Fraction, numbers)
    z = [module.number(np.array([x])) for x in numbers]
    found = z[0] * z[1] + z[2] * z[3] - z[0]
    return abs(Fraction(float(found.middle[0])) - (a * b + c * d - a)) - Fraction(float(found.radius[0]))


def test_sums_and_products_are_no_less_exact_than_they_must_be():
    a, b = number(np.array([1.0]), 1e-3), number(np.array([2.0]), 2e-3)
    ends = {"sum": (2.997, 3.003), "difference": (-1.003, -0.997), "product": (0.999 * 1.998, 1.001 * 2.002)}
    for found, (low, high) in zip((a + b, a - b, a * b), ends.values(), strict=True):
        np.testing.assert_allclose([found.middle - found.away, found.middle + found.away], [[low], [high]], rtol=1e-8)
        assert found.middle - found.away <= low < high <= found.middle + found.away


INDEFINITE = {
    "touches zero": (lambda z: jnp.diag(jnp.stack([1 - z[0], 2 + z[1]])), 1.0),
    "singular": (lambda z: jnp.array([[1.0, 1 / 3], [1 / 3, 1 / 9]]) * (2 + z[0] * z[1]), 0.1),
    "turned": (lambda z: jnp.array([[1.0, 1.0], [1.0, 1.0]]) * z[0] + jnp.eye(2) * (1 + z[1] / 4), 0.7),
    "far terms": (lambda z: jnp.diag(jnp.stack([jnp.cos(1.7 * z[0]), 2 + z[1]])), 1.0),
    "cubic": (lambda z: jnp.diag(jnp.stack([1 - 1.2 * z[0] ** 3, 2 + z[1]])), 1.0),
    "bent": (lambda z: jnp.diag(jnp.stack([1 - 1.05 * z[0] ** 2, 1 + 0 * z[1]])), 1.0),
}


def proves(module, name):
    matrix, half = INDEFINITE[name]
    low, high = -half * np.ones((1, 2)), half * np.ones((1, 2))
    enclosure = module.TaylorEnclosure(matrix, low[0], high[0], np.zeros(2))
    return bool(module.definite(enclosure(low, high), high - low, enclosure.kinks(), np.ones_like(low))[0][0])


@pytest.mark.parametrize("name", INDEFINITE)
def test_no_matrix_that_is_not_definite_is_shown_to_be(name):
    assert not proves(CHECKER, name)


def test_matrices_that_are_definite_are_shown_to_be_after_halving():
    def matrix(z):
        return jnp.diag(jnp.stack([z[0] ** 4 - z[0] ** 2 + 0.3, 2 + z[1]]))

    low, high = np.array([[-2.0, -1.0]]), np.array([[2.0, 1.0]])
    enclosure = TaylorEnclosure(matrix, low[0], high[0], np.zeros(2))
    good, axis = definite(enclosure(low, high), high - low, enclosure.kinks(), np.ones_like(low))
    assert (good[0], axis[0]) == (False, 0)
    show_definite(enclosure, low, high, 12, "it")
    with pytest.raises(ValueError, match=r"it is not shown to hold where the variables are .*, -1 to 1"):
        show_definite(enclosure, low, high, 2, "it")


def test_a_box_on_a_kink_is_halved_across_it():
    """Though another variable widens the entries by more than a kink does, where it is not told from the remainder."""

    def matrix(z):
        return jnp.diag(jnp.stack([1.5 + jnp.where(z[0] < 0.0, -1.0, 1.0) * z[0] * 4 + 0.1 * z[1], 2 + z[1]]))

    low, high = np.array([[-0.5, -0.9]]), np.array([[0.0, 0.9]])
    enclosure = TaylorEnclosure(matrix, low[0], high[0], np.zeros(2))
    good, axis = definite(enclosure(low, high), high - low, enclosure.kinks(), np.ones_like(low))
    assert (good[0], axis[0]) == (False, 0)
    show_definite(enclosure, low, high, 3, "it")


CONTINUOUS = {
    "smaller": (lambda a, b: jnp.where(a < b, a, b), True),
    "larger, written backwards": (lambda a, b: jnp.where(b >= a, b, a), True),
    "size": (lambda a, b: jnp.where(a < 0, -a, a), True),
    "the other way": (lambda a, b: jnp.where(a > 0, -a, a), True),
    "size of a difference": (lambda a, b: jnp.where(a - b > 0, a - b, -(a - b)), True),
    "size, about another place": (lambda a, b: jnp.where(a < 0.1, -a, a), False),
    "two others": (lambda a, b: jnp.where(a < b, a, 0.5 * b), False),
    "opposites of something else": (lambda a, b: jnp.where(a < 0, -b, b), False),
    "a step": (lambda a, b: jnp.where(a < b, 1.0, 0.0), False),
    "a truth as a number": (lambda a, b: (a < b).astype(float), False),
    "a truth times a number": (lambda a, b: (a < 0).astype(float) * b, False),
    "the larger of two truths": (lambda a, b: jnp.maximum((a < 0).astype(float), (b < 0).astype(float)), False),
    "a truth that is known": (lambda a, b: (a < 5).astype(float) * b, True),
    "smaller, but equal is not": (lambda a, b: jnp.where(a == b, a, b + 1), False),
}


@pytest.mark.parametrize("name", CONTINUOUS)
def test_choices_that_do_not_jump_are_told_from_those_that_do(name):
    function, is_continuous = CONTINUOUS[name]
    low, high = -np.ones((1, 2)), np.ones((1, 2))
    watched = TaylorEnclosure(lambda z: function(*z), low[0], high[0], np.zeros(2), "smooth")
    assert bool(definite(watched(low, high), high - low, watched.kinks(), np.ones_like(low))[0][0]) is is_continuous


def test_a_number_is_finite_only_where_it_is_far_from_overflow():
    low, high = np.array([[-1.0]]), np.array([[1.0]])
    for size, known in ((1e100, True), (1e151, False), (1e152, False), (1e200, False), (1e308, False)):
        chosen = TaylorEnclosure(
            lambda z, size=size: jnp.where(jnp.isfinite(size * (2 + 0.1 * z[0])), 1.0, -1.0)[None],
            low[0],
            high[0],
            np.zeros(1),
        )(low, high)[0]
        assert bool(np.squeeze(chosen.away) < 1e-6) is known
        assert np.squeeze(chosen.middle + chosen.away) >= 1


def test_boxes_that_take_different_branches_are_shown_apart():
    low, high = np.array([[0.1, 0.5], [0.5, 0.1]]), np.array([[0.2, 0.6], [0.6, 0.2]])
    enclosure = TaylorEnclosure(lambda z: z[jnp.argmax(z)][None, None], low.min(0), high.max(0), np.zeros(2))
    with pytest.raises(UndecidedError):
        enclosure(low, high)
    show_definite(enclosure, low, high, 0, "it")


def test_terms_that_do_not_meet_are_not_turned_into_each_other():
    """Each entry of the diagonal is above 0.1, and the middle is turned by 45° from the diagonal."""

    def matrix(z):
        return jnp.diag(1 + 0.9 * z) / 2 + jnp.array([[0.0, 0.02], [0.02, 0.0]])

    low, high = -np.ones((1, 2)), np.ones((1, 2))
    enclosure = TaylorEnclosure(matrix, low[0], high[0], np.zeros(2))
    total = enclosure(low, high)
    assert definite(total + total.T, high - low, enclosure.kinks(), np.ones_like(low))[0][0]


# Saved trees of many boxes, of which larger ones are tried first.

SQUARE = -np.ones((1, 2)), np.ones((1, 2))
PLACE = np.array([0.3, -0.2])
BORDERS = SQUARE[0][0], SQUARE[1][0]


@functools.cache
def levels_of(seed, boxes=3000):
    """A random tree over two variables with so many leaves, as in a file."""
    rng, levels, size = np.random.default_rng(seed), [], 1
    while size:
        # Halved for sure while there are few boxes, then less often, and not at all in the end.
        share = 1.0 if size < boxes / 8 and len(levels) < 20 else 0.6 if len(levels) < 20 else 0.0
        letters = np.where(rng.random(size) < share, rng.choice(["a", "b"], size), ".")
        levels.append("".join(letters))
        size = 2 * (size - levels[-1].count("."))
    return tuple(levels)


class Counted(TaylorEnclosure):
    """A matrix that counts the boxes it is evaluated on."""

    boxes = 0

    def __call__(self, low, high):
        self.boxes += len(low)
        return super().__call__(low, high)


def show_from_tree(module, enclosure, seed, depth=12):
    """Show a matrix on a random tree, and return the number of its leaves."""
    tree = module.SavedTree.read(2, levels_of(seed), "the tree")
    module.show_tree(enclosure, tree, np.zeros(1, int), *SQUARE, depth, "it")
    return tree.leaves[0]


def well(place, least, wide=0.0):
    """A matrix that is least at one place, where it is `least`; bounds of it are wider by the cube of a box."""
    return lambda z: ((z - place) @ (z - place) + least + wide * (z[0] * z[0] * z[0] - z[0] * (z[0] * z[0])))[
        None, None
    ]


@pytest.mark.parametrize("seed", range(3))
def test_a_saved_tree_is_shown_from_its_larger_boxes(seed):
    enclosure = Counted(well(PLACE, 0.02), *BORDERS, np.zeros(2))
    leaves = show_from_tree(checker, enclosure, seed)
    assert leaves > 2000
    assert enclosure.boxes < leaves


def test_boxes_of_a_tree_are_those_of_its_leaves_together():
    """By volume, for each size of boxes to begin with; and those of one leaf are the leaves."""
    tree, levels = checker.SavedTree.read(2, levels_of(0), "it"), levels_of(0)
    assert tree.leaves[0] == "".join(levels).count(".")
    for most in (1, 2, 7, 300, 10**6):
        numbers, low, high = tree.boxes(np.zeros(1, int), *SQUARE, most)
        assert np.prod(high - low, axis=1).sum() == 4.0
        assert (tree.leaves[numbers] <= most).all()
        assert tree.leaves[numbers].sum() == tree.leaves[0]
    leaves = checker.leaves(*BORDERS, levels, "it")
    for found, expected in zip(tree.boxes(np.zeros(1, int), *SQUARE, 1)[1:], leaves, strict=True):
        np.testing.assert_array_equal(found, expected)


def needles(count=12):
    """Places in the square, some of which are on borders of boxes and in its corners."""
    rng = np.random.default_rng(7)
    return [np.zeros(2), np.array([0.5, -0.25]), np.ones(2), -np.ones(2), *rng.uniform(-1, 1, (count - 4, 2))]


@pytest.mark.core(9)
@pytest.mark.parametrize("wide", [0.0, 3e5])
@pytest.mark.parametrize("k", range(12))
def test_one_wrong_place_among_thousands_of_leaves_is_seen(k, wide):
    enclosure = TaylorEnclosure(well(needles()[k], -1e-9, wide), *BORDERS, np.zeros(2))
    with pytest.raises(ValueError, match="it is not shown to hold where the variables are"):
        show_from_tree(checker, enclosure, k % 3)


def leaves_out(module):
    """Whether the boxes that are shown, none of which overlap, are together smaller than the square."""
    honest = module.definite
    for seed, wide in ((2, 0.0), (1, 5e3), (0, 3e5)):  # the wider the bounds, the more boxes have to be leaves
        areas = []

        def definite(matrix, width, *more, areas=areas):
            good, axes = honest(matrix, width, *more)
            areas.append(width[good].prod(1).sum())
            return good, axes

        module.definite = definite
        show_from_tree(module, module.TaylorEnclosure(well(PLACE, 0.02, wide), *BORDERS, np.zeros(2)), seed)
        if not math.isclose(sum(areas), 4.0, rel_tol=1e-12):
            return True
    return False


MUTANTS_OF_TREES = [
    ("parts.append([part[small] for part in boxes])", "parts.append([part[small][1:] for part in boxes])"),
    ("self.halved(*(part[~small] for part in boxes))", "self.halved(*(part[~small][1:] for part in boxes))"),
    ("(part[~good & ~end] for part", "(part[good & ~end] for part"),
    ("resisting.append((a[~good & end], b[~good & end]))", "pass"),
    ("[part[:-CHUNK] for part in waiting]", "[part[: -2 * CHUNK] for part in waiting]"),
    ("zip(waiting, below, strict=True)]", "zip(waiting, (part[:0] for part in below), strict=True)]"),
    ("zip(waiting[1:], *resisting, strict=True)", "zip([part[:0] for part in waiting[1:]], *resisting, strict=True)"),
    (
        "= low[2 * rows + 1, axes] = middle",
        "= middle\n    low[2 * rows + 1, axes] = middle + (high[2 * rows + 1, axes] - middle) / 1e3",
    ),
    ("show_definite(matrix, low, high, depth, what, until)", "pass"),
]


@pytest.mark.parametrize(("old", "new"), MUTANTS_OF_TREES, ids=range(len(MUTANTS_OF_TREES)))
def test_a_mistake_in_the_walk_through_a_tree_is_noticed(old, new):
    assert leaves_out(mutant(old, new))


def test_no_mistake_in_the_walk_is_noticed_where_there_is_none():
    assert not leaves_out(in_one_module(TEXT))


TREES = {
    "a leaf less": lambda levels: [*levels[:-1], levels[-1][1:]],
    "a leaf more": lambda levels: [*levels[:-1], levels[-1] + "."],
    "a level less": lambda levels: levels[:-1],
    "an open leaf": lambda levels: [*levels[:-1], "?" + levels[-1][1:]],
    "a leaf that is halved": lambda levels: [*levels[:-1], "a" + levels[-1][1:]],
    "a box that is not": lambda levels: [levels[0], "." + levels[1][1:], *levels[2:]],
    "another variable": lambda levels: [levels[0], "c" + levels[1][1:], *levels[2:]],
    "a letter of another alphabet": lambda levels: [levels[0], "а" + levels[1][1:], *levels[2:]],
    "nothing": lambda levels: [],
}


@pytest.mark.parametrize("name", TREES)
def test_no_tree_that_lacks_a_box_is_read(name):
    with pytest.raises(ValueError, match=r"letters or dots; it is|lacks the last \d+ boxes"):
        checker.SavedTree.read(2, TREES[name](levels_of(1)), "claim 1")


MUTANTS = [
    ("ROUND, TINY = 2.0**-40, 2.0**-990", "ROUND, TINY = 0.0, 0.0"),
    ("cut = linear_a * quadratic_b + quadratic_a * (linear_b + quadratic_b)", "cut = 0.0"),
    ("a.radius * (two + b.radius) + one * b.radius", "0.0"),
    ("terms[0][()] = terms[0][()] + part", "pass"),
    ('"inv": lambda x, f: (-(f * f), f * f * f)', '"inv": lambda x, f: (-(f * f), ZERO)'),
    (
        '"sin": lambda x, f: (bounds("sin", x + RIGHT), -(HALF * f))',
        '"sin": lambda x, f: (bounds("sin", x + RIGHT), f)',
    ),
    ("- exact(2 * k + 1) * three", "+ exact(2 * k + 1) * three"),
    ("number(middle, a.away + error)", "number(middle, error)"),
    ("abs(high - low) / 2 + error", "error"),
    ("* (deviation * deviation)", "* (deviation * deviation) * HALF"),
    ("0x1.0b4611a626331p-34", "0x0p+0"),
    ("range(22, 0, -1)", "range(9, 0, -1)"),
    ("range(45, 0, -2)", "range(9, 0, -2)"),
    ("e = abs(turned).sum(0)", "e = abs(turned[0])"),
    ("(radius + ROUND * abs(s).sum(0))", "(0 * radius)"),
    ("* (1 + ROUND) < x).all((1, 2))", "< 2 * x).all((1, 2))"),
    ("known = abs(gap.middle) > gap.away", "known = abs(gap.middle) > -1"),
]


def mutant(old, new):
    assert TEXT.count(old) == 1, f"the source no longer says {old!r} once"
    return in_one_module(TEXT.replace(old, new))


def is_wrong(module):
    """Whether any of the tests above would fail."""
    if any(exact_gap(module, numbers) > 0 for numbers in ([0.1, 0.2, 0.3, 0.7], [1e3, 1 / 3, 7.1, 1e-3])):
        return True
    if any(worst(module, name) >= 1 for name in ERRORS) or any(proves(module, name) for name in INDEFINITE):
        return True
    if any(beyond(module, name).max() > 0 for name in SCALARS):
        return True
    return isinstance(module.less(module.number(np.zeros(2), 1.0), module.number(np.ones(2) / 2)), bool)


@pytest.mark.core(6)
@pytest.mark.exhaustive("6")
@pytest.mark.parametrize(("old", "new"), MUTANTS, ids=range(len(MUTANTS)))
def test_a_mistake_in_the_arithmetic_is_noticed(old, new):
    assert is_wrong(mutant(old, new))


def test_what_is_not_decided_or_not_known_is_refused_by_name():
    box = -np.ones(2), np.ones(2)
    one = box[0][None], box[1][None]
    with pytest.raises(UndecidedError):
        TaylorEnclosure(lambda z: z[jnp.argmax(z)], *box, np.zeros(2))(*one)
    with pytest.raises(ValueError, match="makes numbers shorter, float64 to float32, by 'dot_general'"):
        TaylorEnclosure(lambda z: jnp.dot(z, z, preferred_element_type=jnp.float32)[None], *box, np.zeros(2))(*one)
    with pytest.raises(ValueError, match="'sort' is not known"):
        TaylorEnclosure(lambda z: jnp.sort(z), *box, np.zeros(2))(*one)
    with pytest.raises(ValueError, match="'convert_element_type' is not known"):
        TaylorEnclosure(lambda z: z[0].astype(int).astype(float) + z[1], *box, np.zeros(2))(*one)


# One primitive, and the reader of jaxprs: names and parameters of the equations, and no bound of any.
SHARED = "STUMPFF Branch Call ClosedJaxpr JaxprEquation LoweringError Scan While equations needed stumpff"


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.py")), ids=lambda file: file.stem)
def test_the_checker_shares_only_the_reading_of_jaxprs_with_the_prover(file):
    imported = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported |= {f"{node.module}.{alias.name}" for alias in node.names}
    ours = {name for name in imported if name.startswith(("covariant", "scalargraph"))}
    own = {name for name in ours if not name.startswith("scalargraph.proofs.checker.")}
    allowed = {f"{room}.{name}" for room in ("scalargraph", "scalargraph.graph") for name in SHARED.split()}
    assert own <= allowed | {"scalargraph.errors.InputError"}


def test_terms_are_added_at_known_places_one_at_each():
    def matrix(places):
        return lambda z: jnp.eye(3) * jnp.array([1.0, 2.0, 3.0]).at[jnp.array(places)].add(z)[None]

    low, high = np.array([[-0.5, -0.9]]), np.array([[0.5, 0.9]])
    wide = -2 * np.ones(2), 2 * np.ones(2), np.zeros(2)
    show_definite(TaylorEnclosure(matrix([0, 1]), *wide), low, high, 0, "it")  # 1 − .5 and 2 − .9
    with pytest.raises(ValueError, match="it is not shown to hold"):
        show_definite(TaylorEnclosure(matrix([2, 0]), *wide), 2 * low, 2 * high, 0, "it")  # 1 − 1.8
    with pytest.raises(ValueError, match="several terms for one place"):
        show_definite(TaylorEnclosure(matrix([1, 1]), *wide), low, high, 0, "it")


def test_what_is_not_defined_blames_what_widens_it():
    """And without anything to blame it is refused, however wide the numbers."""
    around = np.array([[-1.0, -1.0]]), np.array([[1.0, 1.0]])
    rooted = TaylorEnclosure(lambda z: jnp.sqrt(z[1]) + z[0], -np.ones(2), np.ones(2), np.zeros(2), "defined")
    found = rooted(*around)[0, 0]
    assert found.middle - found.away < 0
    assert {k for part in found.terms[1:] for m in part for k in m if np.any(part[m])} == {1}
    huge = TaylorEnclosure(
        lambda z: jnp.sqrt(1e308 * (z[0] + z[1]) * 3), -np.ones(2), np.ones(2), np.zeros(2), "defined"
    )
    found = huge(*around)[0, 0]
    assert found.middle - found.away < 0


def test_functions_of_a_squared_angle_are_bounded_around_zero():
    """The polynomial of a square reaches below 0, where Stumpff's functions are defined too."""
    for k in range(5):
        lowered = lower(lambda z, k=k: stumpff(k, z @ z)[None], jnp.zeros(3))
        found = polynomials(lowered, np.full((1, 3), -0.1), np.full((1, 3), 0.1), np.arange(3))
        assert np.isfinite(found.rest).all()
        away = np.abs(found.terms).sum(0) + found.rest
        for square in (0.0, 0.01, 0.03):
            assert abs(float(stumpff(k, square)) - found.centre[0, 0]) <= away[0, 0]
