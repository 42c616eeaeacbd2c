"""Computes the runs of a sweep: a machine and its observers, compiled once for all cases."""

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant import engine, models
from covariant._names import did_you_mean, unknown
from covariant.many._study import KEYS, STATES, Axis, Study, designed_with, of_run, parse_study
from covariant.metrics import Variable
from covariant.observers import with_velocity
from covariant.verbs.base.arguments import numbers
from covariant.verbs.base.design import design
from covariant.verbs.base.simulated_log import DETUNED, pushed, pushes
from scalargraph.compiler import compiler
from scalargraph.errors import InputError

SETTLED = 0.8
"""Fraction of a run after which errors count."""
TOLD = {
    "error": "root mean square of the velocity errors",
    "nees": "mean NEES of each velocity",
    "band": "part of the velocities in the 95 % band",
    "nis": "mean NIS of each position",
}
"""Quantities that a run reports for each observer."""
BAND = 1.96
"""Half width of a 95 % band, in standard deviations."""
FINE = 4
"""Integration steps of the truth per sampling interval."""


@dataclass(frozen=True)
class Runs:
    """The function that computes a case; its data is a text, so that a worker of a cluster compiles it for itself.

    Attributes:
        text: The study.
        hashes: Hashes of the files that it names, so that a changed file is read again.
    """

    text: str
    hashes: tuple[str, ...]

    def __call__(self, x: Array) -> dict[str, Any]:
        return _compiled(self).run(x)

    def variables(self) -> dict[str, Variable]:
        """The variables that a run returns for each observer."""
        made = _compiled(self)
        result = {}
        for name, family in made.families.items():
            for what in ("error", *family.tells):
                result[f"{plain(name)}_{what}"] = Variable((), "1", f"{TOLD[what]} of {name}")
        return result


def plain(name: str) -> str:
    return name.replace("-", "_")


class _Family(NamedTuple):
    """Observers of one name for all designs: a compiled step, and the numbers that differ between designs."""

    step: Callable[..., Any]
    init: Callable[..., Any]
    numbers: list[Any]
    tells: tuple[str, ...]


class _Machine(NamedTuple):
    """The truth, and observers of it, for any case.

    Attributes:
        own: Numbers of a run by key: one for each design, or the axis along which they vary.
    """

    plan: Study
    model: models.MechanicalSystem
    names: tuple[str, ...]
    inputs: Callable[[Array, Array, Array], Array]
    own: dict[str, Any]
    intervals: Array
    counts: Array
    pushes: Array
    families: dict[str, _Family]

    def run(self, x: Array) -> dict[str, Any]:
        """Errors of all observers in a case."""
        content, n, manifold = self.plan.content, len(self.names) // 2, self.model.manifold
        coordinates = dict(zip((axis.key for axis in self.plan.axes), x, strict=True))
        place = jnp.zeros((), int)
        for axis in self.plan.axes:
            if axis.designs:
                place = place * len(axis.values) + jnp.round(coordinates[axis.key]).astype(int)
        own = {k: v.at(coordinates[k]) if isinstance(v, Axis) else v[place] for k, v in self.own.items()}
        scale = next((axis.at(coordinates[axis.key]) for axis in self.plan.axes if axis.key == "error"), 1.0)

        def states(table: str) -> Any:
            return jnp.stack([jnp.asarray(own.get(f"{table}.{name}", 0.0), float) for name in self.names])

        draw = jnp.round(coordinates.get("draw", jnp.zeros(()))).astype(int)
        key = jax.random.fold_in(jax.random.key(content.get("seed", 0)), draw)
        of_noise, of_force, of_start = (jax.random.fold_in(key, k) for k in range(3))
        h, count = self.intervals[place], self.counts[place]
        late = jnp.floor(SETTLED * count.astype(float)).astype(int)
        counted = (count - late).astype(float)
        both = states("start")
        if any(name.startswith("spread.") for name in own):
            both = both + states("spread") * jax.random.normal(of_start, both.shape)
        off = scale * states("error")

        def random(name: str, key: Array, k: Array | int, shape: tuple[int, ...] = (n,)) -> Array:
            return own[name] * jax.random.normal(jax.random.fold_in(key, k), shape) if name in own else jnp.zeros(shape)

        result = {}
        for name, family in self.families.items():
            numbers = [leaf[place] for leaf in family.numbers]

            def body(k, carry, family=family, numbers=numbers):
                q, v, state, sums = carry
                t = k.astype(float) * h
                # White noise within a sample too, with the density that a filter without a correlation time assumes.
                white = FINE**0.5 * random("acceleration", of_force, k, (FINE, n))
                force = pushes(t, self.pushes[place]), white
                noise = random("noise", of_noise, k + 1)
                q, v, state, new = family.step(numbers, t, q, v, state, self.inputs(t, q, v), force, noise, h)
                return q, v, state, sums + jnp.where(k >= late, new, 0.0)

            q, v = manifold.retract(manifold.origin(), both[:n]), both[n:]
            y = manifold.ambient.retract(q, random("noise", of_noise, jnp.zeros((), int)) + off[:n])
            # With an initial error the observers know the velocity up to this error; otherwise they start at rest.
            known = any(name.startswith("error.") for name in own)
            state = family.init(numbers, y, v + off[n:] if known else None)
            *_, sums = jax.lax.fori_loop(0, count, body, (q, v, state, jnp.zeros(1 + len(family.tells))))
            means = dict(zip(("error", *family.tells), sums / counted, strict=True))
            result |= {f"{plain(name)}_{what}": jnp.sqrt(v) if what == "error" else v / n for what, v in means.items()}
        return result


@functools.lru_cache(maxsize=4)
def _compiled(runs: Runs) -> _Machine:
    """Machine and observers of a study, compiled once in each process."""
    plan = parse_study(json.loads(runs.text))
    content, designs = plan.content, plan.designs
    overrides = content.get("set", {})
    file = _load(plan.model, {}, overrides, "[set] ")
    model = file.need_mechanical(plan.model, "a sweep simulates")
    if model.feet is not None:
        raise InputError(f"{plan.model}: a sweep simulates no contacts; take a model without feet")
    n = file.dimension
    names = (*(f"q{k + 1}" for k in range(n)), *(f"v{k + 1}" for k in range(n)))
    varied = {axis.key: axis for axis in plan.axes if of_run(axis.key) and not axis.designs}
    keys = dict.fromkeys((*plan.numbers, *varied, *(k for each in designs for k in each if of_run(k))))
    for key in keys:
        if "." in key and key.partition(".")[2] not in names:
            raise InputError(f"{key}: {unknown('state', key.partition('.')[2], names)}")
    own = {
        key: varied.get(key, jnp.asarray([float({**plan.numbers, **each}.get(key, 0.0)) for each in designs]))
        for key in keys
    }
    rates = np.array([float({**content, **each}["rate"]) for each in designs])
    largest = [numbers("push", {**content, **each}.get("push", 0.0), names[n:], one=True) for each in designs]
    inputs = models.input_count(model, n)
    files = [_load(plan.model, overrides, designed_with(each), "axes.") for each in designs]
    for each in files:
        if any(np.any(late) for late in (each.delay, each.input_delay, each.input_lag, each.input_lead)):
            raise InputError(f"{plan.model}: a sweep has no delays; leave out those of [measurement] and [inputs]")
    families = {}
    for name in plan.observers:
        made = [design(each, name, rate=rate) for each, rate in zip(files, rates, strict=True)]
        if not content.get("gate", True):
            made = [each.without_gate() for each in made]
        driven = "acceleration" in keys or bool(np.any(largest))
        families[name] = _family(model, [each.observer for each in made], inputs, driven, "noise" in keys)
    return _Machine(
        plan,
        model,
        names,
        _inputs(content, model, inputs, n),
        own,
        jnp.asarray(1 / rates),
        jnp.asarray(plan.samples),
        jnp.asarray(np.stack(largest)),
        families,
    )


def _load(model: str, fixed: Mapping[str, Any], changes: Mapping[str, Any], place: str) -> models.ModelFile:
    """The model file with the keys of a study; an error names the key, and similar keys of a study."""
    try:
        return models.load(model, {**fixed, **changes})
    except InputError:
        models.load(model, fixed)  # what is wrong without the changes is not theirs
        for key, value in changes.items():
            try:
                models.load(model, {**fixed, key: value})
            except InputError as error:
                table, known = key.partition(".")[0], (*STATES, *KEYS)
                of_study = f" {table} is a key of the study, not of a model."
                hint = of_study if table in known else did_you_mean(table, known)
                raise InputError(f"{place}{key}:{hint} {error}") from error
        raise


def _inputs(
    content: Mapping[str, Any], model: models.MechanicalSystem, count: int, n: int
) -> Callable[[Array, Array, Array], Array]:
    """Inputs (m,) at a time, a configuration and a velocity: sines, or a function of a module."""
    if "feedback" in content:
        spec = content["feedback"]["function"]
        feedback = models.attribute(spec, Path(content["feedback"]["folder"]))
        if not model.manifold.commuting:
            raise InputError(f"feedback {spec}: it is for models in coordinates, and {content['model']} is on a group")
        try:
            shape = np.shape(feedback(0.0, jnp.zeros(2 * n)))
        except Exception as error:  # a function of somebody may fail in any way
            raise InputError(f"feedback {spec}: with a time and a state ({2 * n},) it raises {error!r}") from error
        if shape != (count,):
            raise InputError(f"feedback {spec}: it must return the inputs ({count},) of the model; it returned {shape}")
        return lambda t, q, v: jnp.asarray(feedback(t, jnp.concatenate([q, v])), float)
    amplitude = numbers("amplitude", content.get("amplitude", 0.0), [f"u{k + 1}" for k in range(count)], one=True)
    omega = 2 * np.pi * content.get("frequency", 0.5) * (1 + DETUNED * np.arange(count))
    return lambda t, q, v: jnp.asarray(amplitude) * jnp.sin(jnp.asarray(omega) * t)


def _family(model: Any, observers: Sequence[Any], inputs: int, driven: bool, noisy: bool) -> _Family:
    """Observers of one name.

    The machine is `driven` if something other than its inputs acts on it. A filter estimates the size of errors only
    for `noisy` readings.
    """
    leaves, trees = zip(*map(jax.tree.flatten, observers), strict=True)
    differ = [
        k
        for k, column in enumerate(zip(*leaves, strict=True))
        if not all(map(_same, column, leaves[0][k : k + 1] * len(leaves)))
    ]
    if any(tree != trees[0] for tree in trees):
        raise InputError("designs of one observer differ in more than numbers; sweep them one by one")
    numbers = [jnp.stack([jnp.asarray(each[k], float) for each in leaves]) for k in differ]

    def observer(values: Sequence[Any]) -> Any:
        changed = list(leaves[0])
        for k, value in zip(differ, values, strict=True):
            changed[k] = value
        return jax.tree.unflatten(trees[0], changed)

    origin = model.manifold.origin()
    kinds = jax.eval_shape(observers[0].init, origin)

    def as_numbers(state):
        return jax.tree.map(lambda leaf: leaf.astype(float), state)

    def init(values, y, v=None):
        state = observer(values).init(y)
        return as_numbers(state if v is None else with_velocity(state, v))

    first, zero = [leaf[0] for leaf in numbers], model.manifold.zero(origin)
    _, info = jax.eval_shape(lambda q: observers[0].step(observers[0].init(q), jnp.zeros(inputs), q, 0.01), origin)
    told = (("nees", "velocity_std"), ("band", "velocity_std"), ("nis", "nis"))
    tells = tuple(what for what, field in told if noisy and getattr(info, field, None) is not None)

    def step(values, t, q, v, state, u, force, noise, h):
        each, (push, accelerations) = observer(values), force
        if driven:

            def piece(carry, acceleration):
                t, motion = carry
                acting = pushed(model, lambda t, q: push + model.space(q) @ acceleration)
                return (t + h / FINE, models.advance(acting, t, motion, u, h / FINE, 1)), None

            (_, motion), _ = jax.lax.scan(piece, (t, models.Motion(q, v)), accelerations)
        else:
            motion = models.advance(model, t, models.Motion(q, v), u, h, FINE)
        state = jax.tree.map(lambda leaf, kind: leaf.astype(kind.dtype), state, kinds)
        state, info = each.step(state, u, model.manifold.ambient.retract(motion.q, noise), h)
        off = model.sought.of(each.estimate(state)) - motion.v
        sums = {"error": jnp.sum(off**2)}
        if "nees" in tells:
            sums["nees"] = jnp.sum((off / info.velocity_std) ** 2)
            sums["band"] = jnp.sum(jnp.where(jnp.abs(off) < BAND * info.velocity_std, 1.0, 0.0))
        if "nis" in tells:
            sums["nis"] = info.nis
        return motion.q, motion.v, as_numbers(state), jnp.stack([sums[what] for what in ("error", *tells)])

    if compiler() is None:  # XLA then does the same, slower
        return _Family(step, init, numbers, tells)
    state = jax.eval_shape(init, first, origin)
    at = jnp.zeros(())
    force = (zero, jnp.zeros((FINE, *zero.shape)))
    compiled = engine.compiled(step, first, at, origin, zero, state, jnp.zeros(inputs), force, zero, at)
    return _Family(compiled, init, numbers, tells)


def _same(leaf: object, first: object) -> bool:
    return leaf is first or bool(np.array_equal(np.asarray(leaf), np.asarray(first)))
