"""Traces an observer to graphs of scalars, with its numbers as arguments; code is written from these graphs."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from types import MappingProxyType
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant.models import Family, Motion, Parameter, input_count
from covariant.observers import AbstractObserver
from scalargraph import Lowered, TracedFunction, lower_traced, trace
from scalargraph.errors import InputError

Real = Literal["double", "float"]
Function = TypeVar("Function", Lowered, TracedFunction)
DTYPES = {"double": np.float64, "float": np.float32}

BOUND = ("position_bound", "velocity_bound", "premise")
REPORTED = ("innovation", "distance", "nis", "velocity_std", "state_std", "slow", "slow_std", *BOUND)
"""Fields of an info that the code stores, besides the result code."""
GAIN_UNITS = {"alpha": "1/s", "beta": "1/s^2", "force_rate": "1/s"}
"""Units of the gains of observers of second order."""
CONFIGURATION = "configuration"
"""Name of the first part of a measurement of a filter with sensors."""


class Recipe(NamedTuple):
    """An observer with open numbers, which become arguments of the generated code.

    Attributes:
        make: Function `numbers -> observer`, which JAX can trace.
        numbers: The open numbers by name, with their values.
        units: Units of the numbers that have one, by name.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> make = lambda numbers: observers.FilteredDerivative(numbers["bandwidth"])
        >>> recipe = codegen.Recipe(make, {"bandwidth": np.array(20.0)})
        >>> float(recipe.make({"bandwidth": 5.0}).bandwidth)
        5.0
    """

    make: Callable[[Mapping[str, Any]], AbstractObserver]
    numbers: dict[str, np.ndarray]
    units: Mapping[str, str] = MappingProxyType({})


class Member(NamedTuple):
    """An array of a structure.

    Attributes:
        name: Its name.
        shape: Its shape.
        real: Whether it contains real numbers, and not counts or truth values.

    Example:
        >>> from covariant.codegen._program import Member
        >>> Member("gain", (2, 3)).size
        6
    """

    name: str
    shape: tuple[int, ...]
    real: bool = True

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(np.prod(self.shape, dtype=int))

    @property
    def last(self) -> "Member":
        """The array of a state that stores this array of the info of the last step."""
        return self._replace(name=f"last_{self.name}")


class Signals(NamedTuple):
    """Names of the numbers that an observer takes and returns, in their order, with units, for comments and texts.

    Attributes:
        y: A name for each number of a measurement, as "q1 [rad]", or one for all; empty if they are not known.
        u: A name for each input.
        x: Names for each array of an estimate, as ("v", ("q1 [rad/s]",)).

    Example:
        >>> from covariant.codegen import Signals
        >>> Signals(("q1 [rad]",), ("tau [N m]",), (("v", ("q1 [rad/s]",)),)).lines
        ('y: q1 [rad]', 'u: tau [N m]', 'v: q1 [rad/s]')
    """

    y: tuple[str, ...] = ()
    u: tuple[str, ...] = ()
    x: tuple[tuple[str, tuple[str, ...]], ...] = ()

    @property
    def lines(self) -> tuple[str, ...]:
        """A line for each array whose names are known, for comments of C or Python."""
        named = (("y", self.y), ("u", self.u), *self.x)
        texts = (f"{array}: {', '.join(names)}" for array, names in named if names)
        return tuple(" ".join(text.replace("*/", "").replace("\\", "/").replace('"', "'").split()) for text in texts)

    def of(self, array: str) -> str:
        """The names of an array, or "" if they are not known."""
        return next((line.partition(": ")[2] for line in self.lines if line.startswith(f"{array}: ")), "")

    def units(self, array: str) -> tuple[str, ...]:
        """The unit of each number of an array, "" if it has none; empty if the names are not known."""
        names = next((names for name, names in (("y", self.y), ("u", self.u), *self.x) if name == array), ())
        return tuple(name.rpartition(" [")[2][:-1] if name.endswith("]") else "" for name in names)


class Program(NamedTuple, Generic[Function]):
    """An observer as graphs of scalars, in which counts and truth values of its state are real numbers.

    This form lies between an observer and its C, for tools that write another language. `write_source` generates C from
    it. Use `covariant.export` to get complete files with a self-test.

    Attributes:
        init: Graph of `(numbers, y, t) -> state`.
        step: Graph of `(numbers, state, u, y, dt) -> (state, info)`.
        estimate: Graph of `(numbers, state) -> x`.
        numbers: The open numbers that any of the graphs uses, with their values.
        given: All open numbers, which are the arguments of the graphs.
        values: Their values.
        state: Arrays of a state.
        info: Arrays of the diagnostics of a step.
        x: Arrays of an estimate.
        y: Shape of a measurement.
        u: Number of inputs.
        real: Type of the numbers, "double" or "float".
        told_as: The info, with its shapes and types in JAX.
        sensors: Name of each sensor besides the configuration, and its count of numbers in a measurement.
        alone: Graphs of `(numbers, state, u, part, dt) -> (state, info)` of a step in which only one part of the
            measurement was read, by the name of the part, `CONFIGURATION` or a sensor; empty if not requested.
        signals: Names and units of measurement, input and estimate, for comments.
        units: Units of the open numbers that have one, by name.
        largest: Largest magnitude of each number of a configuration from which an estimate can start.
        input_at_end: Whether the input of a step is the input at its end instead of its begin.
        estimated_as: The estimate, with its shapes and types in JAX.

    Of `trace_program` it has functions that JAX has traced in place of graphs, and all open numbers.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> program = codegen.program(recipe, np.zeros(1))
        >>> [leaf.name for leaf in program.state], program.y, program.u
        (['q', 'v', 'age'], (1,), 0)
    """

    init: Function
    step: Function
    estimate: Function
    numbers: dict[str, np.ndarray]
    given: tuple[Member, ...]
    values: tuple[np.ndarray, ...]
    state: tuple[Member, ...]
    info: tuple[Member, ...]
    x: tuple[Member, ...]
    y: tuple[int, ...]
    u: int
    real: Real
    told_as: Any
    sensors: tuple[tuple[str, int], ...] = ()
    alone: tuple[tuple[str, Function], ...] = ()
    signals: Signals = Signals()
    units: Mapping[str, str] = MappingProxyType({})
    largest: tuple[float, ...] = ()
    input_at_end: bool = False
    estimated_as: Any = None

    def lower(self, loops: bool = False) -> "Program[Lowered]":
        """Write the graphs of traced functions.

        Args:
            loops: Whether loops are allowed whose length depends on numbers; as for `program`.

        Raises:
            LoweringError: As for `program`.
        """

        def graph(function: Any) -> Lowered:
            return lower_traced(function, loops="any" if loops else "long")

        graphs = init, step, estimate = graph(self.init), graph(self.step), graph(self.estimate)
        used = _find_used_numbers(graphs, self.given)
        numbers = {name: value for name, value in self.numbers.items() if name in used}
        alone = tuple((name, graph(part)) for name, part in self.alone)
        lowered: Any = self._replace(numbers=numbers)
        return lowered._replace(init=init, step=step, estimate=estimate, alone=alone)

    @property
    def parts(self) -> tuple[tuple[str, int], ...]:
        """Parts of a measurement by name, with their counts of numbers: the configuration, and each sensor."""
        rest = self.measurements - sum(count for _, count in self.sensors)
        return ((CONFIGURATION, rest), *self.sensors)

    @property
    def parts_text(self) -> str:
        """The parts of a measurement, in order, as a text for comments."""
        return ", then ".join(f"{count} of {part_text(name)}" for name, count in self.parts)

    @property
    def measurements(self) -> int:
        """Count of numbers in a measurement."""
        return math.prod(self.y)

    @property
    def parameters(self) -> list[Member]:
        """The arrays of `numbers`."""
        return [Member(name, np.shape(value)) for name, value in self.numbers.items()]

    @property
    def reported(self) -> list[Member]:
        """The arrays of the info that are stored with a state: those in `REPORTED`."""
        return [leaf for leaf in self.info if leaf.name in REPORTED and leaf.size]

    @property
    def told(self) -> list[Member]:
        """Standard deviations, proved bounds and slow states, which accompany an estimate."""
        return [leaf for leaf in self.reported if leaf.name in ("slow", *BOUND) or leaf.name.endswith("_std")]

    @property
    def stored(self) -> list[Member]:
        """The arrays of a state as the code stores it, including those reported by the last step."""
        return [*self.state, *(leaf.last for leaf in self.reported)]

    @property
    def output(self) -> list[Member]:
        """The arrays of an estimate as the code returns it."""
        return [*self.x, *self.told]


def part_text(part: str) -> str:
    """Describe a part of a measurement for use in a sentence."""
    return "the configuration" if part == CONFIGURATION else part


def with_open_numbers(observer: AbstractObserver, fixed: Sequence[str] = ()) -> Recipe:
    """Build the recipe in which all arrays of an observer and of its model are open.

    An array has the same name as in the source. Arrays of one name and equal values, such as a mass used by both
    inertia and potential, become one number. Arrays of one name with different values get longer names, by their place.

    Args:
        observer: The observer, with the values of its numbers.
        fixed: Patterns of names, such as `rotation` or `place*`, of arrays that become constants. Zeros in constants
            cost nothing in the code.

    Example:
        >>> from covariant import codegen, observers
        >>> codegen.with_open_numbers(observers.FilteredDerivative(20.0)).numbers["bandwidth"].tolist()
        20.0
    """
    dynamic, static = eqx.partition(observer, eqx.is_inexact_array)
    paths, tree = jax.tree_util.tree_flatten_with_path(dynamic)
    arrays = [np.asarray(leaf) for _, leaf in paths]
    names = _shortest_names([_path_keys(path) for path, _ in paths], arrays)
    # A proved bound holds only for these numbers, so all of them become constants.
    patterns = ("*",) if observer.fixed_numbers else fixed
    closed = [any(fnmatchcase(name, pattern) for pattern in patterns) for name in names]
    numbers = {name: a for name, a, fix in zip(names, arrays, closed, strict=True) if a.size and not fix}

    def make(values):
        leaves = [values[n] if n in numbers else leaf for n, (_, leaf) in zip(names, paths, strict=True)]
        return eqx.combine(jax.tree.unflatten(tree, leaves), static)

    units = {name: unit for name, unit in zip(names, _units(observer, paths), strict=True) if unit}
    return Recipe(make, numbers, GAIN_UNITS | units)


def of_family(observer: AbstractObserver, family: Family) -> Recipe:
    """Build the recipe in which the open numbers of a family of models, and those of the observer itself, are open.

    Args:
        observer: An observer of `family.file.model`, which contains the arrays of that model.
        family: The models, with their open numbers.

    Returns:
        The recipe. If both have a number of the same name, that of the observer gets the prefix `observer_`.

    Raises:
        ValueError: The observer belongs to another model.

    Example:
        >>> from pathlib import Path
        >>> from covariant import codegen, models, observers
        >>> _ = Path("pendulum.toml").write_text('''system = "pendulum_chain"
        ... parameters = {mass = [1.0], length = [1.0]}''')
        >>> family = models.family("pendulum.toml", ("mass",))
        >>> observer = observers.Intrinsic(family.file.model, 10.0, 100.0, substeps=1)
        >>> sorted(codegen.of_family(observer, family).numbers)
        ['alpha', 'beta', 'mass']
    """
    model = family.file.model
    # By identity, since an observer of this model contains the same array objects.
    index_in_model = {id(leaf): k for k, leaf in enumerate(jax.tree.leaves(model))}
    dynamic, static = eqx.partition(observer, eqx.is_inexact_array)
    paths, tree = jax.tree_util.tree_flatten_with_path(dynamic)
    outside = [(path, leaf) for path, leaf in paths if id(leaf) not in index_in_model]
    if len(outside) == len(paths):
        raise InputError("of_family: the observer is not one of family.file.model; make it of that model")
    names = _shortest_names([_path_keys(path) for path, _ in outside], [np.asarray(leaf) for _, leaf in outside])
    groups: dict[str, list[int]] = {}
    for k, name in enumerate(family.names):
        groups.setdefault(name.partition("[")[0], []).append(k)
    groups = {
        _identifier(name): each
        for base, ks in groups.items()
        for name, each in ([(base, ks)] if _whole(base, ks, family) else [(family.names[k], [k]) for k in ks])
    }
    # Names of the file have priority, since its reader knows them.
    clash = sorted(set(names) & set(groups))
    renamed = {name: f"observer_{name}" for name in clash}
    names = [renamed.get(name, name) for name in names]
    first = np.asarray(family.first, float)
    numbers = {name: first[ks] if len(ks) > 1 else first[ks[0]] for name, ks in groups.items()}
    numbers |= {name: np.asarray(leaf) for name, (_, leaf) in zip(names, outside, strict=True) if np.size(leaf)}

    def make(values):
        flat = jnp.zeros(len(first))
        for name, ks in groups.items():
            # Scattered by index, since numbers of one array need not be adjacent in the family.
            flat = flat.at[jnp.array(ks)].set(jnp.atleast_1d(jnp.asarray(values[name], float)))
        leaves = jax.tree.leaves(family.make(flat)[0])
        name_of = dict(zip((id(leaf) for _, leaf in outside), names, strict=True))
        filled = [
            leaves[index_in_model[id(leaf)]] if id(leaf) in index_in_model else values.get(name_of[id(leaf)], leaf)
            for _, leaf in paths
        ]
        return eqx.combine(jax.tree.unflatten(tree, filled), static)

    known = model.parameters
    bases = {name: known.get(family.names[ks[0]].partition("[")[0]) for name, ks in groups.items()}
    units = {name: parameter.unit for name, parameter in bases.items() if isinstance(parameter, Parameter)}
    return Recipe(make, numbers, GAIN_UNITS | units)


def _units(observer: AbstractObserver, paths: Sequence[tuple[Any, Any]]) -> list[str | None]:
    """The units of arrays of an observer, as stated by the parameters of its model."""
    stated = jax.tree_util.tree_flatten_with_path(observer, is_leaf=lambda node: isinstance(node, Parameter))[0]
    units = {tuple(path): node.unit for path, node in stated if isinstance(node, Parameter)}
    return [units.get(tuple(path[:-1])) for path, _ in paths]


def _whole(base: str, ks: Sequence[int], family: Family) -> bool:
    """Whether open numbers form a complete number or list of the file, and so become one array."""
    value = family.document.get("parameters", {}).get(base)
    return not isinstance(value, list) or (np.ndim(value) == 1 and len(value) == len(ks))


def program(
    recipe: Recipe,
    y: Array | np.ndarray,
    inputs: int | None = None,
    real: Real = "double",
    loops: bool = False,
    alone: bool = False,
) -> Program[Lowered]:
    """Trace an observer to graphs of scalars, from which code is written.

    Use it for the steps before `write_source`, or to count operations. A step of the observer must have a fixed amount
    of work: set its `substeps`, and a `Budget` with a number of `newton` corrections. `real="float"` halves the memory,
    and limits the accuracy to about seven digits. `covariant.export` does all of this.

    Args:
        recipe: The observer and its open numbers.
        y: A measured configuration, of which only the shape is used.
        inputs: Number of inputs m; by default that of the observer's model, or 0 if it has none.
        real: Type in which the graphs compute, "double" or "float".
        loops: Whether the length of a step may depend on numbers, as when friction decides the number of its substeps.
        alone: For a filter with sensors, add the steps in which only one of them, or the configuration, was read.

    Raises:
        LoweringError: A step has no graph of a fixed size, for example since friction decides the number of substeps
            (`observers.with_fixed_substeps`), and `loops` are not allowed.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> codegen.program(recipe, np.zeros(2), real="float").x
        (Member(name='q', shape=(2,), real=True), Member(name='v', shape=(2,), real=True))
    """
    return trace_program(recipe, y, inputs, real, alone).lower(loops)


def trace_program(
    recipe: Recipe, y: Array | np.ndarray, inputs: int | None = None, real: Real = "double", alone: bool = False
) -> Program[TracedFunction]:
    """Trace an observer by JAX, which takes only a part of the time needed for its graphs.

    Args:
        recipe: The observer and its open numbers.
        y: A measured configuration, of which only the shape is used.
        inputs: Number of inputs m; by default that of the observer's model, or 0 if it has none.
        real: Type in which the graphs compute, "double" or "float".
        alone: For a filter with sensors, add the steps in which only one of them, or the configuration, was read.

    Returns:
        The traced functions; `lower` writes their graphs.

    Example:
        >>> import numpy as np
        >>> from covariant import codegen, observers
        >>> recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0))
        >>> codegen.trace_program(recipe, np.zeros(1)).info[0].name
        'innovation'
    """
    dtype = DTYPES[real]
    y = np.asarray(y, dtype)
    first = recipe.make(recipe.numbers)
    model: Any = getattr(first, "model", None)
    # A filter without a model uses no input.
    n = first.configuration(y).shape[0]
    u = inputs if inputs is not None else input_count(model, n) if model is not None else 0
    open_numbers = {name: jax.ShapeDtypeStruct(np.shape(value), dtype) for name, value in recipe.numbers.items()}
    scalar, measured = jax.ShapeDtypeStruct((), dtype), jax.ShapeDtypeStruct(y.shape, dtype)

    def cast_observer(numbers):
        # The cast comes after `make`, whose arithmetic may promote types: all numbers of the code have one type.
        return jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, recipe.make(numbers))

    structures: dict[str, Any] = {}  # with the shapes and types that they have in JAX, recorded by tracing

    def init(numbers, y, t):
        state = cast_observer(numbers).init(y, t)
        structures["state"] = _kinds(state)
        return _real(state, dtype)

    traced_init = trace(init, open_numbers, measured, scalar)
    kinds = structures["state"]
    state = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, dtype), kinds)

    def typed(state):  # counts and truth values, real numbers in the code, get their types back here
        return jax.tree.map(lambda a, kind: a.astype(kind.dtype), state, kinds)

    def step(numbers, state, u, y, dt):
        state, info = cast_observer(numbers).step(typed(state), u, y, dt)
        structures["info"] = _kinds(info)
        return _real((state, info), dtype)

    def estimate(numbers, state):
        observer = cast_observer(numbers)
        x: Any = observer.estimate(typed(state))
        structures["estimate"] = _kinds(x)
        # The state x of a state-space model is one array; other estimates consist of q and v. With a lag, the estimate
        # is that of the inner state.
        estimated: Any = getattr(state, "inner", state)
        estimated = getattr(estimated, "smoothed", estimated)
        if isinstance(x, tuple) or "x" in getattr(estimated, "_fields", ()):
            return x
        return Motion(*jnp.split(x, 2))

    acting = jax.ShapeDtypeStruct((u,), dtype)
    traced_step = trace(step, open_numbers, state, acting, measured, scalar)
    traced_estimate = trace(estimate, open_numbers, state)
    sensors = tuple((sensor.name, sensor.count) for sensor in first.sensors)
    alone_traced: list[tuple[str, TracedFunction]] = []
    if alone and sensors:
        at = 0
        for name, count in ((CONFIGURATION, y.size - sum(k for _, k in sensors)), *sensors):

            def step_alone(numbers, state, u, part, dt, at=at):
                # Parts that are not read are the constant NaN, so that the graph drops all that only serves them.
                return step(numbers, state, u, jnp.full(y.shape, jnp.nan, dtype).at[at : at + part.size].set(part), dt)

            part = jax.ShapeDtypeStruct((count,), dtype)
            alone_traced.append((name, trace(step_alone, open_numbers, state, acting, part, scalar)))
            at += count
    names = sorted(recipe.numbers)  # as JAX orders them
    numbers = {name: np.asarray(recipe.numbers[name], float) for name in names}
    return Program(
        traced_init,
        traced_step,
        traced_estimate,
        numbers,
        tuple(Member(name, np.shape(recipe.numbers[name])) for name in names),
        tuple(numbers.values()),
        _leaves(kinds),
        _leaves(traced_step.results[1]),
        _leaves(traced_estimate.results),
        y.shape,
        u,
        real,
        structures["info"],
        sensors,
        tuple(alone_traced),
        units=recipe.units,
        largest=tuple(first.configuration(np.asarray(first.largest(y), float)).ravel().tolist()),
        input_at_end=first.input_at_end,
        estimated_as=structures["estimate"],
    )


def _kinds(tree: Any) -> Any:
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)), tree)


def _real(tree: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda a: jnp.asarray(a).astype(dtype), tree)


def _find_used_numbers(graphs: Sequence[Lowered], leaves: Sequence[Member]) -> set[str]:
    """The open numbers that a graph uses."""
    inputs = {node.value for lowered in graphs for node in _reachable_nodes(lowered) if node.op == "input"}
    owners = [leaf.name for leaf in leaves for _ in range(leaf.size)]
    return {name for k, name in enumerate(owners) if k in inputs}


def _reachable_nodes(lowered: Lowered):
    return lowered.graph.pruned(lowered.outputs)[0].nodes


def _leaves(tree: Any) -> tuple[Member, ...]:
    """The arrays of a pytree, in order; a single array is called x."""
    leaves = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = "_".join(_path_keys(path)) or "x"
        leaves.append(Member(name, tuple(leaf.shape), bool(jnp.issubdtype(leaf.dtype, jnp.floating))))
    return tuple(leaves)


def _path_keys(path: Sequence[Any]) -> list[str]:
    """The attributes and keys that lead to a leaf, as identifiers."""
    keys = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", "")))) for key in path]
    return [_identifier(key) for key in keys if key not in ("parameters", "value")]


def _identifier(text: str) -> str:
    """Convert a name to an identifier of C."""
    # ASCII: C99 compilers need not accept other letters in names.
    plain = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_")
    return f"n{plain}" if plain[:1].isdigit() else plain or "n"


def _shortest_names(paths: Sequence[Sequence[str]], arrays: Sequence[np.ndarray]) -> list[str]:
    """The shortest names that distinguish arrays of different values."""

    def same(i: int, j: int) -> bool:
        return arrays[i].shape == arrays[j].shape and np.array_equal(arrays[i], arrays[j])

    names = ["_".join(w[-1:]) for w in paths]
    for length in range(2, max(map(len, paths), default=0) + 1):
        for i in range(len(names)):
            twins = [j for j in range(len(names)) if names[j] == names[i]]
            if any(not same(i, j) for j in twins):
                for j in twins:
                    names[j] = "_".join(paths[j][-length:])
    first: dict[str, list[int]] = {}  # of the values of a name, where even the whole path is the same
    for i, name in enumerate(names):
        values = first.setdefault(name, [])
        k = next((k for k, j in enumerate(values) if same(i, j)), len(values))
        values += [i] if k == len(values) else []
        names[i] = name if k == 0 else f"{name}_{k + 1}"
    return names
