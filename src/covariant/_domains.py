"""Numbers with a domain: an argument that is annotated with one is checked wherever its function is called.

The domain is a part of the type: `alpha: Annotated[Number, POSITIVE]`, or for a plain number `alpha: Positive`. A
function with the decorator `check_numbers` compares its arguments with the domains of their types, those in the fields
of a NamedTuple too, and then its result. What is traced by JAX has no value yet, and is not compared.
"""

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from types import UnionType
from typing import Annotated, Any, NamedTuple, TypeVar, Union, cast, get_args, get_origin

import jax
import numpy as np
from jax.core import Tracer

from scalargraph.errors import InputError

Function = TypeVar("Function", bound=Callable[..., Any])


class Domain(NamedTuple):
    """The numbers that make sense for an argument.

    Attributes:
        words: What the argument must be, after "must".
        contains: Whether an array of doubles is of the domain, for each of its entries or as a whole.
        whole: Whether only integers are numbers here.
        why: A sentence that is added to a refusal.

    Example:
        >>> from covariant._domains import POSITIVE
        >>> POSITIVE.has(2.0), POSITIVE.has([1.0, float("inf")]), POSITIVE.has("2")
        (True, False, False)
    """

    words: str
    contains: Callable[[np.ndarray], Any]
    whole: bool = False
    why: str = ""

    def has(self, value: object) -> bool:
        """Whether a value is numbers of this domain; a traced one counts as such."""
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value)):
            return True
        try:
            array = np.asarray(value)
            if array.dtype.kind not in "iu" and (self.whole or array.dtype.kind in "USc"):
                return False
            return bool(np.all(self.contains(array.astype(float))))
        except (TypeError, ValueError):  # not numbers, or lists of different lengths
            return False

    def check(self, whose: str, name: str, value: object) -> None:
        """Raise `InputError` in the name of a function where an argument is not of this domain."""
        if not self.has(value):
            why = self.why and f". {self.why}"
            raise InputError(f"{whose}: {name} must {self.words}; got {_on_one_line(value)}{why}")


FINITE = Domain("be a finite number", np.isfinite)
FINITE_ENTRIES = FINITE._replace(words="have finite entries")
POSITIVE = Domain("be a positive, finite number", lambda a: np.isfinite(a) & (a > 0))
NOT_NEGATIVE = Domain("be a finite number, 0 or more", lambda a: np.isfinite(a) & (a >= 0))
ABOVE_ZERO = Domain("be a positive number, which may be infinite", lambda a: a > 0)
KNOWN = Domain("be a number", lambda a: ~np.isnan(a))
COUNT = Domain("be a whole number, 1 or more", lambda a: a >= 1, whole=True)
WHOLE = Domain("be a whole number, 0 or more", lambda a: a >= 0, whole=True)
INTERVAL = Domain(
    "be two finite numbers, the lower one first", lambda a: a.shape == (2,) and np.isfinite(a).all() and a[0] <= a[1]
)
SPAN = INTERVAL._replace(
    words="be two positive, finite numbers, the lower one first", contains=lambda a: INTERVAL.contains(a) and a[0] > 0
)
"""The lower and upper end of an interval of positive numbers, such as times between samples."""

Finite = Annotated[float, FINITE]
Positive = Annotated[float, POSITIVE]
NotNegative = Annotated[float, NOT_NEGATIVE]
Count = Annotated[int, COUNT]
Whole = Annotated[int, WHOLE]
Interval = Annotated[tuple[float, float], INTERVAL]


def domain_of(annotation: object) -> Domain | None:
    """The domain in a type, also in one that allows None."""
    kinds = (annotation, *(get_args(annotation) if get_origin(annotation) in (Union, UnionType) else ()))
    parts = (part for kind in kinds for part in getattr(kind, "__metadata__", ()))
    return next((part for part in parts if isinstance(part, Domain)), None)


def numbers_of(annotations: Mapping[str, Any], values: Mapping[str, Any]) -> Iterator[tuple[str, Domain, Any]]:
    """The values whose types have a domain, with their names; of a NamedTuple and a tuple those in it."""
    for name, value in values.items():
        annotation = annotations.get(name)
        domain = domain_of(annotation)
        if domain is not None and value is not None:
            yield name, domain, value
        elif isinstance(value, tuple):
            fields = getattr(value, "_fields", ())
            inside = inspect.get_annotations(type(value)) if fields else dict(enumerate(get_args(annotation)))
            within = {f"{name}.{key}": part for key, part in zip(fields or inside, value, strict=False)}
            yield from numbers_of({f"{name}.{key}": part for key, part in inside.items()}, within)


def check_numbers(function: Function) -> Function:
    """Compare the arguments of a function, and its result, with the domains of their types at each call.

    Raises:
        InputError: An argument is outside of its domain; or the result is, for arguments that do not belong together.

    Example:
        >>> from covariant._domains import Positive, check_numbers
        >>> @check_numbers
        ... def half(width: Positive) -> float:
        ...     return width / 2
        >>> half(3.0)
        1.5
        >>> half(-3.0)
        Traceback (most recent call last):
            ...
        scalargraph.errors.InputError: half: width must be a positive, finite number; got -3.0
    """
    signature, annotations = inspect.signature(function), inspect.get_annotations(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        for name, domain, value in numbers_of(annotations, signature.bind(*arguments, **named).arguments):
            domain.check(function.__name__, name, value)
        result = function(*arguments, **named)
        for name, domain, value in numbers_of(annotations, {"return": result}):
            if not domain.has(value):
                what = name.removeprefix("return.").replace("return", "the result")
                raise InputError(
                    f"{function.__name__}: {what} must {domain.words}, and is {_on_one_line(value)}; give "
                    "arguments that belong together, as the documentation states"
                )
        return result

    return cast(Function, call)


def _on_one_line(value: Any) -> str:
    try:
        text = str(np.asarray(value)) if np.ndim(value) else f"{value}"
    except ValueError:  # lists of different lengths
        text = repr(value)
    return " ".join(text.split())
