"""Reads the equations of jaxprs in one form for every supported release of JAX, whose raw parameters differ.

JAX renames primitives and their parameters from one release to the next. In 0.9 a `scan` counts its constants and what
it carries (`num_consts`, `num_carry`), from 0.11 on it has trees of them (`ft_in`, `ft_out`); a closed jaxpr is a class
in 0.9 and any jaxpr from 0.11 on; stacking arrays is a concatenation in 0.9 and a primitive from 0.11 on.
`equations` returns what a reader needs in one form: a `Call`, a `Scan`, a `While`, a `Branch`, or a primitive by
itself. Newer primitives are replaced by older ones (`REPLACED`), with the same rounding as in JAX. Other primitives
without a rule are expanded by JAX if it can do so (`expanded`); otherwise they are refused by name.

Tested with JAX 0.7.2, 0.9.2, 0.11.1, 0.11.2, 0.12.0 and 0.12.0.1.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from scalargraph.graph._lowered import LoweringError


class ClosedJaxpr(NamedTuple):
    """A jaxpr and the values of its constants, which JAX stores in one object since 0.11.

    Attributes:
        jaxpr: The jaxpr, with `invars`, `constvars`, `outvars` and `eqns`.
        consts: Values of its constants, one for each of `constvars`.

    Example:
        >>> import jax
        >>> from scalargraph.graph import ClosedJaxpr, equations
        >>> body = ClosedJaxpr.of(jax.make_jaxpr(lambda x: 2.0 * x)(1.0))
        >>> [equation.name for equation in equations(body.jaxpr)]
        ['mul']
    """

    jaxpr: Any
    consts: Sequence[Any]

    @classmethod
    def of(cls, inner: Any) -> "ClosedJaxpr":
        """Convert the value of a parameter, in any release of JAX.

        Args:
            inner: A closed jaxpr, or a jaxpr without constants.
        """
        return cls(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()))

    @property
    def results(self) -> list[Any]:
        """Shapes and types of the results."""
        return [atom.aval for atom in self.jaxpr.outvars]


class Call(NamedTuple):
    """A call of another function.

    Attributes:
        body: The function.
        replaces: Whether the function implements a primitive, rather than being a function of the user.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from scalargraph.graph import Call, equations
        >>> traced = jax.make_jaxpr(jax.jit(lambda x: jnp.sin(x)))(1.0)
        >>> (equation,) = equations(traced.jaxpr)
        >>> isinstance(equation.form, Call), equation.form.replaces
        (True, False)
    """

    body: ClosedJaxpr
    replaces: bool = False


class Scan(NamedTuple):
    """A loop of known length over rows.

    Attributes:
        body: A turn, `(*fixed, *carried, *row) -> (*carried, *results of a row)`.
        fixed: How many of the arguments are the same in every turn.
        carried: How many of the arguments after these are carried from turn to turn; the others are arrays of rows.
        length: Number of turns.
        reverse: Whether the last row comes first.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from scalargraph.graph import equations
        >>> traced = jax.make_jaxpr(lambda x: jax.lax.scan(lambda s, row: (s + row, s), 0.0, x))(jnp.ones(5))
        >>> scan = next(equation.form for equation in equations(traced.jaxpr) if equation.name == "scan")
        >>> scan.fixed, scan.carried, scan.length, scan.reverse
        (0, 1, 5, False)
    """

    body: ClosedJaxpr
    fixed: int
    carried: int
    length: int
    reverse: bool


class While(NamedTuple):
    """A loop that runs as long as a condition holds.

    Attributes:
        condition: `(*its constants, *carried) -> [going]`.
        body: A turn, `(*its constants, *carried) -> carried`.
        of_condition: How many of the arguments are constants of the condition; they come first.
        of_body: How many of the arguments after these are constants of the body; the others are carried.

    Example:
        >>> import jax
        >>> from scalargraph.graph import While, equations
        >>> traced = jax.make_jaxpr(lambda x: jax.lax.while_loop(lambda z: z < 1.0, lambda z: 2.0 * z, x))(0.1)
        >>> (equation,) = equations(traced.jaxpr)
        >>> isinstance(equation.form, While), equation.form.of_condition, equation.form.of_body
        (True, 0, 0)
    """

    condition: ClosedJaxpr
    body: ClosedJaxpr
    of_condition: int
    of_body: int


class Branch(NamedTuple):
    """A choice of one of several functions by the first argument.

    Attributes:
        bodies: The functions of the other arguments, by the value 0, 1, … of the first one, which is clipped.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from scalargraph.graph import equations
        >>> traced = jax.make_jaxpr(lambda p, x: jax.lax.cond(p, jnp.sin, jnp.cos, x))(True, 1.0)
        >>> branch = next(e.form for e in equations(traced.jaxpr) if e.name == "cond")
        >>> len(branch.bodies)
        2
    """

    bodies: tuple[ClosedJaxpr, ...]


Form = Call | Scan | While | Branch


class Parameters(dict):
    """The parameters of a primitive by name; looking up a missing one raises `LoweringError`.

    Args:
        primitive: Name of the primitive, for the message.
        parameters: Its parameters.
    """

    def __init__(self, primitive: str, parameters: dict):
        super().__init__(parameters)
        self.primitive = primitive

    def __missing__(self, key: str) -> Any:
        raise LoweringError(
            f"the primitive '{self.primitive}' of JAX {jax.__version__} has no parameter '{key}'; "
            "this release of JAX is not known"
        )


class JaxprEquation(NamedTuple):
    """An equation of a jaxpr.

    Attributes:
        primitive: The primitive of JAX.
        params: Its parameters.
        invars: Inputs, variables or literals, with their shapes and types as `aval`.
        outvars: Variables of the outputs.
        source_info: The line of the user's code, as JAX records it.
        form: Functions that it holds, as a `Call`, `Scan`, `While` or `Branch`; None for a plain primitive.

    Example:
        >>> import jax
        >>> from scalargraph.graph import equations
        >>> (equation,) = equations(jax.make_jaxpr(lambda x: x + 1.0)(0.0).jaxpr)
        >>> equation.name, equation.form is None, len(equation.invars)
        ('add', True, 2)
    """

    primitive: Any
    params: Parameters
    invars: Sequence[Any]
    outvars: Sequence[Any]
    source_info: Any
    form: Form | None

    @property
    def name(self) -> str:
        """The name of the primitive."""
        return self.primitive.name

    @property
    def unknown(self) -> str | None:
        """Name of a parameter that is set, may change the values, and is not read by the rule of this primitive.

        None if there is no such parameter.
        """
        known = READ.get(self.name, NONE)
        return next((k for k, v in self.params.items() if v is not None and k not in known and k not in WITHOUT), None)


def equations(jaxpr: Any) -> Iterator[JaxprEquation]:
    """Iterate over the equations of a jaxpr in order, in one form for all releases of JAX.

    Args:
        jaxpr: The jaxpr, without its constants.

    Raises:
        LoweringError: A loop, a call or a branch has an unknown form; the message names primitive and parameter.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from scalargraph.graph import equations
        >>> traced = jax.make_jaxpr(lambda x: jnp.sin(x) * x)(1.0)
        >>> [equation.name for equation in equations(traced.jaxpr)]
        ['sin', 'mul']
    """
    for eqn in jaxpr.eqns:
        name, params = eqn.primitive.name, Parameters(eqn.primitive.name, eqn.params)
        equation = JaxprEquation(eqn.primitive, params, eqn.invars, eqn.outvars, eqn.source_info, None)
        if name in CALLS:
            yield equation._replace(form=_fits(equation, Call(ClosedJaxpr.of(params[CALLS[name]]))))
        elif name in FORMS:
            yield equation._replace(form=FORMS[name](equation))
        elif name in REPLACED:
            yield equation._replace(form=_replacement(equation))
        else:
            yield equation


def need_pure(equation: JaxprEquation) -> None:
    """Refuse a call of Python, which may return another value every time, even for known arguments."""
    if equation.name in CALLBACKS:
        raise LoweringError(f"the primitive '{equation.name}' has no graph of scalars; write the function without it")


def needed(closed: Any) -> ClosedJaxpr:
    """Return a closed jaxpr without the equations that its results do not need.

    Args:
        closed: The closed jaxpr.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from scalargraph.graph import equations, needed
        >>> traced = jax.make_jaxpr(lambda x: [jnp.sin(x), jnp.cos(x)][1])(1.0)
        >>> [equation.name for equation in equations(needed(traced).jaxpr)]
        ['cos']
    """
    used = [True] * len(closed.jaxpr.outvars)
    return ClosedJaxpr(partial_eval.dce_jaxpr(closed.jaxpr, used, instantiate=True)[0], closed.consts)


def expanded(equation: JaxprEquation) -> Call:
    """Replace a primitive that has no rule by the primitives with which JAX implements it."""
    name, primitive = equation.name, equation.primitive
    by_jax = primitive.to_lojax if name == "call_hi_primitive" else primitive.impl
    refusal = LoweringError(f"the primitive '{name}' has no graph of scalars; write the function without it")
    try:
        call = _trace_replacement(equation, lambda *x: by_jax(*x, **equation.params))
    except Exception as error:  # JAX does not document which error an expansion that fails raises
        raise refusal from error
    # A primitive that expands into itself would be expanded without end.
    if name in set(_names(call.body.jaxpr)):
        raise refusal
    return call


# Parts that are the same in every release.

CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "eval_jaxpr": "call_jaxpr",  # from 0.11.2 on
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_lin": "call_jaxpr",
    "remat2": "jaxpr",
    "checkpoint": "jaxpr",
}
"""Primitives that call a function, and the parameter that holds it."""
CALLBACKS = {"pure_callback", "io_callback", "debug_callback", "debug_print"}
"""Primitives that call Python."""
NONE: frozenset[str] = frozenset()
WITHOUT = frozenset(
    {
        *("sharding", "out_sharding", "accuracy", "weak_type", "precision", "preferred_element_type"),
        *("indices_are_sorted", "unique_indices", "update_jaxpr", "update_consts", "index_dtype", "dtype"),
    }
)
"""Parameters that do not change values: the device of an array, the precision of a product, or the type of the
result, which the equation itself contains."""
READ: dict[str, frozenset[str]] = {
    name: frozenset(parameters.split())
    for name, parameters in {
        "argmax": "axes",
        "argmin": "axes",
        "broadcast_in_dim": "shape broadcast_dimensions",
        "concatenate": "dimension",
        "convert_element_type": "new_dtype",
        "copy_p": "",
        **dict.fromkeys(("cumsum", "cumprod", "cummax", "cummin"), "axis reverse"),
        "dot_general": "dimension_numbers",
        "dynamic_slice": "slice_sizes",
        "expand_dims": "dimensions",
        "gather": "dimension_numbers slice_sizes mode fill_value",
        "integer_pow": "y",
        "iota": "shape dimension",
        "pad": "padding_config",
        **dict.fromkeys(("reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or"), "axes"),
        "reduce_precision": "exponent_bits mantissa_bits",
        "reshape": "new_sizes",
        "rev": "dimensions",
        "round": "rounding_method",
        **dict.fromkeys(("scatter", "scatter-add"), "dimension_numbers mode"),
        "slice": "start_indices limit_indices strides",
        "split": "sizes axis",
        "squeeze": "dimensions",
        "stumpff": "k",
        "transpose": "permutation",
    }.items()
}
"""The parameters that the rules of a primitive read. Any other parameter is refused, as it might change values."""


# Loops and branches.


def _scan(equation: JaxprEquation) -> Scan:
    p = equation.params
    if "ft_in" in p:  # from 0.11 on
        fixed, carried, rows = _sizes(equation, "ft_in", 3)
        known = {"ft_in", "ft_out"}
        if _sizes(equation, "ft_out", 2)[0] != carried:
            raise _odd(equation, "ft_out")
    else:
        fixed, carried = p["num_consts"], p["num_carry"]
        rows = len(equation.invars) - fixed - carried
        known = {"num_consts", "num_carry", "linear", "_split_transpose"}
    _refuse_unknown_parameters(equation, {"jaxpr", "length", "reverse", "unroll", *known})
    scan = Scan(ClosedJaxpr.of(p["jaxpr"]), fixed, carried, p["length"], p["reverse"])
    count, results = fixed + carried + rows, len(scan.body.results)
    if min(rows, results - carried) < 0 or {len(equation.invars), len(scan.body.jaxpr.invars)} != {count}:
        raise _odd(equation, "jaxpr")
    if results != len(equation.outvars):
        raise _odd(equation, "jaxpr")
    return scan


def _sizes(equation: JaxprEquation, parameter: str, count: int) -> list[int]:
    """Numbers of leaves of the parts of a tree that is a parameter of a scan."""
    try:
        sizes = [len(list(part)) for part in equation.params[parameter].unpack()]
    except (AttributeError, TypeError) as error:
        raise _odd(equation, parameter) from error
    if len(sizes) != count:
        raise _odd(equation, parameter)
    return sizes


def _while(equation: JaxprEquation) -> While:
    p = equation.params
    _refuse_unknown_parameters(equation, {"cond_nconsts", "cond_jaxpr", "body_nconsts", "body_jaxpr"})
    return While(ClosedJaxpr.of(p["cond_jaxpr"]), ClosedJaxpr.of(p["body_jaxpr"]), p["cond_nconsts"], p["body_nconsts"])


def _branch(equation: JaxprEquation) -> Branch:
    _refuse_unknown_parameters(equation, {"branches", "linear", "branches_platforms"})
    return Branch(tuple(ClosedJaxpr.of(branch) for branch in equation.params["branches"]))


FORMS: dict[str, Callable[[JaxprEquation], Form]] = {"scan": _scan, "while": _while, "cond": _branch}
"""Primitives that hold functions and do not just call one."""


def _refuse_unknown_parameters(equation: JaxprEquation, known: set[str]) -> None:
    for parameter, value in equation.params.items():
        if parameter not in known and value is not None:
            raise _odd(equation, parameter)


def _fits(equation: JaxprEquation, call: Call) -> Call:
    if len(call.body.jaxpr.invars) != len(equation.invars) or len(call.body.results) != len(equation.outvars):
        raise _odd(equation, CALLS[equation.name])
    return call


def _odd(equation: JaxprEquation, parameter: str) -> LoweringError:
    return LoweringError(
        f"the primitive '{equation.name}' of JAX {jax.__version__} has the parameter '{parameter}' "
        "in a form that is not known"
    )


# Newer primitives, written with older ones.


def _stack(*x: jax.Array, axis: int) -> jax.Array:
    return jax.lax.concatenate([jax.lax.expand_dims(a, (axis,)) for a in x], axis)


def _unstack(x: jax.Array, *, axis: int) -> list[jax.Array]:
    return [jax.lax.index_in_dim(x, k, axis, keepdims=False) for k in range(x.shape[axis])]


def _one_minus_square(x: jax.Array) -> jax.Array:
    one = jnp.ones((), x.dtype)
    # Written as 1 − x² it would cancel near |x| = 1; both factors here have small relative errors.
    return (one + x) * (one - x)


def _polynomial(x: jax.Array, *coefficients: jax.Array, unroll: int | None = None) -> jax.Array:
    """Evaluate a polynomial by Horner's rule from the highest power on, as JAX does."""
    total = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def _log2(x: jax.Array, *, accuracy: object = None) -> jax.Array:
    return jax.lax.log(x) * jnp.asarray(1.4426950408889634, x.dtype)


def _identity(*x: jax.Array, **_: object) -> list[jax.Array]:
    return list(x)


def _empty(*, shape: Sequence[int] = (), dtype: np.dtype, **_: object) -> jax.Array:
    """Zeros for an array whose entries are written before they are read; JAX does the same on a CPU."""
    return jnp.zeros(shape, dtype)


REPLACED: dict[str, Callable[..., Any]] = {
    # The device on which an array is stored does not change its entries.
    **dict.fromkeys(("device_put", "sharding_constraint", "layout_constraint", "reshard", "pvary", "name"), _identity),
    "stack": _stack,  # from 0.11 on
    "unstack": _unstack,
    "empty": _empty,
    "empty2": _empty,
    "one_minus_square": _one_minus_square,  # from 0.11.2 on
    "log2": _log2,
    "polynomial": _polynomial,  # from 0.12 on
}
"""Primitives that only some releases have, as functions of primitives that all releases have."""


def _replacement(equation: JaxprEquation) -> Call:
    # Parameters are lists in JAX 0.6, but the key of the cache has to be hashable.
    key = tuple((name, tuple(v) if isinstance(v, list) else v) for name, v in sorted(equation.params.items()))
    avals = tuple((atom.aval.shape, atom.aval.dtype) for atom in equation.invars)
    try:
        return _make_replacement(equation.name, key, avals)
    except TypeError as error:  # the replacement does not have this argument
        raise LoweringError(
            f"the primitive '{equation.name}' of JAX {jax.__version__} has parameters that are not known: "
            f"{', '.join(equation.params)}"
        ) from error


@functools.lru_cache(maxsize=4096)
def _make_replacement(name: str, parameters: tuple, avals: tuple) -> Call:
    shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in avals]
    return Call(
        ClosedJaxpr.of(jax.make_jaxpr(functools.partial(REPLACED[name], **dict(parameters)))(*shapes)), replaces=True
    )


def _trace_replacement(equation: JaxprEquation, function: Callable[..., Any]) -> Call:
    shapes = [jax.ShapeDtypeStruct(atom.aval.shape, atom.aval.dtype) for atom in equation.invars]
    return _fits_replacement(equation, Call(ClosedJaxpr.of(jax.make_jaxpr(function)(*shapes)), replaces=True))


def _fits_replacement(equation: JaxprEquation, call: Call) -> Call:
    results = [(aval.shape, np.dtype(aval.dtype)) for aval in call.body.results]
    if results != [(atom.aval.shape, np.dtype(atom.aval.dtype)) for atom in equation.outvars]:
        raise LoweringError(f"the expansion of the primitive '{equation.name}' has other results than it")
    return call


def _names(jaxpr: Any) -> Iterator[str]:
    """Names of all primitives of a jaxpr, and of the jaxprs in it."""
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name
        for value in eqn.params.values():
            for inner in value if isinstance(value, list | tuple) else (value,):
                if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                    yield from _names(cast(Any, getattr(inner, "jaxpr", inner)))
