"""Laws of closed loops: a leaf against its constraint, its metric, and the same machine described otherwise."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from covariant import models, observers
from covariant._integrate import rk4_step
from covariant.geometry import Coordinates, KineticEnergy, Leaf

GRAVITY = 9.81


class Link(NamedTuple):
    """A bar of a planar linkage: from the end of another one, or a fixed point, at an angle relative to that one."""

    before: int | None
    foot: tuple[float, float]
    length: float
    mass: float
    inertia: float


class Linkage(NamedTuple):
    """A planar linkage that is closed where the ends of two of its bars meet, with its motors and where it starts."""

    links: tuple[Link, ...]
    ends: tuple[int, int]
    start: tuple[float, ...]
    motors: tuple[int, ...]
    rates: tuple[float, ...]
    drag: tuple[float, ...]
    change: np.ndarray | None = None

    def places(self, q):
        """Middles and ends of the bars (k, 2) each, and their directions (k,)."""
        q = q if self.change is None else jnp.asarray(self.change) @ q
        middles, ends, angles = [], [], []
        for k, link in enumerate(self.links):
            start = jnp.asarray(link.foot) if link.before is None else ends[link.before]
            angle = q[k] if link.before is None else angles[link.before] + q[k]
            along = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
            middles.append(start + link.length / 2 * along)
            ends.append(start + link.length * along)
            angles.append(angle)
        return jnp.stack(middles), jnp.stack(ends), jnp.stack(angles)

    def constraint(self, q):
        ends = self.places(q)[1]
        return ends[self.ends[0]] - ends[self.ends[1]]

    def energy(self, q, v):
        (_, _, _), (speed, _, turn) = jax.jvp(self.places, (q,), (v,))
        mass, inertia = (jnp.array([getattr(link, name) for link in self.links]) for name in ("mass", "inertia"))
        return (mass @ jnp.sum(speed**2, axis=1) + inertia @ turn**2) / 2

    def potential(self, q):
        return GRAVITY * jnp.array([link.mass for link in self.links]) @ self.places(q)[0][:, 1]

    def system(self, damped=True) -> models.MechanicalSystem:
        n = len(self.links)
        tree = KineticEnergy(self.energy, manifold=Coordinates((), n))
        drag = jnp.array(self.drag) if damped else jnp.zeros(n)
        to_links = np.eye(n) if self.change is None else self.change

        def force(t, q, u):
            return jnp.asarray(to_links.T[:, list(self.motors)]) @ u

        return models.MechanicalSystem(
            Leaf.closing(tree, self.constraint, jnp.array(self.start)),
            self.potential,
            force,
            lambda q, v: -drag * v,
            coordinates=tuple(f"q{k + 1}" for k in range(n)),
            units=("rad",) * n,
            inputs=len(self.motors),
        )


FOUR_BAR = Linkage(
    (
        Link(None, (0.0, 0.0), 0.15, 0.5, 0.002),
        Link(0, (0.0, 0.0), 0.4, 0.6, 0.01),
        Link(None, (0.35, 0.0), 0.3, 0.8, 0.008),
    ),
    (1, 2),
    (0.6, -0.11, 1.13),
    (0,),
    (2.5,),
    (0.01, 0.005, 0.01),
)
FIVE_BAR = Linkage(
    (
        Link(None, (0.0, 0.0), 0.25, 1.0, 0.01),
        Link(0, (0.0, 0.0), 0.4, 0.6, 0.012),
        Link(None, (0.2, 0.0), 0.3, 1.1, 0.011),
        Link(2, (0.0, 0.0), 0.35, 0.5, 0.01),
    ),
    (1, 3),
    (-1.9, 0.94, -1.1, -1.03),
    (0, 2),
    (1.2, -1.0),
    (0.05, 0.02, 0.05, 0.02),
)
LINKAGES = {"four-bar": FOUR_BAR, "five-bar": FIVE_BAR}
linkages = pytest.mark.parametrize("name", LINKAGES)


@functools.cache
def made(name: str) -> tuple[models.MechanicalSystem, np.ndarray, np.ndarray]:
    """The system without friction, where it starts, and its velocity there."""
    linkage = LINKAGES[name]
    system = linkage.system(damped=False)
    q, rows = system.space.assembly, system.space.normals(system.space.assembly).rows
    n, motors = len(q), np.eye(len(q))[list(linkage.motors)]
    v = np.linalg.solve(np.vstack([motors, rows]), np.r_[linkage.rates, np.zeros(n - len(motors))])
    return system, np.asarray(q), v


def inputs(t, count):
    return jnp.stack([0.6 * jnp.sin((5 - k) * t + k) + (-1) ** (k + 1) * 0.6 for k in range(count)])


def vectors(system, q, count):
    along = jax.vmap(lambda a: system.space.projected(q, a))
    return along(jnp.asarray(np.random.default_rng(0).normal(size=(count, len(q)))))


# The connection


# The flow


# Observers, from the encoders of the motors alone


@pytest.mark.exhaustive("five-bar", "four-bar")
@pytest.mark.long("five-bar")
@linkages
def test_error_law_from_the_encoders_of_the_motors(name):
    """To first order `ξ' = ζ − αξ, ζ' = −βξ` in a frame that is carried in parallel, at any velocity."""
    (system, q, v), linkage = made(name), LINKAGES[name]
    alpha, beta, h, steps = 1.2, 1.1, 1e-3, 500
    observer = observers.Intrinsic(system, alpha, beta)
    space, start = system.space, observers.continuous(observer.init(jnp.asarray(q)))
    measured = jnp.array([k in linkage.motors for k in range(len(q))])
    xi, zeta = vectors(system, jnp.asarray(q), 2)

    def run(size):
        def flow(t, now):
            true, rate, place, estimate, frame = now
            y, u = jnp.where(measured, true, jnp.nan), inputs(t, len(linkage.motors))
            change = observer.flow(t, start._replace(q=place, v=estimate, t=t), u, y)
            turned = -jax.vmap(lambda a: space.connection(true, rate, a))(frame)
            return rate, models.acceleration(system, t, true, rate, u), change.q, change.v, turned

        def step(now, k):
            true, rate, place, estimate, frame = rk4_step(flow, k * h, now, h)
            return (*space.restored(true, rate), *space.restored(place, estimate), frame), None

        begin = jnp.asarray(q) + size * xi, v + size * (zeta - space.connection(jnp.asarray(q), jnp.asarray(v), xi))
        now = jnp.asarray(q), jnp.asarray(v), *begin, jnp.stack([xi, zeta])
        return jax.lax.scan(step, now, jnp.arange(steps, dtype=float))[0]

    ends = jax.jit(jax.vmap(run))(jnp.array([-1e-4, 0.0, 1e-4]))
    true, rate, _, _, frame = (end[1] for end in ends)
    change = [(end[2] - end[0]) / 2e-4 for end in ends]  # to first order, the second cancels
    error = jnp.stack([change[2], change[3] + space.connection(true, rate, change[2])])
    expected = expm(np.array([[-alpha, 1.0], [-beta, 0.0]]) * h * steps) @ np.asarray(frame)
    np.testing.assert_allclose(error, expected, atol=1e-6 * np.abs(expected).max())


# Refused by name


def test_a_loop_that_does_not_close_or_branches_is_refused():
    apart = FOUR_BAR._replace(links=(*FOUR_BAR.links[:2], FOUR_BAR.links[2]._replace(foot=(2.0, 0.0))))
    with pytest.raises(ValueError, match="does not close"):
        apart.system()
    bar = Link(None, (0.0, 0.0), 0.2, 0.5, 0.002)
    flat = FOUR_BAR._replace(
        links=(bar, bar._replace(before=0, length=0.35), bar._replace(foot=(0.35, 0.0))), start=(0.0, 0.0, 0.0)
    )
    with pytest.raises(ValueError, match="change point"):
        flat.system()
