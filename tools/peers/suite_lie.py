"""Lie groups beside jaxlie and Pinocchio: the laws that jaxlie and manif test, values, and digits.

`Ours` and `Jaxlie` put both libraries under one interface of elements as matrices and twists (v, ω). The laws are those
of the public tests of jaxlie 1.5 (test_group_axioms, test_operations, test_jlog, test_jac_left, test_manifold) and of
manif (test/python/test_manif.py), written anew; they are asked of both libraries. A table then compares values with
arithmetic of 60 digits.

Source: Solà, Deray & Atchuthan 2018, A micro Lie theory for state estimation in robotics, arXiv:1812.01537, which both
projects follow.
"""

import subprocess
import tempfile
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from outcome import Outcome, command_line
from sixty_digits import exact

from covariant.geometry import lie

jax.config.update("jax_enable_x64", True)
NAMES = ("SO2", "SO3", "SE2", "SE3")
REAL = (np.float64, np.float32)
COUNT = 24
STEP, SQUARED = 1e-4, 1e-7  # manif's perturbation, and its tolerance of what is of second order in it


class Ours:
    """A group of this library."""

    def __init__(self, name):
        self.name = name
        self.group = getattr(lie, name)
        self.n, self.order, self.turning = self.group.dimension, self.group.order, int(name[-1])
        self.exp, self.log, self.inverse, self.act = (
            self.group.exp,
            self.group.log,
            self.group.inverse,
            self.group.act,
        )
        self.compose, self.hat = self.group.compose, self.group.hat

    def identity(self, dtype):
        return self.group.identity(dtype)

    def adjoint(self, g):
        return jax.vmap(lambda e: self.group.adjoint(g, e), out_axes=1)(jnp.eye(self.n, dtype=g.dtype))

    def small_adjoint(self, x):
        return jax.vmap(lambda e: self.group.lie_bracket(x, e), out_axes=1)(jnp.eye(self.n, dtype=x.dtype))

    def right_jacobian(self, x):
        return self._columns(self.group.right_jacobian, x)

    def left_jacobian(self, x):
        return self._columns(self.group.left_jacobian, x)

    def right_jacobian_inverse(self, x):
        return self._columns(self.group.right_jacobian_inverse, x)

    def left_jacobian_inverse(self, x):
        return self._columns(self.group.left_jacobian_inverse, x)

    def _columns(self, f, x):
        return jax.vmap(lambda e: f(x, e), out_axes=1)(jnp.eye(self.n, dtype=x.dtype))


class Jaxlie:
    """A group of jaxlie, whose elements are given and returned as matrices."""

    def __init__(self, name):
        self.name = name
        self.kind = getattr(jaxlie, name)
        self.n, self.order, self.turning = self.kind.tangent_dim, self.kind.matrix_dim, int(name[-1])
        self.hat = Ours(name).hat  # it has none of its own

    def identity(self, dtype):
        return self.kind.identity().as_matrix().astype(dtype)

    def exp(self, x):
        return self.kind.exp(x).as_matrix()

    def log(self, g):
        return self.kind.from_matrix(g).log()

    def inverse(self, g):
        return self.kind.from_matrix(g).inverse().as_matrix()

    def compose(self, g, h):
        return (self.kind.from_matrix(g) @ self.kind.from_matrix(h)).as_matrix()

    def act(self, g, p):
        return self.kind.from_matrix(g).apply(p)

    def adjoint(self, g):
        return self.kind.from_matrix(g).adjoint()

    def small_adjoint(self, x):
        return jax.jacfwd(lambda s: self.kind.exp(s * x).adjoint())(jnp.zeros((), x.dtype))

    def right_jacobian_inverse(self, x):
        return self.kind.exp(x).jlog()

    def right_jacobian(self, x):
        return jnp.linalg.inv(self.right_jacobian_inverse(x))

    def left_jacobian(self, x):
        return self.right_jacobian(-x)

    def left_jacobian_inverse(self, x):
        return self.right_jacobian_inverse(-x)


class Batched:
    """A library's functions on many arguments at once, each compiled once; NumPy in and out."""

    def __init__(self, p):
        self.p = p
        for name in ("exp", "log", "inverse", "compose", "act", "hat", "adjoint", "small_adjoint", *JACOBIANS):
            setattr(self, name, many(getattr(p, name)))

        def zero(x):
            return jnp.zeros(p.n, x.dtype)

        def rise(g):
            """Of |log|² along a step of steepest descent, or 0 where it falls."""

            def squared(s):
                return jnp.sum(p.log(p.compose(g, p.exp(s))) ** 2)

            return jax.nn.relu(squared(-1e-3 * jax.grad(squared)(zero(g))) - squared(zero(g)))

        self.rise = many(rise)
        self.log_slope_right = many(lambda x: jax.jacfwd(lambda s: p.log(p.compose(p.exp(x), p.exp(s))))(zero(x)))
        self.log_slope_left = many(lambda x: jax.jacfwd(lambda s: p.log(p.compose(p.exp(s), p.exp(x))))(zero(x)))

    def one(self, g):
        return np.broadcast_to(np.asarray(self.p.identity(g.dtype)), g.shape)


JACOBIANS = ("right_jacobian", "left_jacobian", "right_jacobian_inverse", "left_jacobian_inverse")


def many(f):
    """A function of many arguments at once."""
    compiled = jax.jit(jax.vmap(f))
    return lambda *at: np.asarray(compiled(*at))


def times(a, x):
    """Products of many matrices with as many vectors."""
    return (a @ x[..., None])[..., 0]


def laws(p: Batched):
    """The laws of both projects, by name.

    Each is a function `(a, b, c, x, y, w, q) -> (value, expected)` of elements a, b, c, twists x, y, small twists w and
    points q, K of each. Those whose name begins with `∂` hold to second order in w.
    """
    exp, log, mul, inv, act, hat, one = p.exp, p.log, p.compose, p.inverse, p.act, p.hat, p.one
    ad, jr, jl = p.adjoint, p.right_jacobian, p.left_jacobian
    jr_inverse, jl_inverse = p.right_jacobian_inverse, p.left_jacobian_inverse
    unit, turning = np.eye(p.p.n), p.p.turning

    def plus(g, x):
        return mul(g, exp(x))

    def lplus(g, x):
        return mul(exp(x), g)

    def minus(g, h):
        return log(mul(inv(h), g))

    def lminus(g, h):
        return log(mul(g, inv(h)))

    def between(g, h):
        return mul(inv(g), h)

    def moved(m, q):
        """Of points q: by a matrix of homogeneous coordinates, where there are such."""
        shift = m[:, :turning, turning] if p.p.order > turning else 0.0
        return times(m[:, :turning, :turning], q) + shift

    def square(g):
        turn = g[:, :turning, :turning]
        return turn @ np.swapaxes(turn, 1, 2)

    return {
        "closure": lambda a, b, c, x, y, w, q: (square(mul(a, b)), np.eye(turning)),
        "identity from the left": lambda a, b, c, x, y, w, q: (mul(one(a), a), a),
        "identity from the right": lambda a, b, c, x, y, w, q: (mul(a, one(a)), a),
        "inverse from the right": lambda a, b, c, x, y, w, q: (mul(a, inv(a)), one(a)),
        "inverse from the left": lambda a, b, c, x, y, w, q: (mul(inv(a), a), one(a)),
        "associative": lambda a, b, c, x, y, w, q: (mul(mul(a, b), c), mul(a, mul(b, c))),
        "exp of log": lambda a, b, c, x, y, w, q: (exp(log(a)), a),
        "log of exp of log": lambda a, b, c, x, y, w, q: (log(exp(log(a))), log(a)),
        "inverse of inverse": lambda a, b, c, x, y, w, q: (inv(inv(a)), a),
        "product is that of matrices": lambda a, b, c, x, y, w, q: (mul(a, b), a @ b),
        "inverse is that of matrices": lambda a, b, c, x, y, w, q: (inv(a), np.linalg.inv(a)),
        "action is that of matrices": lambda a, b, c, x, y, w, q: (act(a, q), moved(a, q)),
        "action of the inverse": lambda a, b, c, x, y, w, q: (act(inv(a), act(a, q)), q),
        "adjoint moves a twist": lambda a, b, c, x, y, w, q: (plus(a, x), lplus(a, times(ad(a), x))),
        "adjoint of a product": lambda a, b, c, x, y, w, q: (ad(a) @ ad(b), ad(mul(a, b))),
        "adjoint of the inverse": lambda a, b, c, x, y, w, q: (ad(inv(a)), np.linalg.inv(ad(a))),
        "exp of zero": lambda a, b, c, x, y, w, q: (exp(0 * x), one(a)),
        "log of one": lambda a, b, c, x, y, w, q: (log(one(a)), 0 * x),
        "plus zero": lambda a, b, c, x, y, w, q: (plus(a, 0 * x), a),
        "zero plus": lambda a, b, c, x, y, w, q: (lplus(a, 0 * x), a),
        "minus itself": lambda a, b, c, x, y, w, q: (minus(a, a), 0 * x),
        "between itself": lambda a, b, c, x, y, w, q: (between(a, a), one(a)),
        "plus of minus": lambda a, b, c, x, y, w, q: (plus(a, minus(b, a)), b),
        "minus of plus": lambda a, b, c, x, y, w, q: (minus(plus(a, x), a), x),
        "bracket is the commutator": lambda a, b, c, x, y, w, q: (
            hat(times(p.small_adjoint(x), y)),
            hat(x) @ hat(y) - hat(y) @ hat(x),
        ),
        "J_l = Ad J_r": lambda a, b, c, x, y, w, q: (jl(x), ad(exp(x)) @ jr(x)),
        "Ad = J_l J_r⁻¹": lambda a, b, c, x, y, w, q: (ad(exp(x)), jl(x) @ jr_inverse(x)),
        "J_l(x) = J_r(−x)": lambda a, b, c, x, y, w, q: (jl(x), jr(-x)),
        "J_r J_r⁻¹ = 1": lambda a, b, c, x, y, w, q: (jr(x) @ jr_inverse(x), unit),
        "J_l J_l⁻¹ = 1": lambda a, b, c, x, y, w, q: (jl(x) @ jl_inverse(x), unit),
        "J_r⁻¹ is the derivative of log": lambda a, b, c, x, y, w, q: (jr_inverse(x), p.log_slope_right(x)),
        "J_l⁻¹ is the derivative of log": lambda a, b, c, x, y, w, q: (jl_inverse(x), p.log_slope_left(x)),
        "descent shortens log": lambda a, b, c, x, y, w, q: (p.rise(a), np.zeros(1)),
        "∂ inverse": lambda a, b, c, x, y, w, q: (inv(plus(a, w)), plus(inv(a), -times(ad(a), w))),
        "∂ log": lambda a, b, c, x, y, w, q: (log(plus(a, w)), log(a) + times(jr_inverse(log(a)), w)),
        "∂ exp": lambda a, b, c, x, y, w, q: (exp(x + w), plus(exp(x), times(jr(x), w))),
        "∂ exp at zero": lambda a, b, c, x, y, w, q: (exp(w), exp(times(jr(0 * x), w))),
        "∂ product, first": lambda a, b, c, x, y, w, q: (mul(plus(a, w), b), plus(mul(a, b), times(ad(inv(b)), w))),
        "∂ product, second": lambda a, b, c, x, y, w, q: (mul(a, plus(b, w)), plus(mul(a, b), w)),
        "∂ between, first": lambda a, b, c, x, y, w, q: (
            between(plus(a, w), b),
            plus(between(a, b), -times(ad(between(b, a)), w)),
        ),
        "∂ between, second": lambda a, b, c, x, y, w, q: (between(a, plus(b, w)), plus(between(a, b), w)),
        "∂ plus, first": lambda a, b, c, x, y, w, q: (plus(plus(a, w), x), plus(plus(a, x), times(ad(exp(-x)), w))),
        "∂ plus, second": lambda a, b, c, x, y, w, q: (plus(a, x + w), plus(plus(a, x), times(jr(x), w))),
        "∂ plus on the left, first": lambda a, b, c, x, y, w, q: (lplus(plus(a, w), x), plus(lplus(a, x), w)),
        "∂ plus on the left, second": lambda a, b, c, x, y, w, q: (
            lplus(a, x + w),
            plus(lplus(a, x), times(ad(inv(a)), times(jr(x), w))),
        ),
        "∂ minus, first": lambda a, b, c, x, y, w, q: (
            minus(plus(a, w), b),
            minus(a, b) + times(jr_inverse(minus(a, b)), w),
        ),
        "∂ minus, second": lambda a, b, c, x, y, w, q: (
            minus(a, plus(b, w)),
            minus(a, b) - times(jl_inverse(minus(a, b)), w),
        ),
        "∂ minus on the left, first": lambda a, b, c, x, y, w, q: (
            lminus(plus(a, w), b),
            lminus(a, b) + times(jr_inverse(lminus(a, b)), times(ad(b), w)),
        ),
        "∂ minus on the left, second": lambda a, b, c, x, y, w, q: (
            lminus(a, plus(b, w)),
            lminus(a, b) - times(jr_inverse(lminus(a, b)), times(ad(b), w)),
        ),
        "∂ action": lambda a, b, c, x, y, w, q: (act(plus(a, w), q), act(a, q) + moved(a @ hat(w), q)),
    }


# Laws


def samples(p, dtype, angles, seed=0):
    """Elements a, b, c, twists x, y, small twists w and points (K, …), with these angles of rotation (K,)."""
    rng, count, turns = np.random.default_rng(seed), len(angles), (p.turning == 3) * 2 + 1

    def twists():
        x = rng.uniform(-1, 1, (count, p.n))
        axis = x[:, -turns:]
        x[:, -turns:] = axis / np.linalg.norm(axis, axis=1, keepdims=True) * angles[:, None]
        return x

    exps = jax.vmap(Ours(p.name).exp)
    a, b, c = (np.asarray(exps(jnp.asarray(twists()))) for _ in range(3))
    w = STEP * rng.uniform(0, 1, (count, p.n))
    q = rng.uniform(-1, 1, (count, p.turning))
    return tuple(part.astype(dtype) for part in (a, b, c, twists(), twists(), w, q))


def violations(p: Batched, dtype, angles) -> dict[str, float]:
    """By how much each law is violated at worst; NaN where something is."""
    at = samples(p.p, dtype, angles)
    pairs = {name: law(*at) for name, law in laws(p).items()}
    return {name: float(np.max(np.abs(np.subtract(*pair, dtype=float)))) for name, pair in pairs.items()}


def ask_laws(outcome: Outcome) -> None:
    """All laws, on all groups of both libraries, in both precisions, at common angles and near no rotation."""
    rows = []
    places = {
        "0.1 to 2.5 rad": np.linspace(0.1, 2.5, COUNT),
        "0 to 0.01 rad": np.array([0, *np.geomspace(1e-12, 1e-2, COUNT - 1)]),
    }
    for name in NAMES:
        both = [Batched(kind(name)) for kind in (Ours, Jaxlie)]
        for dtype in REAL:
            for place, angles in places.items():
                shares = []
                for p in both:
                    allowed = 1e-8 if dtype is np.float64 else 2e-5
                    worst = violations(p, dtype, angles)
                    bounds = {law: max(allowed, SQUARED) if law[0] == "∂" else allowed for law in worst}
                    shares.append((sum(worst[law] <= bounds[law] for law in worst), len(worst)))
                    shares.append(
                        max(worst, key=lambda law: np.inf if np.isnan(worst[law]) else worst[law] / bounds[law])
                    )
                    shares.append(worst[shares[-1]])
                    if p is both[0]:
                        for law, value in worst.items():
                            outcome.close(f"{law}, {name}, {np.dtype(dtype).name}, {place}", value, bounds[law])
                rows.append((name, np.dtype(dtype).name, place, shares))
    shown = [
        (
            name,
            real,
            place,
            *(f"{a} of {b}" for a, b in (shares[0], shares[3])),
            *(f"{shares[i]:.0e} ({shares[i - 1]})" for i in (2, 5)),
        )
        for name, real, place, shares in rows
    ]
    head = (
        "group",
        "precision",
        "rotation",
        "covariant: laws kept",
        "jaxlie: laws kept",
        "covariant: worst",
        "jaxlie: worst",
    )
    outcome.table("Laws of Lie groups", head, shown, LAWS_NOTE)


LAWS_NOTE = (
    "Allowed are 1e-8 in double precision, as in the tests of jaxlie, 2e-5 in single precision, and 1e-7 for the "
    "derivatives `∂`, as in the tests of manif; the worst law is the one that comes closest to its bound, or that "
    "exceeds it most."
)


# Values


PINOCCHIO = """
import sys
import numpy as np, pinocchio as pin
twists, elements, out = sys.argv[1:]
x, g, outcome = np.load(twists), np.load(elements), {}
for name in ("SO3", "SE3"):
    rows = {key: [] for key in ("exp", "log", "right_jacobian", "right_jacobian_inverse", "adjoint")}
    for t, m in zip(x[name], g[name]):
        if name == "SO3":
            r = pin.exp3(t)
            made = r, pin.log3(m), pin.Jexp3(t), pin.Jlog3(r), r
        else:
            r = pin.exp6(t)
            made = r.homogeneous, pin.log6(pin.SE3(m)).vector, pin.Jexp6(t), pin.Jlog6(r), r.action
        for key, value in zip(rows, made):
            rows[key].append(value)
    outcome.update({f"{name} {key}": np.array(value) for key, value in rows.items()})
np.savez(out, version=pin.__version__, **outcome)
"""


def by_pinocchio(python: str, twists: dict, elements: dict) -> dict:
    """What Pinocchio returns for twists and elements of SO3 and SE3."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, name) for name in ("twists.npz", "elements.npz", "outcome.npz")]
        np.savez(paths[0], **twists)
        np.savez(paths[1], **elements)
        subprocess.run([python, "-c", PINOCCHIO, *map(str, paths)], check=True)
        with np.load(paths[2]) as outcome:
            return dict(outcome)


OPERATIONS = ("exp", "log", "right_jacobian", "right_jacobian_inverse", "adjoint")
REGIONS = {
    "0": [0.0],
    "10⁻¹² … 10⁻⁶": np.geomspace(1e-12, 1e-6, 7),
    "10⁻⁵ … 0.1": np.geomspace(1e-5, 0.1, 9),
    "0.2 … 3": np.linspace(0.2, 3.0, 9),
    "π − 10⁻³ … π − 10⁻⁷": np.pi - np.geomspace(1e-3, 1e-7, 5),
}
"""Angles of rotation [rad]."""


def trials(name: str, seed: int = 1) -> tuple[list[str], np.ndarray]:
    """The region of each trial, and its twist, in numbers that both precisions have."""
    p, rng = Ours(name), np.random.default_rng(seed)
    regions = [region for region, angles in REGIONS.items() for _ in angles]
    x = rng.normal(size=(len(regions), p.n))
    turns = 3 if p.turning == 3 else 1
    axis = x[:, -turns:]
    angles = np.concatenate([np.asarray(a, float) for a in REGIONS.values()])
    x[:, -turns:] = axis / np.linalg.norm(axis, axis=1, keepdims=True) * angles[:, None]
    return regions, x.astype(np.float32).astype(float)


def values(p, dtype, x, g) -> dict[str, np.ndarray]:
    """What a library returns for twists x (K, n) and elements g (K, N, N)."""
    functions = {"exp": (p.exp, x), "log": (p.log, g), "adjoint": (p.adjoint, g)}
    functions |= {key: (getattr(p, key), x) for key in ("right_jacobian", "right_jacobian_inverse")}
    return {key: np.asarray(jax.jit(jax.vmap(f))(at.astype(dtype))) for key, (f, at) in functions.items()}


def compare_values(outcome: Outcome, beside: str | None) -> str:
    """Values beside those of the others, and of 60 digits; the version of Pinocchio."""
    rows, all_trials, all_exact, largest = [], {n: trials(n) for n in NAMES}, {}, {}
    for name in NAMES:
        all_exact[name] = [exact(name, row) for row in all_trials[name][1]]
    elements = {n: np.array([each.element() for each in all_exact[n]]) for n in NAMES}
    twists = {n: all_trials[n][1] for n in NAMES}
    theirs = by_pinocchio(beside, twists, elements) if beside else {}
    for name in NAMES:
        regions, x = all_trials[name]
        made = {}
        for p in (Ours(name), Jaxlie(name)):
            for dtype in REAL:
                made[type(p).__name__, dtype] = values(p, dtype, x, elements[name])
        if theirs and f"{name} exp" in theirs:
            made["Pinocchio", np.float64] = {key: theirs[f"{name} {key}"] for key in OPERATIONS}
        errors = {
            (who, dtype, key): np.array(
                [each.error(key, a, dtype) for each, a in zip(all_exact[name], value[key], strict=True)]
            )
            for (who, dtype), value in made.items()
            for key in OPERATIONS
        }
        for (*column, key), several in errors.items():
            k = int(np.argmax(several))
            place = f"{LABELS[key]} of {name}, {regions[k]} rad"
            largest[tuple(column)] = max(largest.get(tuple(column), (0.0, "")), (float(several[k]), place))
        common = np.array([region == "0.2 … 3" for region in regions])
        for who, dtype in made:
            if who == "Ours":
                continue
            for key in OPERATIONS:
                a, b = (made[w, dtype][key][common] for w in ("Ours", who))
                apart = float(np.max(np.abs(a - b)) / np.max(np.abs(a)))
                bound = 2e3 * float(np.finfo(dtype).eps)
                outcome.close(f"{key} of {name} beside {who}, {np.dtype(dtype).name}", apart, bound)
        for key in OPERATIONS:
            for dtype in REAL:
                ours = float(np.max(errors["Ours", dtype, key]))
                outcome.close(f"{key} of {name} beside 60 digits, {np.dtype(dtype).name} [units of rounding]", ours, 40)
            for region in REGIONS:
                here = np.array([r == region for r in regions])
                cells = [
                    shown(errors[(*column, key)][here].max()) if (*column, key) in errors else "–" for column in COLUMNS
                ]
                rows.append((name, LABELS[key], region.replace(" ", "\N{NO-BREAK SPACE}"), *cells))
    worst = [
        (name, shown(largest[c][0]), largest[c][1])
        for c, name in zip(COLUMNS, COLUMN_NAMES, strict=True)
        if c in largest
    ]
    outcome.table("The largest error of each", ("library, precision", "error", "where"), worst, LARGEST_NOTE)
    outcome.table("Digits", ("group", "function", "angle [rad]", *COLUMN_NAMES), rows, DIGITS_NOTE)
    return str(theirs["version"]) if theirs else ""


COLUMNS = tuple((who, np.float64) for who in ("Ours", "Jaxlie", "Pinocchio")) + tuple(
    (who, np.float32) for who in ("Ours", "Jaxlie")
)
COLUMN_NAMES = ("covariant, double", "jaxlie, double", "Pinocchio, double", "covariant, single", "jaxlie, single")
LABELS = {"exp": "exp", "log": "log", "right_jacobian": "J_r", "right_jacobian_inverse": "J_r⁻¹", "adjoint": "Ad"}
LARGEST_NOTE = (
    "In units of rounding, over all groups, functions and angles of the next table: at 1 the last digit of a number is "
    "in doubt, at 1e+12 four of sixteen digits are left."
)
DIGITS_NOTE = (
    "The largest error in the Frobenius norm, relative to the result, in units of rounding of the precision (2.2e-16 "
    "and 1.2e-7), beside arithmetic of 60 digits; the translations are of order one. The elements given to log and Ad "
    "are those of 60 digits, rounded; log is to return the twist of the exact one, and its error at no rotation is "
    "absolute. jaxlie has no J_r, so that its column there is the inverse of its J_r⁻¹, and it reads elements from "
    "matrices. Pinocchio knows SO(3) and SE(3), in double precision."
)


def shown(error: float) -> str:
    """An error with two digits."""
    return "NaN" if np.isnan(error) else f"{error:.1f}" if error < 100 else f"{error:.0e}"


def main() -> None:
    """All of it."""
    arguments = command_line()
    outcome = Outcome("")
    ask_laws(outcome)
    other = compare_values(outcome, arguments.beside)
    outcome.version = f"jaxlie {version('jaxlie')}" + (f", Pinocchio {other}" if other else "")
    outcome.write(arguments.out)


if __name__ == "__main__":
    main()
