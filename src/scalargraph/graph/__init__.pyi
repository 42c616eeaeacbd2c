from ._differentiate import Derivative as Derivative, expand as expand, pairs as pairs
from ._fingerprint import fingerprint as fingerprint
from ._graph import (
    FOLD as FOLD,
    LARGEST as LARGEST,
    TRUTHS as TRUTHS,
    Condition as Condition,
    Graph as Graph,
    Node as Node,
    no_collection as no_collection,
)
from ._jax_forms import (
    Branch as Branch,
    Call as Call,
    ClosedJaxpr as ClosedJaxpr,
    JaxprEquation as JaxprEquation,
    Scan as Scan,
    While as While,
    equations as equations,
    needed as needed,
)
from ._jaxpr import (
    TracedFunction as TracedFunction,
    graft as graft,
    lower as lower,
    lower_traced as lower_traced,
    substitute as substitute,
    trace as trace,
)
from ._loops import (
    NO_OPERATIONS as NO_OPERATIONS,
    Repetition as Repetition,
    add_loop as add_loop,
    operations as operations,
    part_of as part_of,
    turn_operations as turn_operations,
)
from ._lowered import Conditions as Conditions, Lowered as Lowered, LoweringError as LoweringError
from ._read import (
    NUMBERS as NUMBERS,
    Domain as Domain,
    evaluate as evaluate,
    evaluate_batch as evaluate_batch,
    evaluate_nodes as evaluate_nodes,
    numbers as numbers,
    on_batches as on_batches,
)
from ._slopes import along as along, change as change, jacobian as jacobian, to_jax as to_jax
from ._stumpff import (
    STUMPFF as STUMPFF,
    STUMPFF_TERMS as STUMPFF_TERMS,
    stumpff as stumpff,
    stumpff_bounds as stumpff_bounds,
    stumpff_coefficients as stumpff_coefficients,
)
