"""Represents a model as a function of its open parameters, for fits to logs."""

import copy
import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from covariant._names import refuse_unknown
from covariant.models._mechanical import input_count, resistance
from covariant.models.files import _source
from covariant.models.files._file import document, finish, made
from covariant.models.files._model_file import ModelFile, named
from covariant.models.files._toml import Overrides
from scalargraph.errors import InputError

POINTS, ROUNDING = 4, 1e-9
"""Number of configurations at which energies are compared, and relative differences that count as rounding."""
LAG = ("inputs", "lag")
"""The only number outside [parameters] that may be open."""

Place = tuple[str | int, ...]
"""Location of a number in a document: table, key, and the index in each list."""


class Family(NamedTuple):
    """The models that a model file describes if some of its numbers are open.

    Attributes:
        file: The model file with the first values of these numbers.
        names: The p open numbers, such as `mass[0]` of [parameters], or `inputs.lag`.
        first: Their values (p,) in the file.
        positive: Which of the p numbers must stay positive: those whose negative values the model refuses, and those
            that start positive and whose negative values would make inertias negative or let friction drive the motion.
        make: `values (k,) -> (model, lag [s])`; JAX can trace, differentiate and batch it.
        document: The content of the file, with the first values, as nested dictionaries and lists.
        places: Table, key and list indices in the document of each of the k numbers of one machine.
        parts: Indices (M, k) in `names` of the k numbers of each of M machines; for a single machine these are all p.
    Example:
        >>> from covariant import models
        >>> family = models.family("oscillator", ["stiffness"], {"parameters.stiffness": 2.0})
        >>> family.names, family.first.tolist()
        (('stiffness',), [2.0])
        >>> family.with_values([3.0])["parameters"]
        {'stiffness': 3.0}
    """

    file: ModelFile
    names: tuple[str, ...]
    first: Float[np.ndarray, "p"]
    positive: tuple[bool, ...]
    make: Callable[[Any], tuple[Any, Any]]
    document: dict[str, Any]
    places: tuple[Place, ...]
    parts: Int[np.ndarray, "M k"]

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names (k,) of the open numbers of one machine, as in the model file."""
        return tuple(map(_name, self.places))

    def with_values(self, values: Float[np.ndarray, "k"]) -> dict[str, Any]:
        """Copy the document with other values of the open numbers.

        Args:
            values: Values (k,) in the order of `places`.

        Returns:
            Tables and keys of a model file.
        """
        return _with(self.document, self.places, np.asarray(values).tolist())

    def of_machines(self, machines: Sequence[str], each: Sequence[str]) -> "Family":
        """Family of several machines that share their numbers, except some that differ between machines.

        Args:
            machines: Names of the M machines.
            each: Numbers, as for `family`, that differ between machines; `viscous@arm1` is the one of `arm1`.

        Returns:
            The family with the p numbers of all machines.

        Raises:
            ValueError: A name in `each` is not an open number.

        Example:
            >>> from covariant import models
            >>> guess = {"parameters.mass": 0.5, "parameters.inertia": 0.2}
            >>> family = models.family("ball_and_beam", ["mass", "inertia"], guess)
            >>> both = family.of_machines(["arm1", "arm2"], ["inertia"])
            >>> both.names, both.parts.tolist()
            (('mass', 'inertia@arm1', 'inertia@arm2'), [[0, 1], [0, 2]])
        """
        numbers = dict(zip(self.numbers, self.places, strict=True))
        own = {name for pattern in each for name in _match_names(pattern, numbers)}
        names, source = [], []
        parts = np.zeros((len(machines), len(numbers)), int)
        for k, name in enumerate(self.numbers):
            parts[:, k] = len(names) + np.arange(len(machines)) * (name in own)
            new = [f"{name}@{machine}" for machine in machines] if name in own else [name]
            names, source = names + new, source + [k] * len(new)
        positive = tuple(self.positive[k] for k in source)
        return self._replace(names=tuple(names), first=self.first[source], positive=positive, parts=parts)


def family(spec: str, names: Sequence[str], overrides: Overrides = ()) -> Family:
    """Family of a mechanical model with the named numbers open.

    Use it for `calibration.fit`, which searches the open numbers. A number must be in [parameters] of the model file,
    or be `inputs.lag`. For masses, inertias and friction of a robot use `robot_family`. The verb `covariant.fit` builds
    either of them itself.

    Args:
        spec: As for `load`, except an object.
        names: `mass` for all entries of a list in [parameters], `mass[0]` for the first one; `inputs.lag` for the lag
            of the inputs.
        overrides: As for `load`; they may set first values.

    Returns:
        The family.

    Raises:
        ModelError: One line with the spec and the first fault: a name that does not exist, a value that is not a
            number, a first value of zero if negative values are refused, or a function that JAX cannot trace.

    Example:
        >>> from covariant import models
        >>> family = models.family("ball_and_beam", ["mass"], {"parameters.mass": 0.5})
        >>> family.names, family.first.tolist()
        (('mass',), [0.5])
    """
    with named(spec):
        return _family(spec, names, document(spec, overrides))


def _family(spec: str, names: Sequence[str], content: dict[str, Any]) -> Family:
    file = finish(spec, content)
    numbers = {_name(place): place for place in _numbers(content)}
    chosen = [name for pattern in names for name in _match_names(pattern, numbers)]
    twice = next((name for name in chosen if chosen.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{twice} is named twice; name it once")
    if not chosen:
        raise InputError(f"no number is named; there are: {', '.join(numbers) or 'none'}")
    places = tuple(numbers[name] for name in chosen)
    first = np.array([float(_value_at(content, place)) for place in places])

    def make(values):
        filled = _with(content, places, list(values))
        return made(spec, filled).model, filled.get(LAG[0], {}).get(LAG[1], file.input_lag)

    positive = tuple(
        # A number is positive if the model refuses −value: this needs no list of names that could become outdated.
        _refuses(spec, _with(content, (place,), [-abs(value) or -1.0]))  # −0.0 is no negative number: −1 in its place
        for place, value in zip(places, first, strict=True)
    )
    for name, value, refused in zip(chosen, first, positive, strict=True):
        if refused and not 0 < value < math.inf:
            remedy = f"parameters.{name.partition('[')[0]}=NUMBER" if name != ".".join(LAG) else f"{name}=0.01"
            raise InputError(
                f"{name} must be positive and starts from {value:g}; give it a first value by `overrides={[remedy]}`"
            )
    try:
        # Tracing here shows early that a function uses NumPy or branches on a number, instead of during a fit.
        eqx.filter_eval_shape(make, first)
    except (TypeError, ValueError) as error:  # building it from plain numbers succeeded above
        raise InputError(
            f"the function that makes the model cannot be traced by JAX ({_source.first_line(error)[:80]}); compute "
            f"with jax.numpy in it, or leave {', '.join(names)} as they are"
        ) from error
    known = all(positive) or not file.mechanical
    bounded = np.zeros(len(first), bool) if known else _bounded(make, first)
    positive = tuple(bool(refused or bound) for refused, bound in zip(positive, bounded, strict=True))
    return Family(file, tuple(chosen), first, positive, make, content, places, np.arange(len(first))[None])


def _numbers(content: dict[str, Any]) -> Iterator[Place]:
    """The locations of all numbers that may be open."""
    if _is_number(content.get(LAG[0], {}).get(LAG[1])):
        yield LAG
    yield from _places(("parameters",), content.get("parameters", {}))


def _places(here: Place, value: object) -> Iterator[Place]:
    if _is_number(value):
        yield here
    elif isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _places((*here, key), inner)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _name(place: Place) -> str:
    table, key, *indices = place
    return ("" if table == "parameters" else f"{table}.") + str(key) + "".join(f"[{i}]" for i in indices)


def _match_names(pattern: str, numbers: dict[str, Place]) -> list[str]:
    """The numbers that a name denotes: the number of this name, or all entries of the list."""
    plain = pattern.strip().removeprefix("parameters.")
    matches = [name for name in numbers if name == plain or re.fullmatch(re.escape(plain) + r"(\[\w+\])+", name)]
    if not matches:
        refuse_unknown("number", plain, tuple(numbers))
    return matches


def _value_at(content: Any, place: Place) -> Any:
    for key in place:
        content = content[key]
    return content


def _with(content: dict[str, Any], places: Sequence[Place], values: Sequence[Any]) -> dict[str, Any]:
    """A copy of the document with other numbers at these locations."""
    filled = copy.deepcopy(content)
    for place, value in zip(places, values, strict=True):
        _value_at(filled, place[:-1])[place[-1]] = value
    return filled


def _refuses(spec: str, content: dict[str, Any]) -> bool:
    """Whether the model refuses these numbers."""
    try:
        finish(spec, content)
    except Exception:  # whatever the user's function raises, as by an assertion
        return True
    return False


def _bounded(make: Callable[[Any], tuple[Any, Any]], first: Float[np.ndarray, "p"]) -> Bool[np.ndarray, "p"]:
    """Which positive numbers (p,) are inertias or friction and so stay positive, for a model that refuses nothing.

    A negated inertia lowers the kinetic energy of each motion, and negated friction adds power. Energies and powers are
    compared at a few configurations and velocities.
    """

    def energies(values):
        model = make(values)[0]
        start = model.manifold.origin()
        zero = model.manifold.zero(start)
        n = zero.shape[0]
        t, u = jnp.zeros(()), jnp.zeros(input_count(model, n))
        random = np.random.default_rng(0)
        steps, velocities = random.normal(0, 0.5, (POINTS, n)), random.normal(0, 1, (POINTS * (1 + n), n))

        def at(step, v):
            q = model.manifold.retract(start, step)
            return v @ model.space.lower(q, v) / 2, v @ resistance(model, t, q, v, u)

        return jax.vmap(at)(jnp.asarray(np.repeat(steps, 1 + n, axis=0)), jnp.asarray(velocities))

    compiled = eqx.filter_jit(energies)
    kinetic, power = map(np.asarray, compiled(jnp.asarray(first)))
    bounded = np.zeros(len(first), bool)
    for i in np.flatnonzero(first > 0):
        other = compiled(jnp.asarray(np.where(np.arange(len(first)) == i, -first, first)))
        adds, takes = kinetic - np.asarray(other[0]), np.asarray(other[1]) - power
        # Differences within rounding, from sums that cancel, do not count.
        inertia = (adds > -ROUNDING * np.abs(kinetic)).all() and (adds > ROUNDING * np.abs(kinetic)).any()
        dissipates = (takes > -ROUNDING * np.abs(power)).all() and (takes > ROUNDING * np.abs(power)).any()
        bounded[i] = inertia or dissipates
    return bounded
