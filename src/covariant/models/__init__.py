"""Models: mechanical systems and general nonlinear systems as JAX functions, with one example system in each file."""

from covariant.models._ball_and_beam import ball_and_beam
from covariant.models._bioreactor import bioreactor
from covariant.models._check import check_metric
from covariant.models._duffing import duffing
from covariant.models._family import Family, family
from covariant.models._file import ModelError, ModelFile, document, from_recipe
from covariant.models._heavy_top import free_body, heavy_top
from covariant.models._hovercraft import hovercraft
from covariant.models._in_chart import chart_jacobian, chart_velocity, in_chart
from covariant.models._induction_motor import induction_motor
from covariant.models._load import load, recipe
from covariant.models._lorenz import lorenz
from covariant.models._mechanical import (
    GroupSystem,
    Lagrangian,
    MechanicalSystem,
    MomentumChart,
    Motion,
    acceleration,
    advance,
    applied_force,
    body_velocity,
    check_model,
    energy,
    friction,
    input_count,
    resistance,
    source,
    spatial_momentum,
)
from covariant.models._oscillator import oscillator
from covariant.models._parameters import Parameter, Parametric
from covariant.models._pendulum_chain import pendulum_chain
from covariant.models._rewrite import rewrite
from covariant.models._satellite import satellite
from covariant.models._satellite_arm import satellite_arm
from covariant.models._state_space import StateSpace, state_space
from covariant.models._survey import Survey, survey
from covariant.models._underwater_vehicle import underwater_vehicle
from covariant.models._unknown_frequency import unknown_frequency
from covariant.models._van_der_pol import van_der_pol

__all__ = [
    "Family",
    "GroupSystem",
    "Lagrangian",
    "MechanicalSystem",
    "ModelError",
    "ModelFile",
    "MomentumChart",
    "Motion",
    "Parameter",
    "Parametric",
    "StateSpace",
    "Survey",
    "acceleration",
    "advance",
    "applied_force",
    "ball_and_beam",
    "bioreactor",
    "body_velocity",
    "chart_jacobian",
    "chart_velocity",
    "check_metric",
    "check_model",
    "document",
    "duffing",
    "energy",
    "family",
    "free_body",
    "friction",
    "from_recipe",
    "heavy_top",
    "hovercraft",
    "in_chart",
    "induction_motor",
    "input_count",
    "load",
    "lorenz",
    "oscillator",
    "pendulum_chain",
    "recipe",
    "resistance",
    "rewrite",
    "satellite",
    "satellite_arm",
    "source",
    "spatial_momentum",
    "state_space",
    "survey",
    "underwater_vehicle",
    "unknown_frequency",
    "van_der_pol",
]
