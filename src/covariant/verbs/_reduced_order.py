"""`design_reduced_order`: an observer of the states that are not measured, proved to converge from any distance."""

from dataclasses import dataclass
from typing import Any

from covariant import models
from covariant.certificates import ReducedOrderDesign, reduced_order
from covariant.models import Overrides
from covariant.verbs.base.arguments import Region, bounds
from covariant.verbs.base.coordinates import box_of, system_in_coordinates
from covariant.verbs.base.inputs import numbered
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult


def design_reduced_order(
    model: Any,
    *,
    rate: float,
    region: Region | None = None,
    inputs: Region | None = None,
    full: bool = False,
    overrides: Overrides = (),
    progress: Progress = notebook_line,
) -> "ReducedOrderResult":
    """Design an observer of the states that are not measured, and prove that it converges from any distance.

    Use it where some states are measured with little noise and the others should converge from anywhere. The noise of a
    measurement goes straight into the estimate, so choose `StateEKF` for noisy outputs. It solves linear matrix
    inequalities, and proves them on the region of the states: take that large enough for the motion.

    Args:
        model: A model file (.toml), `module:attribute`, the name of a system, a `ModelFile`, or a system, with
            coordinates, whose outputs are some of its states. A mechanical model becomes the system of its positions
            and velocities.
        rate: Rate [1/s] at which squared distances decrease, positive.
        region: Ends of the states by name; those not named are the model's own.
        inputs: Ends of the inputs by name, u1, u2, …; zero where they are not named.
        full: Find a gain of the full observer as well.
        overrides: Values that replace those of the model file.
        progress: Called with a description of the work.

    Returns:
        The design with its statements; one that fails where a state shows that there is none.

    Raises:
        ValueError: For a model that has no such observer, ends that do not fit it, or where neither a design nor a
            reason against it was found.
        ImportError: Without the solver, `pip install 'covariant[lmi]'`.

    Example:
        >>> from covariant import verbs
        >>> result = verbs.design_reduced_order("lorenz", rate=1.0)
        >>> result.design.statement.short, list(result.summary)[:3]
        ('holds (proved)', ['model', 'rate', 'measured'])
    """
    progress("reading the model")
    name = models.spec_name(model)
    system = system_in_coordinates(name, models.load(model, overrides))
    ends = box_of(name, system, region)
    named = bounds("inputs", inputs or {}, numbered("u", system.inputs), "input", equal=True)
    progress("proving")
    box = [ends[each] for each in system.coordinates]
    ranges = [named.get(each, (0.0, 0.0)) for each in numbered("u", system.inputs)]
    design = reduced_order(system, rate, box=box, inputs=ranges, full=full)
    return ReducedOrderResult(name, float(rate), design)


@dataclass(frozen=True, repr=False)
class ReducedOrderResult(AbstractResult):
    """An observer of the states that are not measured, and what is known of its convergence.

    Attributes:
        model_name: The model, by its path or name.
        rate: Rate [1/s] of squared distances that was asked for.
        design: L and P, the gain of the full observer, and the statements.

    Example:
        >>> from covariant import verbs
        >>> box = {"x1": (0.0, 1.0), "x2": (1.0, 1.5), "x3": (0.5, 1.5)}
        >>> result = verbs.design_reduced_order("unknown_frequency", rate=0.1, region=box)
        >>> print(result.headline)
        unknown_frequency: fails, from any distance
    """

    model_name: str
    rate: float
    design: ReducedOrderDesign

    @property
    def headline(self) -> str:
        return f"{self.model_name}: {self.design.statement.short}, from any distance"

    @property
    def summary(self) -> dict[str, Any]:
        design = self.design
        names = design.model.coordinates
        return {
            "model": self.model_name,
            "rate": self.rate,
            "measured": [names[i] for i in design.measured],
            "unmeasured": [names[i] for i in design.unmeasured],
            "injection": None if design.injection is None else design.injection.tolist(),
            "metric": None if design.metric is None else design.metric.tolist(),
            "everywhere": design.everywhere,
            "gain": design.gain,
            "statement": design.statement.document(),
            "full": None if design.full is None else design.full.document(),
        }

    def __str__(self) -> str:
        return "\n".join(str(each) for each in (self.design.statement, self.design.full) if each is not None)
