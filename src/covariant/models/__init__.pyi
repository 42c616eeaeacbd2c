from . import fluid as fluid, marine as marine, robots as robots
from ._ball_and_beam import ball_and_beam as ball_and_beam
from ._bioreactor import bioreactor as bioreactor
from ._check import check_metric as check_metric
from ._duffing import duffing as duffing
from ._family import Family as Family, family as family
from ._file import (
    ModelError as ModelError,
    ModelFile as ModelFile,
    document as document,
    from_recipe as from_recipe,
    recipe_text as recipe_text,
)
from ._heavy_top import free_body as free_body, heavy_top as heavy_top
from ._hovercraft import hovercraft as hovercraft
from ._in_chart import chart_jacobian as chart_jacobian, chart_velocity as chart_velocity, in_chart as in_chart
from ._induction_motor import induction_motor as induction_motor
from ._load import load as load, recipe as recipe, spec_name as spec_name
from ._lorenz import lorenz as lorenz
from ._mechanical import (
    GroupSystem as GroupSystem,
    Lagrangian as Lagrangian,
    MechanicalSystem as MechanicalSystem,
    MomentumChart as MomentumChart,
    Motion as Motion,
    acceleration as acceleration,
    advance as advance,
    applied_force as applied_force,
    body_velocity as body_velocity,
    check_model as check_model,
    energy as energy,
    friction as friction,
    input_count as input_count,
    resistance as resistance,
    source as source,
    spatial_momentum as spatial_momentum,
)
from ._oscillator import oscillator as oscillator
from ._parameters import Parameter as Parameter, Parametric as Parametric
from ._pendulum_chain import pendulum_chain as pendulum_chain
from ._rewrite import rewrite as rewrite
from ._robot_family import (
    RobotFamily as RobotFamily,
    is_robot_number as is_robot_number,
    robot_family as robot_family,
)
from ._satellite import satellite as satellite
from ._satellite_arm import satellite_arm as satellite_arm
from ._state_space import StateSpace as StateSpace, state_space as state_space
from ._survey import Survey as Survey, survey as survey
from ._systems import check_spec as check_spec
from ._toml import Overrides as Overrides
from ._underwater_vehicle import underwater_vehicle as underwater_vehicle
from ._unknown_frequency import unknown_frequency as unknown_frequency
from ._van_der_pol import van_der_pol as van_der_pol

__all__ = [
    "GroupSystem",
    "Lagrangian",
    "MechanicalSystem",
    "ModelError",
    "ModelFile",
    "Motion",
    "Parameter",
    "Parametric",
    "StateSpace",
    "acceleration",
    "advance",
    "ball_and_beam",
    "duffing",
    "energy",
    "family",
    "fluid",
    "free_body",
    "load",
    "marine",
    "oscillator",
    "pendulum_chain",
    "robots",
    "state_space",
    "underwater_vehicle",
]
