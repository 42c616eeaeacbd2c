"""Computes all numbers of the reproduction of Jouffroy & Fossen 2004, in stages."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from covariant.papers.jouffroy_fossen._odin import (
    K2,
    RATE,
    odin_box,
    odin_certificate,
    odin_eigenvalues,
    odin_loop,
    odin_sampled_rate,
    tail_rate,
)
from covariant.papers.jouffroy_fossen._sea import sea, sea_cost, sea_table
from covariant.papers.jouffroy_fossen._ship import ship_decay, ship_eigenvalues
from covariant.papers.jouffroy_fossen._somersault import somersault
from covariant.papers.jouffroy_fossen._theorem_2 import COUNTEREXAMPLES
from covariant.papers.jouffroy_fossen._theorem_3 import closed_form, odin_cascade

STAGES = 9
"""Number of progress reports of `reproduce`."""


def reproduce(progress: Callable[[str], None] = lambda stage: None) -> dict[str, Any]:
    """Compute all reproduced numbers of the paper.

    Args:
        progress: Called with the name of each of `STAGES` stages.

    Returns:
        `ship` (eigenvalues of (53) with either K2, guaranteed and fitted rates); `theorem2` (for each counter-example
        the printed statement, the truth, and the verdict of the proof); `odin` (eigenvalues and sampled rates with
        three K2, the certified rate and its set, the rates of the closed loop); `somersault` (with a quaternion,
        through a pitch of 90°); `theorem3` (constants and verdicts); `sea` (velocity errors of three estimators); and
        `seconds`, the time it took.
    """
    began = time.perf_counter()
    progress("the ship")
    decay = ship_decay()
    results: dict[str, Any] = {
        "ship": {"eigenvalues": ship_eigenvalues(), **{k: decay[k] for k in ("rate", "printed", "fitted")}},
    }
    progress("Theorem 2")
    results["theorem2"] = {
        name: {"printed": case.printed, "true": case.true, "proof": case.proof(0.1).verdict}
        for name, case in COUNTEREXAMPLES.items()
    }
    progress("ODIN: certificate")
    certified = odin_certificate(RATE)
    progress("ODIN: closed loop")
    fitted = odin_loop()
    progress("ODIN: sampled rates")
    results["odin"] = {
        "eigenvalues": odin_eigenvalues(),
        "sampled": {
            "identity, no cross term": odin_sampled_rate(np.eye(6), np.zeros((6, 6))),
            "repaired, no cross term": odin_sampled_rate(K2, np.zeros((6, 6))),
            "repaired": odin_sampled_rate(),
        },
        "certified": {
            "rate": RATE,
            "verdict": certified.statement.verdict,
            "boxes": certified.boxes,
            "domain": str(odin_box().free),
        },
        "loop": {"tracking": tail_rate(fitted.t, fitted.tracking), "observer": tail_rate(fitted.t, fitted.observer)},
    }
    progress("a somersault")
    turning = somersault()
    results["somersault"] = {
        "largest_pitch": math.degrees(float(np.abs(turning["pitch"]).max())),
        # Rising edges of "past 80°" are counted, so each passage counts once.
        "times_past_80_degrees": int((np.diff((np.abs(turning["pitch"]) > math.radians(80.0)).astype(int)) == 1).sum()),
        **{f"{name}_last": float(turning[name][-1]) for name in ("observer", "tracking")},
    }
    progress("Theorem 3")
    certificate = odin_cascade()
    results["theorem3"] = {
        "constants": certificate.constants._asdict(),
        "closed_form": closed_form(),
        "gamma1_squared": certificate.constants.gamma1**2,
        "bound": certificate.constants.bound,
        "printed": certificate.printed,
        "weighted": certificate.constants.weighted,
        "kappa": certificate.kappa,
        "units": certificate.units,
    }
    progress("dynamic positioning: simulation and estimates")
    log = sea()
    results["sea"] = sea_table(log)
    progress("dynamic positioning: cost of a step")
    for name, microseconds in sea_cost(log).items():
        results["sea"][name]["cost"] = round(microseconds, 2)
    results["seconds"] = round(time.perf_counter() - began, 1)
    return results
