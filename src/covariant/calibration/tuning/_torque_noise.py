"""White noise of the torques of joints, as noise of the acceleration: what is noisy is a covector."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._typing import Matrix, Vector
from covariant.geometry import AbstractSpace


class TorqueNoise(Functional):
    """Spectral density `A + M⁻¹ W M⁻¹` of the acceleration noise, a function of the configuration.

    Where a joint meets little inertia the same torque accelerates it more, and it accelerates the other joints as well.

    Attributes:
        space: Configuration space, with the kinetic energy M as metric.
        acceleration: Spectral density A (n, n) of accelerations that are noisy by themselves, in the frame.
        torque: Roots (n,) of the spectral densities of the torques, whose squares are the diagonal W [N² s, (N m)² s].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models
        >>> from covariant.calibration.tuning._torque_noise import TorqueNoise
        >>> mass = models.Lagrangian(lambda q: 2.0 * jnp.eye(1), coordinates=("x",), units=("m",))  # 2 kg
        >>> TorqueNoise(mass.space, jnp.zeros((1, 1)), jnp.array([6.0]))(jnp.zeros(1)).tolist()
        [[9.0]]
    """

    space: AbstractSpace
    acceleration: Matrix
    torque: Vector

    def __call__(self, q: Array) -> Float[Array, "n n"]:
        columns = jnp.diag(self.torque).astype(self.acceleration.dtype)
        root = jax.vmap(lambda covector: self.space.raise_(q, covector), in_axes=1, out_axes=1)(columns)
        return self.acceleration + root @ root.T
