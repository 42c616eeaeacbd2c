"""Rebuilds the observer of a saved certificate, and its error system."""

import numpy as np
from jaxtyping import Float

from covariant import models
from covariant.certificates.base import (
    OBSERVER_KINDS,
    Document,
    ErrorSystem,
    Intrinsics,
    Sampling,
    check_replacement,
    error_system,
    first_order,
    frame_of,
)
from covariant.certificates.sampled import sampled_system
from covariant.models import MechanicalSystem
from covariant.observers import Intrinsic
from scalargraph.errors import InputError


def observer_from(document: Document, model: object = None) -> tuple[Intrinsics, Float[np.ndarray, "2 2"]]:
    """Build the observer of a certificate."""
    try:
        system = models.from_recipe(document.recipe or {}, model)
    except InputError as error:
        raise InputError(f"recipe: {error}") from error
    fields = dict(document.observer)
    kind, frame = fields.pop("kind"), fields.pop("frame")
    # A file may name any model, so its kind has to be checked here.
    actual = frame_of(system) if isinstance(system, MechanicalSystem) else ""
    if actual != frame:
        described = f"a model in {actual}" if actual else f"a {type(system).__name__}"
        raise InputError(f"observer.frame {frame!r} needs a mechanical system in it; the recipe makes {described}")
    if model is not None and document.recipe is not None:
        # The statement prints the numbers of the recipe, but a model given as an object was not built from them.
        finished = models.from_recipe(document.recipe, model) is system
        check_replacement(system, document.recipe, finished)
    if document.sampling is not None:
        fields["substeps"] = document.sampling.substeps
    return OBSERVER_KINDS[kind](system, **fields), document.q


def system_of(
    observer: Intrinsics, q: Float[np.ndarray, "2 2"], sampling: Sampling | None, joint_friction: bool = False
) -> ErrorSystem:
    """Return the error system of an observer and its metric, in continuous time or with samples."""
    if sampling is None:
        return error_system(first_order(observer), q, joint_friction)
    if not isinstance(observer, Intrinsic):
        raise TypeError(f"sampling is covered for Intrinsic alone; got {type(observer).__name__}")
    return sampled_system(observer, q, sampling)
