"""The geometry that the inertia of a Panda gives to its joint angles: curvature, geodesics, conditioning.

With the kinetic energy as metric the configurations of an arm are a curved space. Where its curvature is negative, free
motions that start side by side part; where it is positive they meet. Free motions are its geodesics, the shortest ways
in √(kg m²); straight lines of the joint angles are none, and cost more. How different the inertia is in different
directions is its condition number.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from covariant.geometry import Budget, sectional_curvature
from covariant.models import robots
from covariant.report import PALETTE, new_figure, save_figure

FIGURE = Path(__file__).parent / "out" / "13_geometry_of_a_panda.png"
SHOULDER, ELBOW, WRIST = 1, 3, 5
POINTS = 81
REST = jnp.array([0.0, 0.2, 0.0, -1.6, 0.0, 1.8, 0.5])
WAYS = {
    "bend the elbow": ((0, 0.0, 0, -2.8, 0, 2.8, 0.8), (0, 0.0, 0, -0.3, 0, 0.3, 0.8)),
    "reach out and turn": ((0, -0.8, 0, -2.6, 0, 1.8, 0.8), (1.6, 0.9, 0, -0.5, 0, 1.4, 0.8)),
}
"""From where to where [rad]."""
BUDGET = Budget(steps=16, conjugate=False)

panda = robots.load("panda")
space = panda.space
limits = {joint.name: (joint.lower, joint.upper) for joint in robots.read("panda").joints}
low, high = np.array([limits[name] for name in panda.coordinates]).T
axes_of_joints = jnp.eye(7)


@jax.jit
@jax.vmap
def looked_at(q):
    """At q: sectional curvature [1/(kg m²)] of shoulder and elbow, condition number of the inertia matrix."""
    values = jnp.linalg.eigvalsh(space(q))
    return sectional_curvature(space, q, axes_of_joints[SHOULDER], axes_of_joints[ELBOW]), values[-1] / values[0]


@jax.jit
def way(start, end):
    """Points (k, 7) of the shortest way, the lengths of it and of the straight line, and how far the search missed."""
    shot = space.shoot(start, end, None, BUDGET)
    parts = jnp.linspace(0.0, 1.0, 33)
    none = jnp.zeros((0, 7))
    points = jax.vmap(lambda s: space.transport_along(start, s * shot.velocity, none, BUDGET).q)(parts)
    straight = jax.vmap(lambda s: space.norm(start + s * (end - start), end - start))(parts)
    return points, space.norm(start, shot.velocity), jnp.mean((straight[1:] + straight[:-1]) / 2), shot.residual


def hand(points):
    """Heights and distances from the axis of the base of the hand (k, 2) [m]."""
    places = jax.vmap(lambda q: space.pose(q, "panda_hand")[:3, 3])(jnp.asarray(points))
    return np.stack([np.hypot(places[:, 0], places[:, 1]), places[:, 2]], axis=1)


elbow, wrist = (np.linspace(low[i], high[i], POINTS) for i in (ELBOW, WRIST))
mesh = np.stack(np.meshgrid(elbow, wrist), -1).reshape(-1, 2)
grid = jnp.tile(REST, (len(mesh), 1)).at[:, jnp.array([ELBOW, WRIST])].set(mesh)
curvature, condition = (np.asarray(part).reshape(POINTS, POINTS) for part in looked_at(grid))
print(f"curvature of shoulder and elbow: {curvature.min():.3g} to {curvature.max():.3g} 1/(kg m²)")
print(f"condition number: {condition.min():.0f} to {condition.max():.0f}")

figure, axes = new_figure(
    2,
    2,
    panel=(4.5, 3.4),
    titles=(
        "Curvature of shoulder and elbow [1/(kg m²)]",
        "Condition number of the inertia",
        "Ways of the joints",
        "Ways of the hand",
    ),
    sharex=False,
)
size = np.abs(curvature).max()
for ax, values, look in (
    (axes[0, 0], curvature, {"cmap": "RdBu_r", "vmin": -size, "vmax": size}),
    (axes[0, 1], condition, {"cmap": "viridis"}),
):
    shown = ax.pcolormesh(elbow, wrist, values, shading="gouraud", **look)
    figure.colorbar(shown, ax=ax)
    ax.set(xlabel="elbow q₄ [rad]", ylabel="wrist q₆ [rad]")
for (name, ends), color in zip(WAYS.items(), PALETTE, strict=False):
    start, end = (jnp.array(q, float) for q in ends)
    points, shortest, straight, missed = way(start, end)
    line = np.stack([start, end])
    print(f"{name}: shortest way {shortest:.3f}, straight line {straight:.3f} √(kg m²), missed by {missed:.1e}")
    print("  farthest from the line:", np.round(np.abs(points - np.linspace(start, end, 33)).max(axis=0), 2))
    axes[1, 0].plot(points[:, SHOULDER], points[:, ELBOW], color)
    axes[1, 0].plot(*line[:, [SHOULDER, ELBOW]].T, color, linestyle="--")
    axes[1, 1].plot(*hand(points).T, color, label=f"{name}: {shortest:.3f} √(kg m²)")
    axes[1, 1].plot(
        *hand(np.linspace(start, end, 33)).T, color, linestyle="--", label=f"straight: {straight:.3f} √(kg m²)"
    )
axes[1, 0].set(xlabel="shoulder q₂ [rad]", ylabel="elbow q₄ [rad]")
axes[1, 1].set(xlabel="distance of the hand from the axis of the base [m]", ylabel="height [m]", ylim=(0.15, 1.15))
axes[1, 1].legend(loc="upper right")
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
