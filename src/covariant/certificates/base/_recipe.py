"""Compares the recipe that a statement prints with the model of the statement."""

from typing import Any

import jax
import numpy as np

from covariant.certificates.base._document import Document
from covariant.certificates.base._intrinsic import Intrinsics, observer_document
from covariant.certificates.base._properties import lower_model
from covariant.certificates.base._statement import exact
from covariant.models import MechanicalSystem, StateSpace, rebuild
from scalargraph.errors import InputError
from scalargraph.proofs import graph_rows

NAMES = "coordinates", "units", "velocities", "velocity_units", "inputs", "circles"


def check_recipe(model: MechanicalSystem | StateSpace, recipe: dict[str, Any] | None) -> None:
    """Check that a recipe builds this model: equal parameters, names and units, and equal graphs of the functions.

    A statement prints the recipe, while a proof reads the model. The name of the recipe does not matter. Code named by
    a recipe is run only if `models.recipe` has run it in this process.
    """
    if recipe is None:
        return
    rebuilt = rebuild(recipe)
    if rebuilt is None:
        if parameters := recipe.get("parameters"):
            raise InputError(
                f"recipe: whether {next(iter(parameters))} of {recipe['attribute']} is that of the observer's model is "
                "not known, since code that a recipe names is not run; give the result of `models.recipe` itself"
            )
        return
    difference = _describe_difference(model, rebuilt)
    if difference:
        raise InputError(
            f"recipe: it builds another model than that of the observer: {difference}; give the recipe of this model, "
            "or none"
        )


def check_replacement(model: MechanicalSystem | StateSpace, recipe: dict[str, Any], finished: bool) -> None:
    """Check that a model that replaces the model of a recipe has the numbers of the recipe."""
    if "system" in recipe:
        check_recipe(model, recipe)
    stated = model.parameters
    for name, value in recipe["parameters"].items() if finished and "attribute" in recipe else ():
        if name not in stated or not np.array_equal(np.asarray(stated[name].value), np.asarray(value)):
            number = f"{np.asarray(stated[name].value).tolist()} of" if name in stated else "not stated by"
            raise InputError(
                f"recipe: {name} is {value} in the recipe, and {number} the model that was given; give the function "
                "that builds it from these parameters"
            )


def check_observer(document: Document, observer: Intrinsics) -> None:
    """Check that a certificate is about a given observer.

    Use it before you publish a certificate together with an observer that was designed again, such as an exported one.
    The gains must agree to the last digit, and the recipe of the certificate must build the observer's model.

    Args:
        document: the content of the certificate, as from `parse`.
        observer: the observer, with its model and gains.

    Raises:
        ValueError: the certificate is about another observer; the message names the file and the difference.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> from covariant.certificates import Document, check_observer
        >>> entries = np.eye(2), 2.0, 0.1, np.ones(1), None, -np.ones(4), np.ones(4), (), {}
        >>> made = {"kind": "intrinsic", "frame": "coordinates", "alpha": 10.0, "beta": 50.0}
        >>> document = Document("proved.json", {"system": "oscillator"}, made, *entries)
        >>> check_observer(document, observers.Intrinsic(models.oscillator(), 11.0, 50.0))
        Traceback (most recent call last):
        ...
        scalargraph.errors.InputError: proved.json: the certificate is for alpha = 10, beta = 50; ...
    """
    made, saved = observer_document(observer), document.observer
    (alpha, beta), (its_alpha, its_beta) = ([exact(each[key]) for key in ("alpha", "beta")] for each in (saved, made))
    if (alpha, beta) != (its_alpha, its_beta):
        raise InputError(
            f"{document.file}: the certificate is for alpha = {alpha}, beta = {beta}; the observer has {its_alpha}, "
            f"{its_beta}; give these as `alpha` and `beta`"
        )
    if different := [key for key in made if made[key] != saved.get(key)]:
        key = different[0]
        raise InputError(
            f"{document.file}: the certificate is for {key} = {saved.get(key)!r}, and the observer has {made[key]!r}; "
            "certify this observer"
        )
    try:
        check_recipe(observer.model, document.recipe)
    except InputError as error:
        raise InputError(f"{document.file}: {error}") from error


def is_same_observer(observer: Intrinsics, certified: Intrinsics) -> bool:
    """Whether an observer has the same kind, gains, options, substeps and model as a certified one."""
    return observer is certified or (
        type(observer) is type(certified)
        and observer_document(observer) == observer_document(certified)
        and observer.substeps == certified.substeps
        and not _describe_difference(observer.model, certified.model)
    )


def _describe_difference(model: Any, rebuilt: Any) -> str:
    """Describe the first difference between two models; empty for equal models."""
    if type(rebuilt) is not type(model) or type(rebuilt.space) is not type(model.space):
        kinds = (f"{type(each).__name__} on {type(getattr(each, 'space', each)).__name__}" for each in (rebuilt, model))
        return "it builds a {}, and the observer has a {}".format(*kinds)
    for name in [each for each in rebuilt.parameters if each in model.parameters]:
        ours, theirs = (np.asarray(each.parameters[name].value) for each in (model, rebuilt))
        if not np.array_equal(ours, theirs):
            return f"{name} is {theirs.tolist()} in the recipe, and {ours.tolist()} in the model"
    for name in NAMES:
        ours, theirs = getattr(model, name), getattr(rebuilt, name)
        if ours != theirs:
            return f"{name} are {theirs} in the recipe, and {ours} in the model"
    if jax.tree.structure(model.manifold) != jax.tree.structure(rebuilt.manifold):
        return f"its manifold is {rebuilt.manifold}, and that of the model is {model.manifold}"
    n = len(model.coordinates or model.velocities)
    for (name, ours), (_, theirs) in zip(lower_model(model, n), lower_model(rebuilt, n), strict=True):
        if graph_rows(ours) != graph_rows(theirs):
            return f"the {name} differs, in its formula or its numbers"
    return ""
