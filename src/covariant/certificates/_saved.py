"""Conversion of an observer to plain numbers and names for a certificate, and back."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant import models
from covariant.certificates._document import OBSERVERS, Document
from covariant.certificates._error_system import ErrorSystem, corrections, values
from covariant.certificates._intrinsic import Intrinsics, error_system
from covariant.certificates._sampled_step import sampled_system
from covariant.certificates._sampling import Sampling
from covariant.lowering import lower
from covariant.models import MechanicalSystem
from covariant.observers import Geodesic, Intrinsic
from covariant.proofs import graph_rows

KINDS = {"intrinsic": Intrinsic, "geodesic": Geodesic}


def observer_document(observer: Intrinsics) -> dict[str, Any]:
    """Convert an observer without its model to data.

    Args:
        observer: the observer.

    Returns:
        Its kind, frame, gains and options.

    Raises:
        ValueError: a field cannot be saved, such as a budget that is not the default.
    """
    kind = next(name for name, cls in KINDS.items() if type(observer) is cls)
    frame = frame_of(observer.model)
    content: dict[str, Any] = {
        "kind": kind,
        "frame": frame,
        "alpha": float(observer.alpha),
        "beta": float(observer.beta),
    }
    for field in dataclasses.fields(observer):
        value = getattr(observer, field.name)
        if field.name in OBSERVERS[kind]:
            content[field.name] = value
        elif field.name not in ("model", "alpha", "beta", "substeps") and value != field.default:
            raise ValueError(f"an observer with {field.name} = {value!r} cannot be written into a certificate")
    return content


def observer_from(document: Document, model: Any = None) -> tuple[Intrinsics, Float[np.ndarray, "2 2"]]:
    """Build the observer of a certificate.

    Args:
        document: the parsed file.
        model: used in place of the recipe, as for `models.from_recipe`.

    Returns:
        The observer, and the matrix Q (2, 2) of its metric.

    Raises:
        ValueError: naming what fails.
    """
    try:
        system = models.from_recipe(document.recipe, model)
    except ValueError as error:
        raise ValueError(f"recipe: {error}") from error
    fields = dict(document.observer)
    kind, frame = fields.pop("kind"), fields.pop("frame")
    # A file may name any model, so its kind has to be checked here.
    actual = frame_of(system) if isinstance(system, MechanicalSystem) else ""
    if actual != frame:
        described = f"a model in {actual}" if actual else f"a {type(system).__name__}"
        raise ValueError(f"observer.frame {frame!r} needs a mechanical system in it; the recipe makes {described}")
    if document.sampling is not None:
        fields["substeps"] = document.sampling.substeps
    return KINDS[kind](system, **fields), document.q


def system_of(
    observer: Intrinsics, q: Float[np.ndarray, "2 2"], sampling: Sampling | None, joint_friction: bool = False
) -> ErrorSystem:
    """Describe an observer and its metric as functions of a box, in continuous time or with samples.

    Args:
        observer: the observer.
        q: the matrix Q (2, 2) of the metric.
        sampling: when measurements come; None for continuous time.
        joint_friction: whether friction and its slopes are variables in continuous time.

    Raises:
        TypeError: another kind of observer.
        ValueError: a space, a force or a friction that is not covered.
    """
    if sampling is None:
        return error_system(observer, q, joint_friction)
    if not isinstance(observer, Intrinsic):
        raise TypeError(f"sampling is covered for Intrinsic alone; got {type(observer).__name__}")
    return sampled_system(observer, q, sampling)


def frame_of(model: MechanicalSystem) -> str:
    """Return the frame of the vectors of a model, as named in a certificate: "coordinates" or "body".

    Args:
        model: the mechanical system.
    """
    return "coordinates" if model.manifold.commuting else "body"


def value_graph(about: ErrorSystem) -> dict[str, list]:
    """Convert the functions that the claims depend on to a graph of scalars, for readers without JAX.

    Args:
        about: observer and metric as functions of a box.

    Returns:
        The graph. Its inputs are time, state and the variables of the box; its outputs are the entries of `values`,
        and of `corrections` where measurements are sampled.
    """
    d = len(about.names)
    states = jax.eval_shape(lambda z: about.at(z).x, jnp.zeros(d)).shape[0]
    sampled = about.has_samples

    def everything(t, x, z):
        return (*values(about)(t, x, z), *(corrections(about)(t, x, z) if sampled else ()))

    lowered = lower(everything, jnp.zeros(()), jnp.zeros(states), jnp.zeros(d), real=True)
    return graph_rows(lowered)
