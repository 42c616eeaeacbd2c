"""Numbers that no system can have: every one of a statement has a domain by its type, and is refused outside of it."""

import ast
import inspect
import math
import typing
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import certificates
from covariant._domains import (
    ABOVE_ZERO,
    COUNT,
    FINITE,
    INTERVAL,
    KNOWN,
    NOT_NEGATIVE,
    POSITIVE,
    SPAN,
    WHOLE,
    check_numbers,
    domain_of,
)
from covariant.certificates import base
from covariant.certificates.base import in_coordinates
from covariant.certificates.theory import bending, detectability_rate, lower_distance, upper_distance
from covariant.models import StateSpace
from scalargraph.errors import InputError

NAN, INF = math.nan, math.inf
NUMBERS = (NAN, INF, -INF, -1.0, 0.0, 0.5, 1, 1.5, "1", (2.0, 1.0), (1.0, 2.0), (-2.0, -1.0), (1.0, NAN), 1j)
OF_A_DOMAIN = {
    FINITE: (-1.0, 0.0, 0.5, 1, 1.5, (2.0, 1.0), (1.0, 2.0), (-2.0, -1.0)),
    POSITIVE: (0.5, 1, 1.5, (2.0, 1.0), (1.0, 2.0)),
    NOT_NEGATIVE: (0.0, 0.5, 1, 1.5, (2.0, 1.0), (1.0, 2.0)),
    ABOVE_ZERO: (INF, 0.5, 1, 1.5, (2.0, 1.0), (1.0, 2.0)),
    KNOWN: (INF, -INF, -1.0, 0.0, 0.5, 1, 1.5, (2.0, 1.0), (1.0, 2.0), (-2.0, -1.0)),
    COUNT: (1,),
    WHOLE: (1,),
    INTERVAL: ((1.0, 2.0), (-2.0, -1.0)),
    SPAN: ((1.0, 2.0),),
}


@pytest.mark.parametrize("domain", OF_A_DOMAIN, ids=lambda domain: domain.words)
def test_a_domain_has_its_numbers_and_no_others(domain):
    assert [value for value in NUMBERS if domain.has(value)] == list(OF_A_DOMAIN[domain])
    assert (domain.has(0), domain.has(True)) == (domain.contains(np.zeros(())), domain.has(1) and not domain.whole)


STUB = ast.parse(Path(str(certificates.__file__)).with_suffix(".pyi").read_text(encoding="utf-8"))
NAMES = [alias.asname for node in STUB.body if isinstance(node, ast.ImportFrom) for alias in node.names]
INSIDE = (
    *(base.conditioning, base.contraction_matrix, base.correction, base.error_matrix, base.force_bounds),
    *(base.generalised_jacobian, in_coordinates, base.rate_of, base.steady_distance),
    *(bending, detectability_rate, lower_distance, upper_distance),
)
"""Functions of statements that only the room itself uses."""
FUNCTIONS = {name: f for name in NAMES if inspect.isfunction(f := getattr(certificates, str(name)))}
FUNCTIONS |= {f.__name__: f for f in INSIDE}
CHECKED_BY_THEIR_SHAPE = {"position", "input", "q", "metric", "inputs", "times", "t", "x", "noise", "squares"}
"""Arguments that belong to a model, or are functions or matrices: what takes them compares them with it."""
SIGNS = {
    (0.0, -1.0): {"h", "sigma", "velocity", "interval", "weight", "count", "boxes", "runs"},
    (-1.0,): {"noise", "disturbance", "slope", "effort", "seed", "starts", "lost", "error", "least"},
}
"""Arguments whose name says which numbers they never are, wherever they are arguments."""


def of_parameters(function: Any) -> dict[str, Any]:
    return {name: kind for name, kind in inspect.get_annotations(function).items() if name != "return"}


def is_number(kind: Any) -> bool:
    return kind in (float, int) or any(word in str(kind) for word in ("Float[", "float", "'int'"))


def test_every_number_of_a_statement_has_a_domain():
    assert len(FUNCTIONS) > 40
    for name, function in FUNCTIONS.items():
        for parameter, kind in of_parameters(function).items():
            if domain_of(kind) is not None:
                assert hasattr(function, "__wrapped__"), f"{name} must be decorated with check_numbers"
            elif is_number(kind) and "Callable" not in str(kind):
                assert parameter in CHECKED_BY_THEIR_SHAPE or name == "check_interval", f"{name}: {parameter}: {kind}"
            for impossible, parameters in SIGNS.items():
                domain = domain_of(kind)
                assert domain is None or parameter not in parameters or not any(map(domain.has, impossible)), parameter


def evidence_in(kind: Any) -> Any:
    """The NamedTuple that is a type or a part of it; None in another type."""
    parts = (kind, *typing.get_args(kind))
    return next((one for one in parts if isinstance(one, type) and hasattr(one, "_fields")), None)


def fields_of(kind: Any) -> dict[str, Any]:
    return {} if (evidence := evidence_in(kind)) is None else inspect.get_annotations(evidence)


def sample(kind: Any) -> Any:
    """A value of a type: a number of its domain, or evidence with such numbers; else nothing that a function knows."""
    if (domain := domain_of(kind)) is not None:
        return next(value for value in (1.0, 2.0, 1, (1.0, 2.0), (-2.0, -1.0)) if domain.has(value))
    fields = fields_of(kind).values()
    return evidence_in(kind)(*map(sample, fields)) if any(map(domain_of, fields)) else object()


PLACES = {
    f"{name}: {parameter}{field and f'.{field}'}": (name, parameter, field)
    for name, function in FUNCTIONS.items()
    for parameter, kind in of_parameters(function).items()
    for field, each in {"": kind, **fields_of(kind)}.items()
    if domain_of(each)
}
"""Each parameter of a function, or field of evidence that it takes, that has a domain."""


@pytest.mark.parametrize("place", PLACES)
def test_a_number_outside_of_its_domain_is_refused_by_its_name(place):
    """Before anything is looked at: the other arguments are nothing that the function could work with."""
    name, parameter, field = PLACES[place]
    kinds = of_parameters(FUNCTIONS[name])
    kind = kinds[parameter]
    domain = domain_of(fields_of(kind)[field] if field else kind)
    assert domain is not None
    wrong = [value for value in NUMBERS if not domain.has(value)]
    assert wrong[0] is NAN
    for value in wrong:
        changed = sample(kind)._replace(**{field: value}) if field else value
        given = {each: sample(other) for each, other in kinds.items()} | {parameter: changed}
        with pytest.raises(InputError, match=f"^{place} must "):
            FUNCTIONS[name](**given)


@pytest.mark.parametrize("diagonal", [(-1.0, -1.0), (1.0, -1.0), (0.0, 0.0)])
def test_what_is_no_metric_measures_nothing(diagonal):
    at, matrix = (jnp.zeros(()), jnp.zeros(2)), jnp.diag(jnp.array(diagonal))
    measured = in_coordinates(lambda t, x: matrix)
    model = StateSpace(lambda t, x, u: -x, lambda t, x, u: x[:1], coordinates=("a", "b"))
    for measure in (
        lambda: certificates.contraction_rate(lambda t, x: -x, measured, *at),
        lambda: detectability_rate(model, lambda x: matrix, at[1]),
        lambda: bending(model, lambda x: matrix, at[1]),
        lambda: upper_distance(measured, *at, jnp.ones(2)),
        lambda: lower_distance(measured, *at, jnp.ones(2)),
    ):
        with pytest.raises(InputError, match="must be a number, and is "):
            measure()


def test_a_result_is_refused_where_the_arguments_do_not_belong_together():
    class Pair(typing.NamedTuple):
        first: typing.Annotated[float, POSITIVE]
        second: float

    @check_numbers
    def difference(a: float, b: float) -> Pair:
        return Pair(a - b, b)

    assert difference(3.0, 1.0) == (2.0, 1.0)
    with pytest.raises(InputError, match=r"^difference: first must be a positive, finite number, and is -2.0; "):
        difference(1.0, 3.0)
