"""Models a free-floating satellite with an arm: a pose and joint angles, coupled by a joint-dependent inertia."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._typing import Matrix
from covariant.geometry import Coordinates, Metric, ProductManifold
from covariant.geometry.lie import SE3
from covariant.models._mechanical import MechanicalSystem
from covariant.models._parameters import Parameter, Parametric

_SOURCE = "chosen: of the size of a small servicing satellite"
_AXES = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))


def satellite_arm(
    mass: float = 50.0,
    inertia: Sequence[float] = (6.0, 7.0, 5.0),
    link_mass: Sequence[float] = (4.0, 3.0),
    link_length: Sequence[float] = (0.8, 0.6),
    bearing: float = 0.0,
) -> MechanicalSystem:
    """Free-floating satellite with an arm of two slender links; inputs are the two motor torques [N m].

    A configuration (18,) is the pose T_world_body (4, 4), row by row, followed by the two joint angles. The velocity v
    (8,) is the twist (v, ω) of the body about its centre of mass, followed by the joint rates. The arm is mounted at
    0.3 m along x and is straight at angles 0; the first joint turns about z, the second about y. There is no gravity,
    and motors do not change the momentum.

    Args:
        mass: Mass of the body alone [kg].
        inertia: Principal moments (3,) of the body alone [kg m²].
        link_mass: Masses of the two links [kg].
        link_length: Lengths of the two links [m].
        bearing: Friction coefficient of the joints [N m s/rad].

    Returns:
        The system with eight velocities and two inputs.

    Example:
        >>> from covariant import models
        >>> arm = models.satellite_arm(mass=50.0, link_mass=(4.0, 3.0))
        >>> arm.space(arm.manifold.origin())[0, 0].item()  # translation moves the total mass
        57.0
    """
    mount, roots = 0.3, (0.3, 0.3 + link_length[0])
    bodies = [_spatial_inertia(mass, np.zeros(3), np.diag(np.asarray(inertia, float)))]
    for m, length, root in zip(link_mass, link_length, roots, strict=True):
        # Inertia of a thin rod about its centre, along x.
        slender = m * length**2 / 12 * np.diag([0.0, 1.0, 1.0])
        bodies.append(_spatial_inertia(m, np.array([root + length / 2, 0.0, 0.0]), slender))
    pairs = zip(roots, _AXES, strict=True)
    # A rotation about an axis through `root` moves the body's point at the origin at axis × (−root) = root × axis.
    screws = np.stack([np.concatenate([np.cross([root, 0.0, 0.0], axis), axis]) for root, axis in pairs])
    columns = np.zeros((len(screws), 6, 6 + len(screws)))
    for i, screw in enumerate(screws):
        columns[i, :, 6 + i] = screw
    turns = np.stack([_ad(screw) for screw in screws])
    manifold = ProductManifold((SE3, Coordinates((0, 1), 2)))
    return MechanicalSystem(
        Metric(ArmInertia(*map(jnp.asarray, (np.stack(bodies), columns, turns))), manifold=manifold),
        force=_at_the_joints,
        dissipation=Parametric(_joint_friction, bearing=bearing),
        coordinates=("joint1", "joint2"),
        units=("rad", "rad"),
        velocities=("v1", "v2", "v3", "w1", "w2", "w3", "rate1", "rate2"),
        velocity_units=("m/s",) * 3 + ("rad/s",) * 5,
        inputs=2,
        parameters={
            "mass": Parameter(mass, "kg", _SOURCE),
            "inertia": Parameter(inertia, "kg m^2", _SOURCE),
            "link_mass": Parameter(link_mass, "kg", _SOURCE),
            "link_length": Parameter(link_length, "m", _SOURCE),
            "mount": Parameter(mount, "m", _SOURCE),
            "bearing": Parameter(bearing, "N m s/rad", _SOURCE),
        },
    )


class ArmInertia(eqx.Module):
    """Inertia matrix (6 + k, 6 + k) of a body with a serial arm, for its twist and the k joint rates.

    The twist of link i is `J_i` times the velocity, with `J_i = Ad(exp(−S_i q_i)) J_{i−1} + columns[i]` and
    `Ad(exp(−S q)) = 1 − sin q ad(S) + (1 − cos q) ad(S)²` for a joint that turns. The inertia is the sum of
    `J_iᵀ bodies[i] J_i`. Source: Lynch & Park 2017, Modern Robotics, section 8.3.

    Attributes:
        bodies: Spatial inertias (k + 1, 6, 6) of the body and the links, in the body frame with the arm straight.
        columns: Screw S of each joint in the column of its rate, zero elsewhere (k, 6, 6 + k), in the same frame.
        turns: Matrices ad(S) (k, 6, 6), in the same frame.

    Example:
        >>> from covariant import models
        >>> arm = models.satellite_arm()
        >>> inertia = arm.space.matrix
        >>> type(inertia).__name__, inertia(arm.manifold.origin()).shape
        ('ArmInertia', (8, 8))
    """

    bodies: Float[Array, "links 6 6"]
    columns: Float[Array, "k 6 n"]
    turns: Float[Array, "k 6 6"]

    def __call__(self, x: Float[Array, "m"]) -> Matrix:
        bodies, columns, turns = (a.astype(x.dtype) for a in (self.bodies, self.columns, self.turns))
        k = turns.shape[0]
        s, c = (a[:, None, None] for a in (jnp.sin(x[-k:]), jnp.cos(x[-k:])))
        # The Rodrigues formula ends with ad², since ad(S)³ = −ad(S) for a unit screw without pitch.
        carried = np.eye(6, dtype=x.dtype)[None] - s * turns + (1 - c) * (turns @ turns)
        jacobians = [jnp.asarray(np.eye(6, 6 + k, dtype=x.dtype))]
        for carry, column in zip(carried, columns, strict=True):
            jacobians.append(carry @ jacobians[-1] + column)
        jacobian = jnp.stack(jacobians)
        return jnp.sum(jnp.swapaxes(jacobian, 1, 2) @ (bodies @ jacobian), axis=0)


def _spatial_inertia(mass: float, centre: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Spatial inertia (6, 6) for twists (v, ω) about the origin, of a body with `inertia` about its centre of mass."""
    cross = np.cross(np.eye(3), centre)  # row i is e_i × c, so that ω × c = ω @ cross
    # The energy is ½m|v + ω × c|² + ½ωᵀIω; the lower right block is Steiner's theorem.
    return np.block([[mass * np.eye(3), mass * cross.T], [mass * cross, inertia + mass * cross @ cross.T]])


def _ad(screw: np.ndarray) -> np.ndarray:
    """`ad(S)` (6, 6): the bracket with a twist (v, ω), `(ω × v' − ω' × v, ω × ω')`."""
    v, w = (np.cross(part, np.eye(3)).T for part in (screw[:3], screw[3:]))
    return np.block([[w, v], [np.zeros((3, 3)), w]])


def _joint_friction(q, v, bearing):
    return jnp.concatenate([jnp.zeros(6, v.dtype), -bearing * v[6:]])


def _at_the_joints(t, q, u):
    return jnp.concatenate([jnp.zeros(6, u.dtype), u])
