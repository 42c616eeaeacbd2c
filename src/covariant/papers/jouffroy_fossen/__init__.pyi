from ._figures import draw as draw, draw_odin as draw_odin, draw_sea as draw_sea
from ._odin import (
    CROSS as CROSS,
    K1 as K1,
    K2 as K2,
    KD as KD,
    KP as KP,
    LAMBDA as LAMBDA,
    PRINTED_K2 as PRINTED_K2,
    RATE as RATE,
    Loop as Loop,
    closed_loop as closed_loop,
    odin_box as odin_box,
    odin_certificate as odin_certificate,
    odin_controller as odin_controller,
    odin_eigenvalues as odin_eigenvalues,
    odin_loop as odin_loop,
    odin_observer as odin_observer,
    odin_path as odin_path,
    odin_sampled_rate as odin_sampled_rate,
    tail_rate as tail_rate,
)
from ._page import TITLE as TITLE, page as page, sea_rows as sea_rows, summary as summary
from ._reproduce import STAGES as STAGES, reproduce as reproduce
from ._sea import (
    COMPASS as COMPASS,
    DURATION as DURATION,
    GAPS as GAPS,
    GNSS as GNSS,
    SETTLED as SETTLED,
    STEP as STEP,
    Sea as Sea,
    passive_observer as passive_observer,
    sea as sea,
    sea_cost as sea_cost,
    sea_errors as sea_errors,
    sea_table as sea_table,
)
from ._ship import ship_decay as ship_decay, ship_eigenvalues as ship_eigenvalues
from ._somersault import somersault as somersault
from ._theorem_2 import COUNTEREXAMPLES as COUNTEREXAMPLES, Scalar as Scalar
from ._theorem_3 import odin_cascade as odin_cascade
