"""A model as a state-space model in named coordinates, and bounds of its states, for metrics and reduced observers."""

from covariant import models
from covariant.models import ModelFile, StateSpace
from covariant.verbs.base.arguments import Region, bounds
from scalargraph.errors import InputError


def system_in_coordinates(name: str, file: ModelFile) -> StateSpace:
    """The model as a state-space model with names of its states."""
    if not file.model.manifold.commuting:
        raise InputError(
            f"{name} is on a group, and metrics are designed in coordinates; give a StateSpace or a Lagrangian, or use "
            "the observers on groups by `covariant estimate`"
        )
    model = models.state_space(file.model)
    if not model.coordinates:
        raise InputError(f"{name}: the model names no coordinates; give it some: they are the axes of the grid")
    return model


def box_of(name: str, model: StateSpace, region: Region | None) -> dict[str, tuple[float, float]]:
    """Bounds of every state by name: from `region` if it has them, else from the model's own box."""
    # The box is empty where the model has none, so its length is not checked.
    ends = {name: (float(low), float(high)) for name, (low, high) in zip(model.coordinates, model.box, strict=False)}
    ends |= bounds("region", region or {}, model.coordinates)
    missing = [each for each in model.coordinates if each not in ends]
    if missing:
        example = ",".join(f"{each}=LOW:HIGH" for each in model.coordinates)
        raise InputError(
            f"region lacks {', '.join(missing)}, and {name} has no box of its own; give the ends of all: {example}"
        )
    return ends
