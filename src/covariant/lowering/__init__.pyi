from ._c import c_function as c_function, c_helpers as c_helpers, c_number as c_number
from ._c_names import C_KEYWORDS as C_KEYWORDS
from ._c_rows import c_rows as c_rows
from ._c_writer import CText as CText, Signature as Signature
from ._differentiate import Derivative as Derivative, expand as expand, pairs as pairs
from ._enclose import Enclosure as Enclosure, fulfilled as fulfilled
from ._engine import enclose as enclose, in_c as in_c
from ._fingerprint import fingerprint as fingerprint
from ._graph import (
    FOLD as FOLD,
    LARGEST as LARGEST,
    TRUTHS as TRUTHS,
    Condition as Condition,
    Graph as Graph,
    Node as Node,
)
from ._intervals import INTERVALS as INTERVALS
from ._invariants import split as split
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
from ._loops import operations as operations
from ._lowered import Conditions as Conditions, Lowered as Lowered, LoweringError as LoweringError
from ._peephole import simplified as simplified
from ._read import (
    NUMBERS as NUMBERS,
    Domain as Domain,
    evaluate as evaluate,
    evaluate_batch as evaluate_batch,
    numbers as numbers,
    on_batches as on_batches,
)
from ._rounding import perturbed as perturbed
from ._stumpff import STUMPFF as STUMPFF, stumpff as stumpff
from ._tape import Interval as Interval, Truth as Truth
from ._to_c import to_c as to_c
