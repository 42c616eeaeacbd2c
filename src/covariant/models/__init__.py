"""What moves: mechanical systems as JAX functions, and example systems, one a file."""

from covariant.models._ball_and_beam import ball_and_beam
from covariant.models._check import check_metric
from covariant.models._file import ModelError, ModelFile, load
from covariant.models._lagrangian import (
    Lagrangian,
    Parameter,
    acceleration,
    check_model,
    energy,
    friction,
    position_error,
    source,
    wrap,
)
from covariant.models._oscillator import oscillator
from covariant.models._pendulum_chain import pendulum_chain

__all__ = [
    "Lagrangian",
    "ModelError",
    "ModelFile",
    "Parameter",
    "acceleration",
    "ball_and_beam",
    "check_metric",
    "check_model",
    "energy",
    "friction",
    "load",
    "oscillator",
    "pendulum_chain",
    "position_error",
    "source",
    "wrap",
]
