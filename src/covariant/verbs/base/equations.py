"""Metric, connection, curvature and intrinsic observer of a mechanical system as formulas: Markdown with LaTeX.

Source: Aghannan & Rouchon 2003, equation (5).
"""

import functools
import re
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from covariant.models import MechanicalSystem, friction, source
from scalargraph.errors import InputError
from scalargraph.formulas import formulas

GREEK = "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau upsilon phi chi psi"


def write_equations(model: MechanicalSystem, name: str, inputs: Sequence[str]) -> str:
    """Write a mechanical system and its intrinsic observer (5) as Markdown with LaTeX.

    Args:
        model: The mechanical system.
        name: What the title and messages call it.
        inputs: Names of the inputs.

    Raises:
        InputError: The system is not in independent coordinates, or a formula is too large to be read.
    """
    try:
        return "\n\n".join(_sections(model, name, [_symbol(u) for u in inputs]))
    except InputError as error:
        how = "`covariant export` writes its observer as C"
        raise InputError(f"{name}: {error}, so its equations are not printed; {how}") from error


def _sections(model: MechanicalSystem, name: str, u: list[str]) -> Iterator[str]:
    space, q, n = model.space, [_symbol(name) for name in model.coordinates], len(model.coordinates)
    estimate, velocity, basis = _marked("hat", q), _of(r"\hat{v}", q), jnp.eye(n)
    rate, error = _marked("dot", estimate), [f"({hat} - {x})" for hat, x in zip(_marked("hat", q), q, strict=True)]

    if len({*(symbols := [*q, *u, r"\alpha", r"\beta", "t"])}) < len(symbols):
        raise InputError(f"two of its coordinates, inputs, gains and the time have one symbol, {', '.join(symbols)}")
    if not model.manifold.commuting or formulas(space.projected, q, _of("S", q)) != _of("S", q):
        raise InputError("it has attitudes or closed loops, and no independent coordinates")
    yield f"# Equations of {name}\n\nMetric g:"
    rows = [" & ".join(row) for row in np.reshape(formulas(space, q), (n, n))]
    yield _block("g", r"\begin{pmatrix} " + r" \\ ".join(rows) + r" \end{pmatrix}")

    yield "Christoffel symbols Γ, without those that are zero:"
    gamma = jax.vmap(jax.vmap(space.connection, (None, None, 0)), (None, 0, None))
    texts = np.reshape(formulas(lambda x: gamma(x, basis, basis), q), (n, n, n))
    for i, j, k in np.ndindex(n, n, n):
        if j <= k and texts[j, k, i] != "0":
            pairs = dict.fromkeys([(j, k), (k, j)])  # one symbol where j = k
            yield _block(*(rf"\Gamma^{{{q[i]}}}_{{{q[a]} {q[b]}}}" for a, b in pairs), str(texts[j, k, i]))

    yield "Acceleration S by potential and inputs:"
    yield from map(_block, _of("S", q), formulas(lambda t, x, u: source(model, t[0], x, u), ["t"], q, u))
    yield "Curvature term R(ξ, v)v:"
    bend = functools.partial(formulas, lambda x, v, xi: space.curvature(x, xi, v, v), q)
    yield from map(_block, _of(r"\{R(\xi, v)v\}", q), bend(_of("v", q), _of(r"\xi", q)))

    turns = ", differences of angles between −π and π" * bool(model.circles)
    yield f"Intrinsic observer (5) of Aghannan & Rouchon 2003, with gains α and β{turns}:"
    yield from (_block(x, rf"{v} - \alpha\,{e}") for x, v, e in zip(rate, velocity, error, strict=True))
    turn = functools.partial(formulas, lambda x, a, b: -space.connection(x, a, b))
    terms = (
        turn(estimate, velocity, rate),
        _of("S", q),
        turn(q, error, _of("S", q)),
        [rf"-\beta\,{e}" for e in error],
        bend(velocity, error),
        formulas(lambda t, x, v, u: friction(model, t[0], x, v, u), ["t"], estimate, velocity, u),
    )
    for v, *parts in zip(_of(r"\dot{\hat{v}}", q), *terms, strict=True):
        yield _block(v, " + ".join(part for part in parts if part != "0").replace("+ -", "- "))


def _block(*sides: str) -> str:
    return f"$$\n{' = '.join(sides)}\n$$"


def _of(letter: str, coordinates: list[str]) -> list[str]:
    return [f"{letter}_{{{x}}}" for x in coordinates]


def _symbol(name: str) -> str:
    r"""A name as LaTeX: theta1 is \theta_{1}, and names of several letters are upright."""
    head, index = re.findall(r"^(.*?)_?(\d*)$", name)[0]
    upright = r"\mathrm{" + head.replace("_", r"\_") + "}"
    letter = rf"\{head}" if head in [*GREEK.split(), "omega"] else upright if len(head) > 1 else head
    return f"{letter}_{{{index}}}" if index else letter


def _marked(mark: str, symbols: list[str]) -> list[str]:
    """Symbols with a dot or a hat over the letter, before its index."""
    return [re.sub(r"^(.*?)(_\{\d+\})?$", rf"\\{mark}{{\1}}\2", symbol) for symbol in symbols]
