from . import files as files, fluid as fluid, marine as marine, robots as robots, systems as systems
from ._in_chart import chart_jacobian as chart_jacobian, chart_velocity as chart_velocity, in_chart as in_chart
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
from ._parameters import Parameter as Parameter, Parametric as Parametric
from ._state_space import StateSpace as StateSpace, state_space as state_space
from ._survey import Survey as Survey, survey as survey
from .files import (
    Family as Family,
    ModelError as ModelError,
    ModelFile as ModelFile,
    Overrides as Overrides,
    RobotFamily as RobotFamily,
    check_metric as check_metric,
    check_spec as check_spec,
    document as document,
    family as family,
    from_recipe as from_recipe,
    is_robot_number as is_robot_number,
    load as load,
    recipe as recipe,
    recipe_text as recipe_text,
    rewrite as rewrite,
    robot_family as robot_family,
    spec_name as spec_name,
)
from .systems import (
    ball_and_beam as ball_and_beam,
    bioreactor as bioreactor,
    duffing as duffing,
    free_body as free_body,
    heavy_top as heavy_top,
    hovercraft as hovercraft,
    induction_motor as induction_motor,
    lorenz as lorenz,
    oscillator as oscillator,
    pendulum_chain as pendulum_chain,
    satellite as satellite,
    satellite_arm as satellite_arm,
    underwater_vehicle as underwater_vehicle,
    unknown_frequency as unknown_frequency,
    van_der_pol as van_der_pol,
)
