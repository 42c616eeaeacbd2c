"""Verifies properties of a model on which a proof relies, from the graphs of its functions and not from its class.

No graph of a single function shows that the retraction, the logarithm and the frame of a manifold are consistent. The
tests of this library verify this for its own manifolds; other manifolds are refused. Spaces, forces and frictions may
be of any class, since their graphs show their dependences.
"""

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.certificates.base._error_system import inputs_of
from covariant.geometry import AbstractManifold, AbstractSpace, Coordinates, Leaf, ProductManifold
from covariant.geometry.lie import SE2, SE3, SO2, SO3, SU, MatrixGroup, Product
from covariant.models import GroupSystem, Lagrangian, MechanicalSystem, applied_force, input_count, resistance
from scalargraph import Graph, Lowered, expand, lower, numbers
from scalargraph.errors import InputError

EVERYWHERE = "nothing depends on {}, so that the statement is the same at all of their values"
PERIODIC = "the model is the same after a turn of each coordinate that it calls a circle"
SYMMETRIC = "metric, connection, curvature and friction are the same at every configuration of the group"
MODELS = MechanicalSystem, Lagrangian, GroupSystem
MANIFOLDS = Coordinates, ProductManifold, Product, MatrixGroup, SU, *map(type, (SO2, SO3, SE2, SE3))
OF_SPACES = {
    **{"lower": 1, "raise_": 1, "inner": 2, "norm": 1, "kinetic_force": 1},
    **{"connection_force": 2, "connection": 2, "acceleration": 2, "curvature": 3, "projected": 1},
}
"""Operations of a space that observers and proofs use, with the number of vectors that each takes."""
IDENTITIES = "restored", "restored_momentum", "between"
"""Operations that change nothing in systems without loops; the flow of a proof omits them."""


def need_no_loops(what: str, space: AbstractSpace) -> None:
    """Refuse the leaf of a machine with closed loops, since nearly all points in a box of coordinates open loops."""
    parts = jax.tree.leaves(space, is_leaf=lambda part: isinstance(part, Leaf))
    if any(isinstance(part, Leaf) for part in parts):
        raise InputError(
            f"{what} does not cover closed loops: their coordinates depend on each other, and a statement on a box of "
            "them would be about configurations in which the loops are open; nothing is decided about this machine"
        )


def need_known(model: MechanicalSystem) -> None:
    """Refuse systems and manifolds of foreign classes, and circles that are not periodic."""
    if type(model) not in MODELS:
        raise InputError(
            "certificates are about a MechanicalSystem, a Lagrangian or a GroupSystem itself; got "
            f"{type(model).__name__}, which may replace what these derive: build one of them from its functions"
        )
    need_no_loops("a certificate", model.space)
    changed = [name for name in IDENTITIES if getattr(type(model.space), name) is not getattr(AbstractSpace, name)]
    if changed:
        raise InputError(
            f"the space of this model changes estimates after a step by `{changed[0]}`, which no certificate covers"
        )
    unknown = next((each for each in _all_factors(model.manifold) if type(each) not in MANIFOLDS), None)
    if unknown is not None:
        raise InputError(
            "certificates are about the manifolds of this library; that retraction, logarithm and frame of "
            f"{type(unknown).__name__} belong together is not proved"
        )
    if model.manifold.commuting and model.circles:
        _need_periodic(model)


def _all_factors(manifold: AbstractManifold) -> Iterator[AbstractManifold]:
    yield manifold
    for factor in manifold.factors:
        yield from _all_factors(factor)


def lower_model(model: MechanicalSystem, n: int) -> Iterator[tuple[str, Lowered]]:
    """Yield the name and graph of each function of a model, in time, configuration, velocity, input and vectors."""
    q = jnp.zeros(n) if model.manifold.commuting else model.manifold.origin()
    space, v = model.space, model.manifold.zero(q)
    example = jnp.zeros(()), q, v, jnp.zeros(input_count(model, v.size)), v, v, v

    def of_the_space(operation, count, t, q, v, u, *vectors):
        return operation(q, *vectors[:count])

    functions = {
        "metric": lambda t, q, v, u, *_: space(q),
        "force": lambda t, q, v, u, *_: applied_force(model, t, q, u),
        "friction": lambda t, q, v, u, *_: resistance(model, t, q, v, u),
    }
    functions |= {
        f"{name} of the space": functools.partial(of_the_space, getattr(space, name), count)
        for name, count in OF_SPACES.items()
    }
    for name, function in functions.items():
        yield name, lower(function, *example, real=True)


def configuration_names(model: MechanicalSystem) -> tuple[str, ...]:
    """Return the names of the entries of a configuration: of its coordinates, or g11, g12, … of its matrix."""
    if model.manifold.commuting:
        return model.coordinates
    rows, columns = model.manifold.origin().shape
    return tuple(f"g{i + 1}{j + 1}" for i in range(rows) for j in range(columns))


def free_entries(model: MechanicalSystem) -> np.ndarray:
    """Return which entries of the configuration no function of a model reads, so that no statement depends on them."""
    q = jnp.zeros(len(model.coordinates)) if model.manifold.commuting else model.manifold.origin()
    read: set[int] = set().union(*(inputs_of(each) for _, each in lower_model(model, len(model.coordinates))))
    return np.array([1 + k not in read for k in range(q.size)])


def true_region(model: MechanicalSystem, positions: Float[np.ndarray, "2 p"]) -> Float[np.ndarray, "2 p"]:
    """Return bounds of true positions, infinite for entries that are stated as one value, if they are `free_entries`.

    The proofs at that value hold at all others: by symmetry on a group, and in coordinates since shifting estimate and
    measurement by the same amount changes neither their error nor, if no function reads the coordinate, anything else.
    """
    single = positions[0] == positions[1]
    free = single & free_entries(model) if single.any() else single
    return np.where(free, [[-np.inf], [np.inf]], positions)


def _need_periodic(model: MechanicalSystem) -> None:
    """Check that a model is periodic in each coordinate that it calls a circle."""
    for name, lowered in lower_model(model, len(model.coordinates)):
        assert lowered.conditions is not None
        graph, conditions, _ = lowered.conditions
        # Conditions of kind "finite" concern numbers that constant folding dropped; a turn does not change them.
        defined = [condition.node for condition in conditions if condition.kind != "finite"]
        for circle in model.circles:
            # The inputs of the graphs are time and then the coordinates.
            turns, turns_of_conditions = _count_turns(lowered.graph, 1 + circle), _count_turns(graph, 1 + circle)
            if any(turns[i] != 0 for i in lowered.outputs) or any(turns_of_conditions[i] != 0 for i in defined):
                raise InputError(
                    f"{model.coordinates[circle]} is called a circle, but the {name} of this model is not shown to be "
                    "the same after a turn: on a circle it may read sines and cosines of whole multiples alone; leave "
                    "a length, or an angle with a spring or a stop, out of the circles"
                )


def _count_turns(graph: Graph, place: int) -> list[float]:
    """Count exactly by how many turns each node grows if an input grows by one turn; NaN for nodes where unknown."""
    turns: list[float] = []
    for node in graph.nodes:
        read = [turns[i] for i in node.arguments]
        factors = [graph.nodes[i].value if graph.nodes[i].op == "constant" else np.nan for i in node.arguments]
        if node.op == "input":
            turns.append(float(node.value == place))
        elif not any(read):  # NaN counts as true
            turns.append(0.0)
        elif node.op == "add":
            turns.append(read[0] + read[1])
        elif node.op == "sub":
            turns.append(read[0] - read[1])
        elif node.op == "neg":
            turns.append(-read[0])
        elif node.op == "mul":
            turns.append(read[1] * factors[0] if read[0] == 0 else read[0] * factors[1])
        elif node.op in ("sin", "cos") and read[0].is_integer():
            turns.append(0.0)
        else:
            turns.append(np.nan)
    return turns


def need_symmetry(model: MechanicalSystem) -> None:
    """Check that space and friction on a group do not depend on the configuration, and that the inertia is linear."""
    origin = model.manifold.origin()
    rest = model.manifold.zero(origin)
    for name, lowered in lower_model(model, rest.size):
        if name == "force":  # the force is a variable of the box
            continue
        read = inputs_of(lowered)
        labels = [label for k, label in enumerate(configuration_names(model), start=1) if k in read]
        if labels:
            raise InputError(
                f"the {name} of this model depends on where the body is, on {', '.join(labels)} of its matrix; on a "
                "group that is not covered: write the system as a Lagrangian in coordinates"
            )
    momentum = lower(lambda a: model.space.lower(origin, a), rest)
    expansion = expand(momentum, range(rest.size), 2)
    second = np.ravel(expansion.nodes()[2]).tolist()
    if numbers(momentum, np.zeros(rest.size)).any() or not all(expansion.graph.is_zero(node) for node in second):
        raise InputError("the inertia of this model is not a linear map; on a group that is not covered")
