"""Data that pass between subpackages: a `Record` goes into an observer, a `Run` comes out."""

import enum
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Inexact


class Result(enum.IntEnum):
    """Outcome of a numerical step, as found in `info.result`; zero is good, and a larger code is worse."""

    OK = 0
    COASTED = 1
    INPUT_HELD = 2
    REPEATED = 3
    OUTLIER = 4
    RESTARTED = 5
    ASTRAY = 6
    CUT_LOCUS = 7
    LEFT_DOMAIN = 8
    ESCAPED = 9
    CONJUGATE_POINT = 10
    NOT_CONVERGED = 11
    NOT_SETTLED = 12
    NOT_RECONSTRUCTIBLE = 13
    OUT_OF_DOMAIN = 14
    STEP_REFUSED = 15
    NOT_FINITE = 16

    @property
    def message(self) -> str:
        return _MESSAGES[self]


_MESSAGES = {
    Result.OK: "ok",
    Result.COASTED: "no measurement: the model ran on alone",
    Result.INPUT_HELD: "an input is not finite: the last finite one was held",
    Result.REPEATED: "the stamp is that of the sample before: the state was left as it was",
    Result.OUTLIER: "a measurement is too far from what is expected: it was refused, as if it were missing",
    Result.RESTARTED: "the estimate started anew: what came before tells too little of the motion now",
    Result.ASTRAY: "the estimate does not follow the measurements: its velocity is off by more than the usual speed",
    Result.CUT_LOCUS: "two ways to the measurement are equally short, as after half a turn: one of them was taken",
    Result.LEFT_DOMAIN: "the past of the point leaves the domain: its metric starts at the border",
    Result.ESCAPED: "the past of the point escapes to infinity: its metric starts far away",
    Result.NOT_SETTLED: "the metric still depends on how it was started: take a larger rate or more steps",
    Result.NOT_RECONSTRUCTIBLE: "not reconstructible: the past output does not determine the state there",
    Result.OUT_OF_DOMAIN: "outside the domain: there is no metric",
    Result.NOT_CONVERGED: "the geodesic to the measurement was not found: allow more Newton iterations or steps",
    Result.CONJUGATE_POINT: "the geodesic found passes a conjugate point and is not the shortest one",
    Result.STEP_REFUSED: "the step in time is negative or not finite: the state was left as it was; mend the stamps",
    Result.NOT_FINITE: "the state is not finite: lower the gains or the step",
}


AnyArray = Array | np.ndarray


class Record(NamedTuple):
    """A log, time first: stamps t (T,) [s], inputs u (T, m), measured positions y, and the true state x where known.

    Positions are coordinates (T, n), or group elements (T, N, N). The state is (T, 2n), or a `Motion` of the group.
    NaN in y marks a missing measurement. `check` tests what a record must satisfy.
    """

    t: Float[AnyArray, "T"]
    u: Float[AnyArray, "T m"]
    y: Inexact[AnyArray, "T *n"]
    x: Any = None

    def check(self) -> "Record":
        """Return the record, or raise `ValueError` naming the first thing wrong with it."""
        t, u, y = (np.asarray(a) for a in (self.t, self.u, self.y))
        if t.ndim != 1 or u.ndim != 2 or y.ndim not in (2, 3) or not len(t) == len(u) == len(y):
            raise ValueError(
                f"a record needs t (T,), u (T, m), y (T, n) or (T, N, N); got {t.shape}, {u.shape}, {y.shape}"
            )
        if len(t) < 2:
            raise ValueError(f"a record needs at least two rows; this one has {len(t)}")
        for name, array in (("t", t), ("u", u)):
            bad = ~np.isfinite(array.reshape(len(t), -1)).all(1)
            if bad.any():
                raise ValueError(
                    f"row {bad.argmax() + 1}: {name} is not a finite number; only measurements may be missing"
                )
        infinite = np.isinf(y.reshape(len(t), -1)).any(1)
        if infinite.any():
            raise ValueError(f"row {infinite.argmax() + 1}: a measurement is infinite; mark a missing one by NaN")
        step = np.diff(t)
        if (step < 0).any():
            k = int((step < 0).argmax())
            raise ValueError(f"row {k + 2}: time goes back from {t[k]:g} s to {t[k + 1]:g} s; sort or split the log")
        if (step == 0).any():
            k = int((step == 0).argmax())
            raise ValueError(f"rows {k + 1} and {k + 2} have the same stamp {t[k]:g} s; keep one of them")
        if np.isnan(y[0]).any():
            raise ValueError("row 1 lacks a measurement, so no estimate can start there; cut the log to begin later")
        return self


class Run(NamedTuple):
    """Result of an observer's pass over a record: stamps t (T,), the estimates, and the info, stacked along time.

    The estimates are (q, v) (T, 2n), or on a group a `Motion` of g (T, N, N) and v (T, n).
    """

    t: Float[Array, "T"]
    estimate: Any
    info: Any


def lag_inputs(record: Record, time_constant: float) -> Record:
    """The record with its inputs passed through a causal first-order lag of `time_constant` [s]; 0 changes nothing.

    A motor follows its logged torque with a delay; such a lag, identified with the other parameters, models it.
    """
    if time_constant == 0:
        return record
    t, u = np.asarray(record.t), np.array(record.u)
    keep = np.exp(-np.diff(t) / time_constant)
    for k in range(1, len(t)):
        u[k] = keep[k - 1] * u[k - 1] + (1 - keep[k - 1]) * u[k]
    return record._replace(u=u)
