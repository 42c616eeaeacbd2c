"""Random systems of every kind that a proof may trip over, harmless and harmful ones mixed, and what they really do.

A system is a few numbers: the gains and the region of its observer, and a law of friction put together from terms
`size · along · shape((s − at) / width)`, where s is a combination of place and velocity. Friction of any shape brakes
or drives, by its sign. What `certify` says of it is compared with motions simulated in NumPy, all estimates at once.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from systems import EFFORT, certified, wrapped

from covariant import geometry, models
from covariant.certificates import ContractionCertificate, optimal_lyapunov
from covariant.observers import Intrinsic

SHAPES: dict[str, Callable] = {
    "step": lambda xp, r: xp.where(r > 0, 1.0, 0.0),
    "sign": lambda xp, r: xp.sign(r),
    "stairs": lambda xp, r: xp.floor(r),
    "rounded": lambda xp, r: xp.round(r + 0.5),
    "angle": lambda xp, r: xp.arctan2(r, 0 * r - 1.0) / 2,
    "table": lambda xp, r: xp.array([0.0, 1.0, 1.0])[xp.clip((r > 0).astype(int), 0, 2)],
    "abs": lambda xp, r: xp.abs(r),
    "ramp": lambda xp, r: xp.clip(r, -1.0, 1.0),
    "half": lambda xp, r: xp.maximum(r, 0.0),
    "choice": lambda xp, r: xp.where(r > 0, r, 0.0),
    "hat": lambda xp, r: xp.maximum(0.0, 1 - xp.abs(r)),
    "quadratic": lambda xp, r: r * xp.abs(r),
    "smooth": lambda xp, r: xp.arctan(r),
    "wave": lambda xp, r: xp.sin(r),
    "straight": lambda xp, r: r,
    "nothing of a root": lambda xp, r: 0 * xp.sqrt(r),
    "nothing of an inverse": lambda xp, r: 0 / r,
    "nothing of a logarithm": lambda xp, r: xp.log(r) - xp.log(r),
    "a quotient with itself": lambda xp, r: r / r,
    "nothing of asin": lambda xp, r: 0 * xp.arcsin(r / 2),
    "nothing of a tangent": lambda xp, r: 0 * xp.tan(r),
    "a root": lambda xp, r: xp.sqrt(r),
    "a power": lambda xp, r: r**1.5,
}
"""Functions of one number. The first six jump; of the next five the slope does; the last are not defined everywhere."""
NAMES = list(SHAPES)
JUMPS, KINKS, SMOOTH, PARTLY = NAMES[:6], NAMES[6:12], NAMES[11:15], NAMES[15:]


class Term(NamedTuple):
    """`size · along · shape((place·x + speed·v − at) / width)`."""

    shape: str
    size: float
    at: float
    width: float
    place: tuple[float, ...]
    speed: tuple[float, ...]
    along: tuple[float, ...]

    def inside(self, x, v):
        """What the shape is of."""
        whole = np.asarray(self.speed) @ v
        if any(self.place):
            whole = whole + np.asarray(self.place) @ x
        return (whole - self.at) / self.width

    def __call__(self, xp, x, v):
        return xp.tensordot(xp.array(self.along), self.size * SHAPES[self.shape](xp, self.inside(x, v)), axes=0)

    @property
    def slope(self) -> float:
        """How steep it is, at most, where it is not a jump."""
        steep = math.hypot(*self.place) + math.hypot(*self.speed)
        return abs(self.size / self.width) * steep * math.hypot(*self.along)


class System(NamedTuple):
    """An observer on a region, and the friction of its model.

    `space`: "line", "plane" or "circle"; groups are for `test_place.py` and `test_injectivity.py`.
    `harmless`: whether it was meant so.
    """

    kind: str
    space: str
    damping: float
    terms: tuple[Term, ...]
    alpha: float
    beta: float
    q: np.ndarray
    bounds: dict[str, Any]
    harmless: bool
    stiffness: float = 0.0

    @property
    def n(self) -> int:
        return 2 if self.space == "plane" else 1

    def friction(self, xp, x, v):
        return sum((term(xp, x, v) for term in self.terms), -self.damping * v)

    def force(self, x):
        """The force of the springs, which the observer takes at the measured place."""
        return -self.stiffness * np.sin(x)

    def observer(self) -> Intrinsic:
        def friction(x, v):
            return self.friction(jnp, x, v)

        stiffness, circles = self.stiffness, (0,) if self.space == "circle" else ()
        potential, names = lambda q: -stiffness * jnp.sum(jnp.cos(q)), ("x", "y")[: self.n]
        model = models.Lagrangian(geometry.Euclidean(), potential, None, friction, circles, coordinates=names)
        return Intrinsic(model, self.alpha, self.beta)

    def certify(self, **more) -> ContractionCertificate | None:
        """What is said about it; None where it is refused."""
        return certified(self.observer(), q=self.q, **(EFFORT | self.bounds | more))


# What they really do.


class Motions(NamedTuple):
    """True motions and estimates, and the input that each motion gets: "none", "hold" or "push" by column."""

    x: np.ndarray
    v: np.ndarray
    estimated: np.ndarray
    speed: np.ndarray


class World:
    """A system as ordinary differential equations for arrays with one column a motion."""

    def __init__(self, system: System, hold: np.ndarray, push: np.ndarray, noise=None, unknown=None):
        self.system, self.hold, self.push, self.noise, self.unknown = system, hold, push, noise, unknown
        self.most = np.broadcast_to(np.asarray(system.bounds.get("input", 0.0), float), (system.n,))[:, None]

    def offset(self, estimated, x):
        off = estimated - x
        return wrapped(off) if self.system.space == "circle" else off

    def change(self, k: int, s: Motions) -> list[np.ndarray]:
        """Velocities of true and estimated places, and accelerations, while the k-th noise acts."""
        system = self.system
        pull = system.friction(np, s.x, s.v)
        known = np.clip(np.where(self.hold, -pull, self.push), -self.most, self.most)
        unknown = 0.0 if self.unknown is None else self.unknown[k]
        spring = system.force(s.x) if system.stiffness else 0.0
        off, measured = self.offset(s.estimated, s.x), spring
        if self.noise is not None:
            off = off - self.noise[k]
            measured = system.force(s.x + self.noise[k]) if system.stiffness else 0.0
        rubbing = system.friction(np, s.estimated, s.speed)
        w = s.speed - system.alpha * off
        accelerated = known + measured + rubbing - system.beta * off
        return [s.v, w, pull + known + unknown + spring, accelerated]

    def moved(self, s: Motions, h: float, d: list[np.ndarray]) -> Motions:
        return Motions(s.x + h * d[0], s.v + h * d[2], s.estimated + h * d[1], s.speed + h * d[3])

    def step(self, k: int, s: Motions, h: float) -> Motions:
        """A step of the classical Runge–Kutta rule."""
        a = self.change(k, s)
        b = self.change(k, self.moved(s, h / 2, a))
        c = self.change(k, self.moved(s, h / 2, b))
        d = self.change(k, self.moved(s, h, c))
        return self.moved(s, h, [(p + 2 * q + 2 * r + t) / 6 for p, q, r, t in zip(a, b, c, d, strict=True)])

    def distance(self, s: Motions) -> np.ndarray:
        """Distances (k,) of estimates from the truth."""
        q, xi, zeta = self.system.q, self.offset(s.estimated, s.x), s.speed - s.v
        squares = q[0, 0] * xi**2 + 2 * q[0, 1] * xi * zeta + q[1, 1] * zeta**2
        return np.sqrt(squares.sum(axis=0) / 2)

    def resolved(self, s: Motions) -> np.ndarray:
        """Whether errors are far above the last digits of the states, whose differences they are."""
        sizes = np.abs(s.x).max(axis=tuple(range(s.x.ndim - 1))) + np.abs(s.v).max(axis=0)
        lengths = self.distance(s) / np.sqrt(self.system.q.max())
        return ~(lengths < 1e-11 * sizes)

    def kept(self, s: Motions) -> np.ndarray:
        """Whether the true motion is within its bounds."""
        bounds = self.system.bounds
        inside = (np.abs(s.v) <= np.reshape(bounds["velocity"], (-1, 1))).all(axis=0)
        low, high = (np.reshape(side, (-1, 1)) for side in bounds["position"])
        return inside & ((s.x >= low) & (s.x <= high)).all(axis=0)


def starts(system: System, radius: float, rng, count: int = 192) -> Motions:
    """True states in the region, many of them where a shape bends or jumps, and estimates within the radius."""
    n, bounds = system.n, system.bounds
    limit = np.broadcast_to(np.asarray(bounds["velocity"], float), (n,))[:, None]
    v = limit * np.clip(rng.uniform(-1.2, 1.2, (n, count)), -1, 1)
    low, high = (np.broadcast_to(np.asarray(side, float), (n,))[:, None] for side in bounds["position"])
    x = low + (high - low) * np.clip(rng.uniform(-0.1, 1.1, (n, count)), 0, 1)
    x[:, ::8] = high
    v[:, ::4] = 0.0
    for term in system.terms:
        aimed = rng.random(count) < 0.6
        speed = np.reshape(term.speed, (-1, 1))
        if not speed.any():
            continue
        miss = term.inside(x, v) * term.width
        better = v - speed * miss / (speed**2).sum() + rng.choice([0.0, 1e-9, -1e-9], count)
        v = np.where(aimed & (np.abs(better) <= limit).all(axis=0), better, v)
    directions = rng.normal(size=(2 * n, count))
    directions /= np.sqrt((directions**2).sum(axis=0))
    # On a sphere of the metric all directions are alike.
    root = np.linalg.cholesky(system.q / 2)
    both = np.einsum("ij,jnk->ink", np.linalg.inv(root).T, directions.reshape(2, n, count))
    both *= radius * rng.choice([1.0, 0.7, 1e-2, 1e-5], count) * (1 - 1e-9)
    return Motions(x, v, x + both[0], v + both[1])


def contradiction(system: System, found: ContractionCertificate, seed: int, drift: float = 0.0, **acting) -> float:
    """How far simulated distances exceed what the certificate allows, at most: above 1 it is false.

    `drift`: the steady distance that noise and unknown forces may bring, per its claim.
    """
    rng = np.random.default_rng(seed)
    begin = starts(system, found.radius, rng)
    count = begin.v.shape[1]
    limit = np.broadcast_to(np.asarray(system.bounds.get("input", 0.0), float), (system.n,))[:, None]
    push = limit * rng.choice([-1.0, 0.0, 1.0], (system.n, count))
    world = World(system, rng.random(count) < 0.5, push, **acting)
    steep = system.damping + system.alpha + sum(t.slope for t in system.terms if t.shape not in JUMPS)
    steps = 500
    h = min(3 / system.alpha / steps, 0.3 / steep)
    first = world.distance(begin)
    now, keeps, worst = begin, world.kept(begin) & world.resolved(begin), 0.0
    with np.errstate(all="ignore"):
        for k in range(steps):
            now = world.step(k, now, h)
            keeps &= world.kept(now) & world.resolved(now)
            shrunk = math.exp(-found.rate / 2 * (k + 1) * h)
            allowed = first * shrunk + drift * (1 - shrunk)
            part = np.where(keeps, world.distance(now) / allowed, 0.0)
            worst = max(worst, float(np.nan_to_num(part, nan=np.inf, posinf=np.inf).max()))
    return worst


def is_defined(system: System, seed: int) -> bool:
    """Whether the friction is a number wherever estimates may be, as far as points of the region tell."""
    rng, n, count = np.random.default_rng(seed), system.n, 2000
    error = np.reshape(system.bounds["error"], (-1, 1))
    limit = np.reshape(system.bounds["velocity"], (-1, 1))
    v = limit * np.clip(rng.uniform(-1.3, 1.3, (n, count)), -1, 1)
    v[:, ::7] = 0.0
    low, high = (np.reshape(side, (-1, 1)) for side in system.bounds["position"])
    x = low - error + (high - low + 2 * error) * np.clip(rng.uniform(-0.1, 1.1, (n, count)), 0, 1)
    with np.errstate(all="ignore"):
        return bool(np.isfinite(system.friction(np, x, v)).all())


# Random ones.


def spread(rng, low: float, high: float) -> float:
    """A number between two of the same sign, of any size alike."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def base(kind: str, space: str, rng, harmless: bool) -> System:
    """Random gains, and a region to which they suit."""
    alpha = spread(rng, 3, 60)
    beta = alpha**2 * spread(rng, 0.3, 1.0)
    best = -2 * np.linalg.eigvals(np.array([[-alpha, 1], [-beta, 0]])).real.max()
    q = optimal_lyapunov(alpha, beta, best * rng.uniform(0.3, 0.8))
    bounds = {"velocity": spread(rng, 0.3, 3), "error": spread(rng, 0.02, 0.5), "input": spread(rng, 0.01, 10)}
    n = 2 if space == "plane" else 1
    low = rng.uniform(-1.5, 0.5, n)
    region = {"rate": best * rng.uniform(0.05, 0.25), "position": (low, low + rng.uniform(0.2, 2, n))}
    damping = spread(rng, 0.05, 2) if rng.random() < 0.8 else 0.0
    return System(kind, space, damping, (), alpha, beta, q, bounds | region, harmless)


def combination(rng, n: int, of_place: bool) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Weights of the place and of the velocity: one velocity, or a mixture."""
    speed, place = np.eye(n)[rng.integers(n)] if rng.random() < 0.7 else rng.normal(size=n), np.zeros(n)
    if of_place:
        place[rng.integers(n)] = rng.normal()
        speed = speed * rng.integers(0, 2)
    return tuple(place), tuple(speed)


def term(rng, system: System, shapes: list[str], size: float, *, of_place=False) -> Term:
    """A term of one of the shapes; a positive size drives where a driven shape rises."""
    place, speed = combination(rng, system.n, of_place)
    velocity = float(system.bounds["velocity"])
    along = np.asarray(speed) if any(speed) else np.eye(system.n)[0]
    at = velocity * rng.choice([0.0, rng.uniform(-0.9, 0.9), 1.0]) if rng.random() < 0.8 else 0.0
    width = velocity * spread(rng, 0.02, 1)
    return Term(str(rng.choice(shapes)), size * width, at, width, place, speed, tuple(along))


def discontinuity(rng, index: int) -> System:
    """Jumps of either sign, of any size, or none."""
    harmless = index % 3 == 0
    system = base("discontinuity", str(rng.choice(["line", "line", "plane"])), rng, harmless)
    if harmless:
        return system._replace(terms=(term(rng, system, SMOOTH, -spread(rng, 0.01, 1)),))
    size = rng.choice([-1, 1, 1]) * spread(rng, 1, 1e3)
    made = term(rng, system, JUMPS, size, of_place=rng.random() < 0.3)
    return system._replace(terms=(made,))


def kink(rng, index: int) -> System:
    """Kinks of either sign, from slopes that the gains can bear to steep ones."""
    harmless = index % 2 == 0
    system = base("kink", str(rng.choice(["line", "line", "plane"])), rng, harmless)
    shapes = ["ramp", "half", "quadratic"] if harmless else KINKS
    size = -spread(rng, 0.05, 3) if harmless else rng.choice([-1, 1]) * system.alpha * spread(rng, 0.05, 20)
    made = term(rng, system, shapes, size, of_place=not harmless and rng.random() < 0.2)
    made = made._replace(width=max(made.width, 0.2 * float(system.bounds["velocity"]))) if harmless else made
    return system._replace(terms=(made,))


def place(rng, index: int) -> System:
    """Friction by the place, or by the velocity alone."""
    harmless = index % 3 == 0
    system = base("place", str(rng.choice(["line", "plane", "circle"])), rng, harmless)
    if harmless:
        return system._replace(terms=(term(rng, system, ["quadratic", "smooth"], -spread(rng, 0.05, 2)),))
    made = term(rng, system, ["smooth", "wave", "straight", "abs"], system.alpha * spread(rng, 0.1, 50), of_place=True)
    return system._replace(terms=(made,))


def injectivity(rng, index: int) -> System:
    """Errors from small ones to more than a whole turn."""
    harmless = index % 2 == 0
    system = base("injectivity", "circle", rng, harmless)
    error = rng.uniform(0.1, 3.1) if harmless else rng.choice([rng.uniform(3, 3.3), rng.uniform(3.1, 7)])
    return system._replace(bounds=system.bounds | {"error": float(error)})


def definedness(rng, index: int) -> System:
    """Functions that are not defined everywhere, at places inside and outside of the region."""
    harmless = index % 3 == 0
    system = base("definedness", str(rng.choice(["line", "plane", "circle"])), rng, harmless)
    made = term(rng, system, PARTLY, -rng.uniform(0.1, 1), of_place=rng.random() < 0.3)
    if harmless:
        made = term(rng, system, PARTLY, -rng.uniform(0.1, 1))
        shape = "nothing of a root" if made.shape in ("nothing of asin", "nothing of a tangent") else made.shape
        made = made._replace(shape=shape, at=-20 * float(system.bounds["velocity"]) * (1 + math.hypot(*made.speed)))
    return system._replace(terms=(made,))


def noise(rng, index: int) -> System:
    """Springs under noise and unknown forces."""
    harmless = index % 3 == 0
    system = base("noise", "line", rng, harmless)
    stiffness = 0.0 if harmless else float(system.beta * spread(rng, 0.01, 10) * rng.choice([-1, 1]))
    error = float(system.bounds["error"])
    some = {"noise": error * spread(rng, 1e-5, 1e-3 if harmless else 0.3), "disturbance": 0.0}
    if rng.random() < 0.5:
        some["disturbance"] = system.beta * error * spread(rng, 1e-5, 1e-3 if harmless else 0.3)
    return system._replace(bounds=system.bounds | some, stiffness=stiffness)


MAKERS = (discontinuity, kink, place, injectivity, definedness, noise)
KINDS: dict[str, Callable[[np.random.Generator, int], System]] = {make.__name__: make for make in MAKERS}


def draw(kind: str, index: int) -> System:
    """The system of a kind with that number, always the same."""
    return KINDS[kind](np.random.default_rng([list(KINDS).index(kind), index]), index)
