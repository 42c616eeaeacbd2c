"""The checker refuses every certificate that is not right, encloses what it says, and would notice if it did not."""

import ast
import functools
import json
import math
import shutil
import types
from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from covariant import models
from covariant.certificates import _balls, _certify, _check, _matrices, _taylor, certify
from covariant.certificates._check import check, follows
from covariant.certificates._document import digest, parse
from covariant.certificates._region import subject
from covariant.certificates._saved import observer_from, value_graph
from covariant.certificates._taylor import Enclosure, definite, show_definite
from covariant.geometry import lie
from covariant.lowering import stumpff
from covariant.observers import Intrinsic

SOURCE = Path(_taylor.__file__)


# Enclosures hold the functions, and a source with a mistake in it is found out.


def loop(z):
    """Through the entries and back: what is carried on, what is kept at each, and what stays as it is."""

    def step(total, x):
        return total / 2 + x * z[1], total - x

    total, kept = jax.lax.scan(step, z[0], z)
    total, kept = jax.lax.scan(step, total, kept, reverse=True)
    return total + kept @ jnp.array([1.0, 2.0, 3.0])


SCALARS = {
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
    "rotation": lambda z: lie.SO3.log(lie.SO3.exp(z / 4) @ lie.SO3.exp(jnp.array([0.4, 0.5, 0.6])))[1],
    "trigonometric or hyperbolic": lambda z: sum(stumpff(k, 4 + 4 * z[0] + z[1] * z[2]) for k in range(3)),
    "loop": loop,
    "kinks": lambda z: jnp.abs(z[0] - 0.3) * jnp.sign(z[1]) + jnp.maximum(z[0], z[1]) - jnp.clip(z[2], -0.2, 0.2),
    "clamped": lambda z: jax.lax.clamp(-0.3, z[0], 0.2) + jax.lax.clamp(-0.2, z[1] * z[2], 0.1),
    "branches": lambda z: jnp.where((z[0] < 0) & ~(z[1] >= z[2]) | jnp.any(z > 0.5), z[1], 0.2) + jnp.floor(z[0] + 0.4),
    "choice": lambda z: jnp.where(jnp.isnan(z[0]) | (z[1] > 5), z[2], z[jnp.argmax(z + jnp.array([0.0, 9.0, 0.0]))]),
}
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
    found = module.Enclosure(SCALARS[name], *whole, np.zeros(3))(low, high)[()]
    inside = e / (1 + 2.0**-40)  # boxes are enlarged by their rounding
    model = sum(np.reshape(t, (-1, 1)) * basis(m, inside) for part in found.terms for m, t in part.items())
    with np.errstate(invalid="ignore"):
        return np.abs(values(name) - model) - np.reshape(found.radius, (-1, 1)) - 2.0**-50  # doubles are off themselves


@pytest.mark.parametrize("name", SCALARS)
def test_taylor_models_hold_the_function_and_say_something_about_it(name):
    assert beyond(_taylor, name).max() <= 0
    low, high, _ = places()
    found = Enclosure(SCALARS[name], -np.ones(3), np.ones(3), np.zeros(3))(low, high)[()]
    radius = np.broadcast_to(found.radius, len(low))
    thin, wide = radius[:12], radius[24:36]
    assert thin.max() < 1e-9
    assert wide.max() < (1.5 if name in ("kinks", "clamped", "branches") else 3e-2)  # of third order in the width


def test_remainders_are_of_third_order():
    low, high, _ = places()
    sizes = []
    for share in (0.2, 0.1):
        box = (low + high) / 2 - share * (high - low) / 2, (low + high) / 2 + share * (high - low) / 2
        found = Enclosure(SCALARS["quotient"], -np.ones(3), np.ones(3), np.zeros(3))(*box)[()]
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
    assert worst(_taylor, name) < 1


FLOATS = st.floats(-1e3, 1e3).filter(lambda x: x == 0 or abs(x) > 1e-200)


@settings(max_examples=40)
@given(st.lists(FLOATS, min_size=4, max_size=4))
def test_thin_sums_and_products_hold_the_exact_ones(numbers):
    assert exact_gap(_taylor, numbers) <= 0


def exact_gap(module, numbers):
    a, b, c, d = map(Fraction, numbers)
    z = [module.number(np.array([x])) for x in numbers]
    found = z[0] * z[1] + z[2] * z[3] - z[0]
    return abs(Fraction(float(found.middle[0])) - (a * b + c * d - a)) - Fraction(float(found.radius[0]))


def test_sums_and_products_are_no_less_exact_than_they_must_be():
    a, b = _taylor.number(np.array([1.0]), 1e-3), _taylor.number(np.array([2.0]), 2e-3)
    for found, radius in ((a + b, 3e-3), (a - b, 3e-3), (a * b, 4e-3 + 2e-6)):
        np.testing.assert_allclose(found.radius, radius, rtol=1e-8)


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
    return bool(module.definite(module.Enclosure(matrix, low[0], high[0], np.zeros(2))(low, high), high - low)[0][0])


@pytest.mark.parametrize("name", INDEFINITE)
def test_no_matrix_that_is_not_definite_is_shown_to_be(name):
    assert not proves(_taylor, name)


def test_matrices_that_are_definite_are_shown_to_be_after_halving():
    def matrix(z):
        return jnp.diag(jnp.stack([jnp.exp(z[0]) - 0.13, 2 + z[1]]))

    low, high = np.array([[-2.0, -1.0]]), np.array([[2.0, 1.0]])
    enclosure = Enclosure(matrix, low[0], high[0], np.zeros(2))
    good, axis = definite(enclosure(low, high), high - low)
    assert (good[0], axis[0]) == (False, 0)
    show_definite(enclosure, low, high, 12, "it")
    with pytest.raises(ValueError, match=r"it is not shown to hold where the variables are -2 to -1\.5, -1 to 1"):
        show_definite(enclosure, low, high, 2, "it")


def test_boxes_that_take_different_branches_are_shown_apart():
    low, high = np.array([[0.1, 0.5], [0.5, 0.1]]), np.array([[0.2, 0.6], [0.6, 0.2]])
    enclosure = Enclosure(lambda z: z[jnp.argmax(z)][None, None], low.min(0), high.max(0), np.zeros(2))
    with pytest.raises(_taylor.UndecidedError):
        enclosure(low, high)
    show_definite(enclosure, low, high, 0, "it")


MUTANTS = [
    ("ROUND, TINY = 2.0**-40, 2.0**-990", "ROUND, TINY = 0.0, 0.0"),
    ("cut = line * curved + bend * (slope + curved)", "cut = 0.0"),
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
    ("* (left * left)", "* (left * left) * HALF"),
    ("0x1.0b4611a626331p-34", "0x0p+0"),
    ("range(22, 0, -1)", "range(9, 0, -1)"),
    ("range(45, 0, -2)", "range(9, 0, -2)"),
    ("e = abs(turned).sum(0)", "e = abs(turned[0])"),
    ("(radius + ROUND * abs(s).sum(0))", "(0 * radius)"),
    ("* (1 + ROUND) < x).all((1, 2))", "< 2 * x).all((1, 2))"),
    ("known = abs(gap.middle) > gap.away", "known = abs(gap.middle) > -1"),
]


def mutant(old, new):
    text = SOURCE.read_text(encoding="utf-8")
    assert text.count(old) == 1, f"the source no longer says {old!r} once"
    module = types.ModuleType("mutant")
    exec(compile(text.replace(old, new), "mutant", "exec"), module.__dict__)
    return module


def is_wrong(module):
    """Whether any of the tests above would fail."""
    if any(exact_gap(module, numbers) > 0 for numbers in ([0.1, 0.2, 0.3, 0.7], [1e3, 1 / 3, 7.1, 1e-3])):
        return True
    if any(worst(module, name) >= 1 for name in ERRORS) or any(proves(module, name) for name in INDEFINITE):
        return True
    if any(beyond(module, name).max() > 0 for name in SCALARS):
        return True
    return isinstance(module.less(module.number(np.zeros(2), 1.0), module.number(np.ones(2) / 2)), bool)


@pytest.mark.parametrize(("old", "new"), MUTANTS, ids=range(len(MUTANTS)))
def test_a_mistake_in_the_arithmetic_is_noticed(old, new):
    assert is_wrong(mutant(old, new))


def test_no_mistake_is_noticed_where_there_is_none():
    assert not is_wrong(mutant("ROUND, TINY = 2.0**-40, 2.0**-990", "ROUND, TINY = 2.0**-40, 2.0**-980"))


def test_what_is_not_decided_or_not_known_is_refused_by_name():
    box = -np.ones(2), np.ones(2)
    one = box[0][None], box[1][None]
    with pytest.raises(_taylor.UndecidedError):
        Enclosure(lambda z: z[jnp.argmax(z)], *box, np.zeros(2))(*one)
    with pytest.raises(ValueError, match="'sort' is not known"):
        Enclosure(lambda z: jnp.sort(z), *box, np.zeros(2))(*one)
    with pytest.raises(ValueError, match="'convert_element_type' is not known"):
        Enclosure(lambda z: z[0].astype(int).astype(float) + z[1], *box, np.zeros(2))(*one)


# Certificates.


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A certificate of a system of one coordinate, whose metric depends on it."""
    recipe = {"system": "oscillator", "parameters": {"chart": "r"}}
    observer = Intrinsic(models.from_recipe(recipe), 4.0, 8.0)
    found = certify(observer, velocity=0.2, error=0.05, position=(0.8, 1.2), input=0.1, recipe=recipe)
    assert found.summary.verdict == "holds"
    return found.save(tmp_path_factory.mktemp("oscillator") / "certificate.json")


@pytest.fixture(scope="module")
def beam(tmp_path_factory):
    """A certificate of the ball and beam at a speed that needs the curvature."""
    recipe = {"system": "ball_and_beam", "parameters": {}}
    observer = Intrinsic(models.from_recipe(recipe), math.sqrt(2), 0.5)
    given = {"position": (-0.01, 0.01), "input": 0.01, "rate": 0.3}
    found = certify(observer, velocity=0.9, error=0.001, **given, recipe=recipe)
    assert found.summary.verdict == "holds"
    return found.save(tmp_path_factory.mktemp("beam") / "certificate.json")


def forged(path, folder, change):
    """The certificate changed, and with the graph and the digest that go with it."""
    document, made = json.loads(path.read_text(encoding="utf-8")), folder / "forged.json"
    change(document)
    made.write_text(json.dumps(document | {"digest": digest(document)}), encoding="utf-8")
    if "system" in document["recipe"]:
        document["graph"] = value_graph(subject(*observer_from(parse(made))))
        made.write_text(json.dumps(document | {"digest": digest(document)}), encoding="utf-8")
    return made


def test_a_certificate_is_found_right_from_the_file_alone(saved, tmp_path):
    path = shutil.copy(saved, tmp_path / "sent.json")
    seen = []
    found = check(path, progress=lambda done, total: seen.append((done, total)))
    document = json.loads(saved.read_text(encoding="utf-8"))
    assert (found.rate, found.radius) == (document["rate"], document["radius"])
    assert found.leaves == sum(level.count(".") for claim in document["claims"] for level in claim["levels"])
    assert found.leaves > 3
    assert seen[-1][0] == seen[-1][1]


def test_processes_find_the_same(saved):
    assert check(saved, processes=2).leaves == check(saved).leaves


def wheel():
    """A heavy wheel: rotations of the plane."""
    return models.GroupSystem(lie.SO2, np.eye(1), lambda g: g[0, 1])


def test_a_group_is_checked(tmp_path):
    recipe = {"attribute": f"{__name__}:wheel"}
    found = certify(Intrinsic(wheel(), 10.0, 50.0), velocity=0.5, error=0.1, input=0.1, recipe=recipe)
    path = found.save(tmp_path / "wheel.json")
    assert check(path, model=wheel).radius == found.radius > 0
    with pytest.raises(ValueError, match="the bound of the force is not shown"):
        check(forged(path, tmp_path, put("given", "positions", "high", 0, 2.0)), model=wheel())


def test_every_altered_character_is_refused(saved, tmp_path):
    text = saved.read_text(encoding="utf-8")
    whole = json.loads(text)
    rng = np.random.default_rng(8)
    made = tmp_path / "altered.json"
    digits = [k for k, letter in enumerate(text) if letter.isdigit()]
    others = [k for k, letter in enumerate(text) if letter in "abcdef.-"]
    for k in [*rng.choice(digits, 200), *rng.choice(others, 60)]:
        other = str((int(text[k]) + 1 + rng.integers(9)) % 10) if text[k].isdigit() else "c" if text[k] != "c" else "d"
        altered = text[:k] + other + text[k + 1 :]
        made.write_text(altered, encoding="utf-8")
        try:
            same = json.loads(altered) == whole  # a digit beyond those that a double has
        except ValueError:
            same = False
        if not same:
            with pytest.raises(ValueError, match=r"altered\.json"):
                check(made)


def put(*path_and_value):
    *path, last, value = path_and_value

    def change(document):
        target = document
        for key in path:
            target = target[key]
        target[last] = value(target[last]) if callable(value) else value

    return change


def bound(side, k, value):
    """Another bound of the box."""
    return put("box", side, k, value)


def together(*changes):
    def change(document):
        for each in changes:
            each(document)

    return change


FORGERIES = {
    "rate": (put("rate", 6.0), r"claims\[0\] is not shown to hold where"),
    "radius": (put("radius", lambda r: 1.01 * r), "which its box|may reach"),
    "radius and limit": (
        together(put("radius", lambda r: 3 * r), put("claims", 1, "limit", 1.0), put("claims", 2, "limit", 1.0)),
        "outside of",
    ),
    "limit": (put("claims", 1, "limit", lambda w: 1.01 * w), "of room"),
    "square": (put("claims", 1, "square", lambda s: s / 4), r"claims\[1\] is not shown|may reach"),
    "box beyond the metric": (
        bound("low", 0, lambda v: -v),
        "definedness of the observer, without jumps, is not shown",
    ),
    "box enlarged": (bound("high", 1, lambda v: 40 * v), r"claims\[0\] is not shown to hold where"),
    "box without the error": (bound("high", 0, lambda v: v - 0.01), "r may be .* which its box"),
    "force box": (bound("high", 3, lambda v: 0.5 * v), "the bound of the force is not shown"),
    "velocity": (put("velocity", 0, lambda v: v + 0.1), "v_r may be"),
    "position": (put("given", "positions", "high", 0, 1.3), "r may be"),
    "input": (put("given", "inputs", "high", 0, 0.2), "the bound of the force is not shown to hold"),
    "Q": (put("q", lambda q: [[1.0, 0.0], [0.0, 1.0]]), r"claims\[0\] is not shown to hold where"),
    "gain": (put("observer", "alpha", 0.1), r"claims\[0\] is not shown to hold where"),
    "leaves joined": (put("claims", 0, "levels", ["."]), r"claims\[0\] is not shown to hold where"),
}
"""What reads well, and is not true; files that do not read well are in `tests/attacks/test_files.py`."""


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forger_who_mends_the_digest_is_refused_with_the_reason(saved, tmp_path, monkeypatch, name):
    change, reason = FORGERIES[name]
    if name in ("leaves joined", "rate", "gain", "Q"):
        monkeypatch.setattr(_check, "DEPTH", 2)
    with pytest.raises(ValueError, match=reason):
        check(forged(saved, tmp_path, change))


def test_the_curvature_is_needed(beam, tmp_path):
    assert check(beam).leaves >= 5
    off = forged(beam, tmp_path, put("observer", "curvature", False))
    with pytest.raises(ValueError, match=r"claims\[0\] is not shown to hold where"):
        check(off)


def test_the_sign_as_printed_is_refused(beam, tmp_path, monkeypatch):
    right = Intrinsic.bend
    monkeypatch.setattr(Intrinsic, "bend", lambda self, at, drive, *given: 2 * drive - right(self, at, drive, *given))
    with pytest.raises(ValueError, match="graph: it must be the one that the observer has"):
        check(beam)
    with pytest.raises(ValueError, match=r"claims\[0\] is not shown to hold where"):
        check(forged(beam, tmp_path, lambda document: None))


def test_balls_find_the_same(saved, tmp_path):
    pytest.importorskip("flint")
    found = _balls.check_sample(saved, 12, seed=4)
    assert found.leaves == min(12, found.total)
    made = forged(saved, tmp_path, put("rate", 6.0))
    with pytest.raises(ValueError, match=r"of claims\[0\] is not shown in balls"):
        _balls.check_sample(made, found.total)


def test_forces_may_leave_their_box_by_as_much_as_may_be_missing_there(saved):
    """On either side: which of the bounds is the larger one depends on the force."""
    statement = follows(parse(saved))
    document = statement.document
    turned = np.append(np.ones(len(document.low) - 1), -1.0)
    other = document._replace(low=np.minimum(document.low * turned, document.high * turned))
    other = other._replace(high=np.maximum(document.low * turned, document.high * turned))
    assert abs(document.low[-1]) != abs(document.high[-1])
    for each in (document, other):
        room = _check._matrix(statement._replace(document=each), 0).room
        assert (room[:-1] == 0).all()
        assert room[-1] >= _check.ROOM * max(abs(each.low[-1]), abs(each.high[-1]))


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """A certificate of the same system under noise and an unknown force, where its own force has a slope."""
    recipe = {"system": "oscillator", "parameters": {"chart": "r"}}
    observer = Intrinsic(models.from_recipe(recipe), 4.0, 8.0)
    given = {"velocity": 0.2, "error": 0.05, "position": (0.8, 1.2), "input": 0.1}
    found = certify(observer, **given, noise=1e-3, disturbance=2e-3, recipe=recipe)
    assert found.summary.verdict == "holds"
    assert 0 < found.steady < found.radius
    return found.save(tmp_path_factory.mktemp("noisy") / "certificate.json")


def test_what_noise_adds_is_no_more_than_its_bounds_and_the_slope_say(noisy):
    given = json.loads(noisy.read_text(encoding="utf-8"))["given"]
    true = [1e-3, 2e-3 + given["slopes"][0][0] * 1e-3]
    assert given["slopes"][0][0] > 0.5
    for sizes in (_check.sizes(parse(noisy)), _certify.disturbance_sizes(given)):
        np.testing.assert_allclose(sizes, true, rtol=1e-11)


def test_a_radius_that_noise_alone_reaches_is_refused(noisy, tmp_path):
    """As a number it is the very distance at which noise keeps them, which may be off by its rounding."""
    document = parse(noisy)
    assert check(noisy).radius == document.radius
    steady = 2 * math.sqrt(2 * document.claims[-1].square) / document.rate
    assert check(forged(noisy, tmp_path, put("radius", 1.001 * steady))).radius < document.radius
    with pytest.raises(ValueError, match=r"radius: noise alone leads .* away"):
        check(forged(noisy, tmp_path, put("radius", steady)))


# Regions that are not geodesically convex: the sector of a ring in polar coordinates, whose chords leave it inwards.


def polar():
    """A free mass of 1 kg in the plane."""
    return models.Lagrangian(
        lambda q: jnp.diag(jnp.stack([jnp.ones(()), q[0] ** 2])),
        lambda q: jnp.zeros(()),
        coordinates=("r", "angle"),
        units=("m", "rad"),
    )


INNER, OUTER, WIDE, OFF = 0.9, 1.1, 0.9, 0.05
"""The true motions of the sector [m, m, rad], and the error of a position [m, rad]."""


def sector():
    """A certificate on the sector."""
    recipe = {"attribute": f"{__name__}:polar"}
    bounds = np.array([INNER, -WIDE]), np.array([OUTER, WIDE])
    given = {"velocity": 0.1, "error": OFF, "position": bounds, "input": 0.01}
    return certify(Intrinsic(polar(), 4.0, 8.0), **given, recipe=recipe)


@pytest.fixture(scope="module")
def sectors():
    return sector()


def shortest_leaving(q):
    """The least length, in the metric of states, of a geodesic of the plane that leaves the region from a true motion.

    A curve of states is at least √(½(a − c²/b)) times as long as that of its positions, and may be as short.
    """
    rng = np.random.default_rng(2)
    r = np.concatenate([np.full(50_000, INNER), rng.uniform(INNER, OUTER, 50_000)])
    turned = rng.uniform(-WIDE, WIDE, 100_000)
    far = rng.uniform(INNER - OFF, OUTER + OFF, 100_000)  # an estimate within the region
    other = np.clip(turned + rng.uniform(-1, 1, 100_000) * rng.choice([0.05, 0.5, 2.0], 100_000), -WIDE, WIDE)
    a, b = r * np.exp(1j * turned), far * np.exp(1j * other)
    nearest = np.min([abs(a + s * (b - a)) for s in np.linspace(0, 1, 41)], axis=0)
    leaves = nearest < INNER - OFF
    assert leaves.sum() > 1000  # the region is not convex
    return math.sqrt((q[0, 0] - q[0, 1] ** 2 / q[1, 1]) / 2) * abs(b - a)[leaves].min()


def test_no_geodesic_as_long_as_the_radius_leaves_a_region_that_is_not_convex(sectors, tmp_path):
    assert sectors.summary.verdict == "holds"
    assert sectors.radius < shortest_leaving(sectors.q)
    for claim in sectors.claims[1:]:
        assert sectors.radius * math.sqrt(claim.square) <= claim.limit
    assert check(sectors.save(tmp_path / "sector.json"), model=polar).radius == sectors.radius


def test_a_prover_that_forgets_the_border_would_be_seen(sectors, tmp_path, monkeypatch):
    honest = _certify.limits_of
    monkeypatch.setattr(_certify, "limits_of", lambda *given: 10 * honest(*given))
    careless = sector()
    assert careless.radius == pytest.approx(10 * sectors.radius)
    assert careless.radius > shortest_leaving(careless.q)
    with pytest.raises(ValueError, match="which its box"):
        check(careless.save(tmp_path / "careless.json"), model=polar)


def test_a_prover_that_takes_reaches_for_shorter_than_they_are_proves_nothing(monkeypatch):
    honest = _certify.seen_squares
    monkeypatch.setattr(_certify, "seen_squares", lambda about, domain: honest(about, domain) / 4)
    found = sector()
    assert (found.summary.verdict, found.radius) == ("fails", 0.0)


@pytest.mark.parametrize("more", [1 + 1e-6, 1.5, 100.0])
@pytest.mark.parametrize("mended", ["nothing", "limit", "square"])
def test_a_radius_beyond_what_is_proved_to_be_reached_is_refused(sectors, tmp_path, more, mended):
    def longer(document):
        document["radius"] *= more
        for claim in document["claims"][1:]:
            claim["limit"] *= more if mended == "limit" else 1
            claim["square"] /= more**2 if mended == "square" else 1

    made = forged(sectors.save(tmp_path / "sector.json"), tmp_path, longer)
    if mended == "square" and more < 1.01:  # there is as much room between what is claimed of a reach and what is true
        assert check(made, model=polar).radius > sectors.radius
        return
    with pytest.raises(ValueError, match=r"may reach|which its box|of room|is not shown to hold"):
        check(made, model=polar)


# The checker is small, and shares nothing with the prover.


@pytest.mark.parametrize("module", [_check, _matrices, _taylor])
def test_the_checker_shares_nothing_with_the_prover(module):
    imported = set()
    for node in ast.walk(ast.parse(Path(module.__file__).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported |= {f"{node.module}.{alias.name}" for alias in node.names}
    own = {name for name in imported if name.startswith("covariant")}
    allowed = {
        "covariant.certificates._document.Document",
        "covariant.certificates._document.parse",
        "covariant.certificates._region.Intrinsics",
        "covariant.certificates._matrices",
        "covariant.certificates._region.Subject",
        "covariant.certificates._region.check_unique",
        "covariant.certificates._region.moved",
        "covariant.certificates._region.subject",
        "covariant.certificates._region.values",
        "covariant.certificates._saved.observer_from",
        "covariant.certificates._saved.value_graph",
        "covariant.lowering.STUMPFF",
        "covariant.models.applied_force",
        "covariant.models.MechanicalSystem",
    }
    assert {name for name in own if not name.startswith("covariant.certificates._taylor.")} <= allowed


def test_the_checker_can_be_read_in_one_sitting():
    assert len(Path(_check.__file__).read_text(encoding="utf-8").splitlines()) <= 280
