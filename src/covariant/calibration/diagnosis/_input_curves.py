"""The curve by which an input acts: as logged, with the other sign, with an offset, within limits, beyond a dead band;
and its clock, by which it acts earlier or later.

The accelerations of a log are explained by a multiple of a curve of one input, beside all that a rough model may have
wrong: its size, friction and weight in each joint, and any curve of the other inputs. The simplest curve that
explains rows held out about as well as a curve with many corners is named. A wrong mass or friction makes no curve.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from covariant.calibration.diagnosis._block_regression import weighted_least_squares
from covariant.calibration.diagnosis._case import Case, Residual, accelerations, acting, averaged, best_window, smoothed
from covariant.calibration.diagnosis._finding import Finding, later_line
from covariant.calibration.diagnosis._missing_torques import by_joints, friction_columns, turning_friction, weights
from covariant.calibration.diagnosis._smooth import Smooth, held_inputs
from covariant.calibration.diagnosis._suspicion import (
    BLOCKS,
    HELD_OUT,
    Comparison,
    Suspicion,
    Unexplained,
    blocks_of,
    choose,
)
from covariant.calibration.diagnosis._thresholds import CURVE_ERRORS, THRESHOLDS
from covariant.logs import unit_factor

CORNERS = np.linspace(0.0, 1.0, 9)[1:-1]
"""Quantiles of an input at which its richest curve has a corner."""
TRIED, EVALUATIONS = 16, 40
"""Values of a number of a curve that are tried first, and evaluations of the search from the best of them."""
SHIFTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Rows by which inputs may act later or earlier than logged."""
RICHER = 0.7
"""What the richest curve leaves at most where it chooses, relative to the line, for any curve to be looked for."""
ACTS = 0.3
"""What a curve leaves of the deviation of an input at least."""
NUDGE = 1e-3
"""Change of a number of a curve for the derivative in it, relative to the range of the input."""
KNOWN = 1e-6
"""Smallest singular value of what explains accelerations, relative to the largest one."""


class Curve(NamedTuple):
    """A curve of an input: its sign, then its offset, then its dead band, and then its limits."""

    sign: float = 1.0
    offset: float = 0.0
    dead: float = 0.0
    low: float = -np.inf
    high: float = np.inf

    @classmethod
    def of(cls, numbers: tuple[str, ...], values: Float[np.ndarray, "k"]) -> "Curve":
        """The curve with some numbers; `limit` stands for both limits."""
        given = dict(zip(numbers, map(float, values), strict=True))
        if "limit" in given:
            limit = abs(given.pop("limit"))
            given |= {"low": -limit, "high": limit}
        return cls(**given)

    def __call__(self, u: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        """The input that acts where `u` is logged."""
        u = self.sign * (u - self.offset)
        return np.clip(u - np.clip(u, -abs(self.dead), abs(self.dead)), self.low, self.high)

    def expression(self, name: str, factor: float) -> str:
        """The expression of a column that is right, where the column of this name is logged in units of a factor."""
        low, high, offset, dead = (f"{x / factor:.3g}" for x in (self.low, self.high, self.offset, abs(self.dead)))
        text = f"{name} - {offset}".replace("- -", "+ ") if self.offset else name
        if self.dead:
            text = f"{text} - numpy.clip({text}, -{dead}, {dead})"
        limits = (each if np.isfinite(float(each)) else "None" for each in (low, high))
        return f"numpy.clip({text}, {', '.join(limits)})" if np.isfinite([self.low, self.high]).any() else text


WORDS = {
    "offset": "is logged with an offset of {}",
    "limit": "acts up to ±{} and no further",
    "high": "acts up to {} and no further",
    "low": "acts down to {} and no further",
    "dead": "acts only beyond ±{}",
}
"""What the numbers of a curve say of an input."""
WORDS_OF_ALL = "then, whatever its mass, weight and friction"
"""Words of any curve, by which none of them is named as a rival of another one."""
MEMBERS = {
    "offset of an input": (("offset",),),
    "limit of an input": (("limit",), ("high",), ("low",), ("low", "high")),
    "dead band of an input": (("dead",),),
    "offset and limit of an input": (("offset", "limit"),),
}
"""Numbers of the curves by the name of their finding, from simple to rich."""


def input_curve(balance: "Balance", signs: bool) -> tuple[Suspicion, Finding] | None:
    """The suspicion that an input acts by a curve, and the finding on it; None if all act as logged.

    With `signs` an input with the other sign is such a curve too.
    """
    accepted = []
    for rest in map(balance.beside_others, balance.moving):
        as_it_is, richest = (rest.unexplained(left) for left in (rest.residual(Curve()), rest.richest()))
        if Comparison.of(as_it_is, richest).choosing > RICHER * as_it_is.share(~HELD_OUT, as_it_is.known):
            continue
        one = rest.choose(rest.residual(Curve()), lambda rest=rest: _suspicions(rest, signs))
        accepted += [one] if one is not None else []
    return min(accepted, key=lambda one: one[1].numbers["unexplained_after"], default=None)


def late_inputs(balance: "Balance") -> tuple[Suspicion, Finding] | None:
    """The suspicion that all inputs act some rows later or earlier, and the finding on it; None if they are in time."""
    if not balance.moving:
        return None
    case, names = balance.case, ", ".join(balance.case.names.u)
    rest, u = balance.beside([]), np.asarray(case.record.u)

    def shifted(rows: int) -> Float[np.ndarray, "T m"]:
        return u[np.clip(np.arange(len(u)) - rows, 0, len(u) - 1)]

    def left(rows: int) -> Float[np.ndarray, "N"]:
        later = shifted(rows)
        return rest.residual_of(np.stack([balance.by_input(later[:, j], j) for j in range(u.shape[1])], axis=1))

    def suspect() -> Iterator[tuple[Suspicion, Float[np.ndarray, "N"]]]:
        for rows in (side * k for k in SHIFTS if k <= len(u) / 8 for side in (1, -1)):
            time = rows * case.spacing
            claim = f"positions seem to follow {names} by about {time:.2g} s later than the model file says"
            line = later_line(case.file, time)
            if rows < 0:
                claim = f"the stamps of {names} seem to be about {-time:.2g} s later than they act"
                line = f"take {-time:.2g} s off them"
            what, numbers = "delay against the inputs", {"delay": time, "rows": rows}
            change = shifted(rows)
            apply = lambda case, change=change: case.with_inputs(change)  # noqa: E731  bound to these rows
            yield Suspicion(what, "", WORDS_OF_ALL, line, apply, "rows", claim, numbers), left(rows)

    return rest.choose(left(0), suspect)


def corner_parts(u: Float[np.ndarray, "T"]) -> list[Float[np.ndarray, "T"]]:
    """The parts of which any curve of an input consists: a constant, a line, and its corners."""
    return [np.ones_like(u), u, *(np.maximum(u - corner, 0.0) for corner in np.unique(np.quantile(u, CORNERS)))]


class Balance(NamedTuple):
    """What explains the accelerations of a log: at N points and coordinates that are compared, in usual sizes.

    Attributes:
        case: The log.
        log: The log, smoothed.
        before: What the model leaves of it.
        effects: Accelerations (K, n) by one unit of each input.
        columns: Accelerations (N, p) by the numbers that a model may have wrong.
    """

    case: Case
    log: Smooth
    before: Residual
    effects: list[Float[np.ndarray, "K n"]]
    columns: Float[np.ndarray, "N p"]

    @classmethod
    def of(cls, case: Case) -> "Balance | None":
        """Those of a model with the wrong size, and wrong friction and weight in each joint; None for no motion."""
        best = best_window(case)
        if best is None:
            return None
        log, before = smoothed(case, best[0]), best[1]
        none = np.zeros_like(log.u)
        idle = accelerations(case.model, log._replace(u=none))
        effects = [accelerations(case.model, log._replace(u=none + unit)) - idle for unit in np.eye(log.u.shape[1])]
        made = cls(case, log, before, effects, np.empty((0, 0)))
        weight = by_joints(case.model, log, np.asarray(weights(case.model, log.q)))
        turning = (each for torque in turning_friction(log) for each in by_joints(case.model, log, torque))
        columns = [*(averaged(log, each) for each in (idle, *weight, *turning)), *friction_columns(case.model, log)]
        if case.effects is not None:
            columns += case.effects(log)
        sized = (made.sized(each) for each in columns)
        return made._replace(columns=np.stack([each for each in sized if np.isfinite(each).all()], axis=1))

    @property
    def moving(self) -> list[int]:
        """Indices of the inputs that change."""
        return np.flatnonzero(np.ptp(np.asarray(self.case.record.u), axis=0) > 0).tolist()

    @property
    def size(self) -> Float[np.ndarray, "n"]:
        """Usual size (n,) of each acceleration."""
        return np.sqrt(np.mean(self.before.measured[self.before.used] ** 2, axis=0))

    def sized(self, values: Float[np.ndarray, "K n"]) -> Float[np.ndarray, "N"]:
        """Accelerations on the grid at what is compared, in usual sizes."""
        return (values[self.before.used] / self.size)[:, self.before.told].ravel()

    def by_input(self, u: Float[np.ndarray, "T"], j: int) -> Float[np.ndarray, "N"]:
        """Accelerations by some values of input j."""
        changed = np.array(self.case.record.u)
        changed[:, j] = u
        record = acting(self.case.with_inputs(changed))
        held = held_inputs(np.asarray(record.t), np.asarray(record.u)[:, [j]], self.log.t, self.log.step)
        return self.sized(averaged(self.log, held * self.effects[j]))

    def by_corners(self, j: int) -> Float[np.ndarray, "N c"]:
        """Accelerations by the parts of which any curve of input j consists."""
        return np.stack([self.by_input(part, j) for part in corner_parts(np.asarray(self.case.record.u)[:, j])], axis=1)

    def beside_others(self, j: int) -> "Rest":
        """What is left to the curve of input j beside these numbers and any curves of the other inputs."""
        return self.beside([self.by_corners(k) for k in range(len(self.effects)) if k != j], j)

    def beside(self, others: list[Float[np.ndarray, "N c"]], j: int = -1) -> "Rest":
        """What is left beside these numbers and multiples of other columns."""
        columns = np.concatenate([self.columns, *others], axis=1)
        chosen = np.repeat(~HELD_OUT[blocks_of(int(self.before.used.sum()))], int(self.before.told.sum()))
        columns = columns / np.maximum(np.linalg.norm(columns[chosen], axis=0), 1e-300)
        _, sizes, combined = np.linalg.svd(columns[chosen], full_matrices=False)
        known = sizes > KNOWN * sizes[0]
        basis = columns @ (combined[known].T / sizes[known])
        rest = Rest(self, j, chosen, basis, np.empty(0))
        return rest._replace(measured=rest.beyond(self.sized(self.before.measured)))


class Rest(NamedTuple):
    """What the curve of input j has to explain of the accelerations.

    Attributes:
        balance: What else explains them.
        j: Index of the input.
        chosen: Which of the N values choose a curve; the others judge it.
        basis: What else explains them (N, r), orthonormal where they choose.
        measured: Measured accelerations (N,) beyond that.
    """

    balance: Balance
    j: int
    chosen: Bool[np.ndarray, "N"]
    basis: Float[np.ndarray, "N r"]
    measured: Float[np.ndarray, "N"]

    @property
    def u(self) -> Float[np.ndarray, "T"]:
        """The input as it is logged."""
        return np.asarray(self.balance.case.record.u)[:, self.j]

    def beyond(self, values: np.ndarray) -> np.ndarray:
        """Accelerations (N, ...) beyond the basis."""
        return values - self.basis @ (self.basis[self.chosen].T @ values[self.chosen])

    def by_curve(self, curve: Curve) -> Float[np.ndarray, "N"]:
        """Accelerations by a curve beyond the basis, times the factor not below zero that explains most."""
        column = self.beyond(self.balance.by_input(curve(self.u), self.j))
        some = column[self.chosen]
        return column * max(float(some @ self.measured[self.chosen]), 0.0) / max(float(some @ some), 1e-300)

    def residual(self, curve: Curve) -> Float[np.ndarray, "N"]:
        """Accelerations that a curve leaves."""
        return self.measured - self.by_curve(curve)

    def richest(self) -> Float[np.ndarray, "N"]:
        """Accelerations that the curve with most corners leaves."""
        return self.residual_of(self.balance.by_corners(self.j))

    def residual_of(self, columns: Float[np.ndarray, "N c"]) -> Float[np.ndarray, "N"]:
        """Accelerations that multiples of columns leave."""
        columns = self.beyond(columns)
        numbers = np.linalg.lstsq(columns[self.chosen], self.measured[self.chosen], rcond=KNOWN)[0]
        return self.measured - columns @ numbers

    def unexplained(self, left: Float[np.ndarray, "N"]) -> Unexplained:
        """What is left, as fractions of the squares of the accelerations in blocks of time."""
        before = self.balance.before
        shape = -1, int(before.told.sum())
        whole, left = self.balance.sized(before.measured).reshape(shape), left.reshape(shape)
        noise = (before.noise / self.balance.size)[before.told]
        return Unexplained.of(Residual(whole, whole - left, np.ones(len(left), bool), noise))

    def choose(
        self,
        left: Float[np.ndarray, "N"],
        suspect: Callable[[], Iterable[tuple[Suspicion, Float[np.ndarray, "N"]]]],
    ) -> tuple[Suspicion, Finding] | None:
        """The simplest suspicion that explains about as much as the best one; None without one that has a name.

        `left` is what is left as the log is. Nothing is suspected where that is little.
        """
        now = self.unexplained(left)
        if now.share(np.ones(BLOCKS, bool), now.known) < THRESHOLDS["curve"].least:
            return None
        found = choose((each, Comparison.of(now, self.unexplained(left))) for each, left in suspect())
        return found if found is not None and found[0].what else None

    def likeliest(self, numbers: tuple[str, ...], begin: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
        """The numbers of a curve that leave least where values choose, near some numbers."""
        from scipy.optimize import minimize

        def loss(values: Float[np.ndarray, "k"]) -> float:
            return float(np.sum(self.residual(Curve.of(numbers, values))[self.chosen] ** 2))

        if len(numbers) == 1:
            begin = min((np.array([value]) for value in self.places(numbers[0])), key=loss)
        sides = np.diag(np.full(len(begin), float(np.ptp(self.u)) / (2 * TRIED)))
        options = {"initial_simplex": np.stack([begin, *(begin + sides)]), "maxfev": EVALUATIONS * len(begin)}
        return minimize(loss, begin, method="Nelder-Mead", options=options).x

    def places(self, number: str) -> Float[np.ndarray, "k"]:
        """Numbers of a curve that are tried first."""
        if number == "offset":
            return np.linspace(self.u.min(), self.u.max(), TRIED)
        return np.quantile(self.u if number in ("low", "high") else np.abs(self.u), np.linspace(0.02, 0.98, TRIED))

    def std(self, numbers: tuple[str, ...], values: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
        """Standard errors of the numbers of a curve."""
        at, step = self.by_curve(Curve.of(numbers, values)), NUDGE * float(np.ptp(self.u))
        slopes = [(self.by_curve(Curve.of(numbers, values + each)) - at) / step for each in step * np.eye(len(values))]
        shape = -1, int(self.balance.before.told.sum()), 1 + len(values)
        table = np.stack([at, *slopes], axis=1).reshape(shape)
        _, cov = weighted_least_squares(self.measured.reshape(shape[:2]), table, np.eye(shape[1]))
        return np.sqrt(np.diag(cov)[1:])


def _suspicions(rest: Rest, signs: bool) -> Iterator[tuple[Suspicion, Float[np.ndarray, "N"]]]:
    """Suspicions of the curves of an input, from simple to rich, with the accelerations that each leaves."""
    names, j, numbers_of = rest.balance.case.names, rest.j, dict[str, float]()
    if signs:
        factors = np.where(np.arange(len(names.u)) == j, -1.0, 1.0)
        claim, line = f"{names.u[j]} seems to be logged with the other sign", names.line("u", factors)
        yield _suspicion(rest, "sign of an input", Curve(sign=-1.0), claim, f"{line}, or by the signs of its positions")
    factor = unit_factor(names.stated_unit("u", j))
    for what, kinds in MEMBERS.items():
        for numbers in kinds:
            values = rest.likeliest(numbers, np.array([numbers_of.get(each, 0.0) for each in numbers]))
            stds, curve = rest.std(numbers, values), Curve.of(numbers, values)
            numbers_of |= dict(zip(numbers, values.tolist(), strict=True))
            # A number without an effect has no error, and a curve that hardly lets an input act is none of its own.
            acts = np.std(curve(rest.u)) > ACTS * np.std(rest.u)
            if acts and (np.abs(values) > CURVE_ERRORS * stds).all() and stds.all():
                sizes = (f"{value:.3g} ± {std:.2g}" for value, std in zip(values, stds, strict=True))
                said = (WORDS[each].format(size) for each, size in zip(numbers, sizes, strict=True))
                line = f"write {curve.expression(names.u[j], factor)} into the column {names.u[j]} of the log"
                found = {**dict(zip(numbers, values.tolist(), strict=True)), "std": stds.tolist()}
                yield _suspicion(rest, what, curve, f"{names.u[j]} {' and '.join(said)}", line, found)
    yield Suspicion("", "", WORDS_OF_ALL, "", lambda case: case, "curve"), rest.richest()


def _suspicion(
    rest: Rest, what: str, curve: Curve, claim: str, line: str, numbers: Mapping[str, Any] = MappingProxyType({})
) -> tuple[Suspicion, Float[np.ndarray, "N"]]:
    def apply(case: Case) -> Case:
        u = np.array(case.record.u)
        u[:, rest.j] = curve(u[:, rest.j])
        return case.with_inputs(u)

    name = rest.balance.case.names.u[rest.j]
    return Suspicion(what, name, WORDS_OF_ALL, line, apply, "curve", claim, numbers), rest.residual(curve)
