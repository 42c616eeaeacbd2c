from ._assumed import ASSUMED as ASSUMED
from ._box import Given as Given, first_velocity as first_velocity, prediction_variables as prediction_variables
from ._claims import (
    CLAIMS as CLAIMS,
    UNPROVED as UNPROVED,
    AbstractClaim as AbstractClaim,
    ContractionClaim as ContractionClaim,
    CorrectionClaim as CorrectionClaim,
    DisturbanceClaim as DisturbanceClaim,
    MissingClaim as MissingClaim,
    PredictionClaim as PredictionClaim,
    ReachClaim as ReachClaim,
    RemainderClaim as RemainderClaim,
    Setting as Setting,
    StartClaim as StartClaim,
    reach_squares as reach_squares,
    select as select,
)
from ._contraction import (
    Flow as Flow,
    StateMetric as StateMetric,
    contraction_matrix as contraction_matrix,
    contraction_rate as contraction_rate,
    generalised_jacobian as generalised_jacobian,
    in_coordinates as in_coordinates,
)
from ._contraction_statement import contraction_statement as contraction_statement
from ._document import (
    FORMAT as FORMAT,
    MOST_LOST as MOST_LOST,
    Document as Document,
    Resolved as Resolved,
    parse as parse,
    read_fields as read_fields,
    read_interval as read_interval,
    read_metric as read_metric,
    read_recipe as read_recipe,
    write as write,
)
from ._effort import Effort as Effort
from ._error_system import (
    ErrorSystem as ErrorSystem,
    Point as Point,
    corrections as corrections,
    entries_read as entries_read,
    need_steady as need_steady,
    value_graph as value_graph,
    values as values,
)
from ._force_bounds import (
    force_bounds as force_bounds,
    force_slopes as force_slopes,
    need_conditions as need_conditions,
)
from ._inequalities import (
    FORMS as FORMS,
    at_correction as at_correction,
    at_noisy_correction as at_noisy_correction,
    contraction as contraction,
    correction as correction,
    disturbance_bound as disturbance_bound,
    in_frame_along as in_frame_along,
    joint_force_bound as joint_force_bound,
    length_change as length_change,
    metric_form as metric_form,
    missing_bound as missing_bound,
    remainder_bound as remainder_bound,
    squared_widths as squared_widths,
    width_bound as width_bound,
)
from ._intrinsic import (
    OBSERVER_KINDS as OBSERVER_KINDS,
    Intrinsics as Intrinsics,
    any_configuration as any_configuration,
    check_unique as check_unique,
    configuration_shape as configuration_shape,
    dimension as dimension,
    error_system as error_system,
    first_order as first_order,
    frame_of as frame_of,
    friction_of as friction_of,
    need_joint_friction as need_joint_friction,
    need_steady_friction as need_steady_friction,
    observer_document as observer_document,
    with_model as with_model,
)
from ._properties import (
    PERIODIC as PERIODIC,
    need_known as need_known,
    need_symmetry as need_symmetry,
    true_region as true_region,
)
from ._radius_recursion import Recursion as Recursion
from ._recipe import (
    check_observer as check_observer,
    check_recipe as check_recipe,
    check_replacement as check_replacement,
    is_same_observer as is_same_observer,
)
from ._region import SPEED as SPEED, Bounds as Bounds, Region as Region, amount as amount, region_of as region_of
from ._remainder import Remainder as Remainder
from ._sampling import Loss as Loss, Sampling as Sampling, unit_reach as unit_reach
from ._smoothness import ANALYTIC as ANALYTIC, show_no_jumps as show_no_jumps
from ._start import Start as Start, start_claim as start_claim, start_of as start_of
from ._statement import (
    Evidence as Evidence,
    Hypothesis as Hypothesis,
    Statement as Statement,
    Verdict as Verdict,
    lines as lines,
    need_doubles as need_doubles,
    rounded_down as rounded_down,
    rounded_up as rounded_up,
)
from ._steady import (
    disturbance_sizes as disturbance_sizes,
    loss_of as loss_of,
    steady_distance as steady_distance,
    steady_of as steady_of,
)
from ._tangent_metric import (
    TwoByTwo as TwoByTwo,
    check_q as check_q,
    conditioning as conditioning,
    error_matrix as error_matrix,
    lowered_christoffel as lowered_christoffel,
    lyapunov as lyapunov,
    optimal_lyapunov as optimal_lyapunov,
    rate_of as rate_of,
    tangent_metric as tangent_metric,
)
