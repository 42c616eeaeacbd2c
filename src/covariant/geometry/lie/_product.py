"""Products of groups: their matrices form diagonal blocks, and their vectors are concatenated."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant._typing import Element, Flag, Vector
from covariant.geometry._manifold import split
from covariant.geometry.lie._group import AbstractGroup
from scalargraph.errors import InputError


class Product(AbstractGroup):
    """Several groups as one, such as the attitude of a satellite and the angles of its wheels.

    Elements are block-diagonal matrices, one block for each factor; vectors of the algebra are concatenated. Points are
    not defined: `act` raises `NotImplementedError`.

    Attributes:
        groups: the factors, at least one.

    Raises:
        ValueError: `groups` is empty.

    Example:
        >>> from covariant.geometry.lie import SO2, SO3, Product
        >>> group = Product((SO3, SO2))
        >>> group.dimension, group.order, group.rotations
        (4, 5, ((0, 1, 2), (3,)))
    """

    groups: tuple[AbstractGroup, ...]

    def __check_init__(self):
        if not self.groups:
            raise InputError("Product: give at least one group")

    @property
    def factors(self) -> tuple[AbstractGroup, ...]:
        return self.groups

    @property
    def dimension(self) -> int:
        return sum(group.dimension for group in self.groups)

    @property
    def order(self) -> int:
        return sum(group.order for group in self.groups)

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...] | None:
        indices, start = [], 0
        for group in self.groups:
            if group.rotations is None:
                return None
            indices += [tuple(start + i for i in rotation) for rotation in group.rotations]
            start += group.dimension
        return tuple(indices)

    def parts(self, x: Vector) -> list[Float[Array, "_"]]:
        """Vectors of the factors, from a vector x (n,) of the product."""
        return split(x, [group.dimension for group in self.groups])

    def blocks(self, g: Element) -> list[Inexact[Array, "_ _"]]:
        """Elements of the factors, from an element g (N, N) of the product."""
        sizes = [group.order for group in self.groups]
        rows = split(g, sizes)
        return [split(row, sizes, axis=1)[i] for i, row in enumerate(rows)]

    def join(self, blocks: list[Inexact[Array, "_ _"]]) -> Element:
        """Element (N, N) of the product, from the elements of its factors: the inverse of `blocks`."""
        return jax.scipy.linalg.block_diag(*blocks)

    def hat(self, x: Vector) -> Element:
        return self.join([group.hat(part) for group, part in zip(self.groups, self.parts(x), strict=True)])

    def vee(self, matrix: Element) -> Vector:
        return self._concatenate("vee", self.blocks(matrix))

    def lie_bracket(self, x: Vector, y: Vector) -> Vector:
        return self._concatenate("lie_bracket", self.parts(x), self.parts(y))

    def exp(self, x: Vector) -> Element:
        return self.join([group.exp(part) for group, part in zip(self.groups, self.parts(x), strict=True)])

    def log(self, g: Element) -> Vector:
        return self._concatenate("log", self.blocks(g))

    def inverse(self, g: Element) -> Element:
        return self.join([group.inverse(block) for group, block in zip(self.groups, self.blocks(g), strict=True)])

    def right_jacobian(self, x: Vector, y: Vector) -> Vector:
        return self._concatenate("right_jacobian", self.parts(x), self.parts(y))

    def right_jacobian_inverse(self, x: Vector, y: Vector) -> Vector:
        return self._concatenate("right_jacobian_inverse", self.parts(x), self.parts(y))

    def act(self, g: Element, point: Inexact[Array, "d"]) -> Inexact[Array, "d"]:
        raise NotImplementedError("Product: let each group act on its own points, with `blocks`")

    def defect(self, g: Element) -> Array:
        blocks = self.blocks(g)
        each = [group.defect(block) for group, block in zip(self.groups, blocks, strict=True)]
        # The last value is the largest entry outside the diagonal blocks, where all must be zero.
        return jnp.max(jnp.stack([*each, jnp.max(jnp.abs(g - self.join(blocks)))]))

    def unique_log(self, g: Element) -> Flag:
        each = zip(self.groups, self.blocks(g), strict=True)
        return jnp.all(jnp.stack([group.unique_log(block) for group, block in each]))

    def _concatenate(self, operation: str, *arguments: list[Array]) -> Vector:
        each = zip(self.groups, *arguments, strict=True)
        return jnp.concatenate([getattr(group, operation)(*parts) for group, *parts in each])
