"""Sentences of a fit: where its search began, what logs do not determine, which other reading would explain them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant import scoring
from covariant.calibration import Fit, RobotFit
from covariant.calibration.diagnosis import Finding
from covariant.models import RobotFamily
from covariant.verbs.base.aligned import Aligned
from covariant.verbs.base.fit_logs import BETWEEN

LEAST_MOTION, LEAST_FOLLOWED = 0.1, 0.7
"""Motion of a joint relative to that of the one that moves most, and error relative to its motion, from which a fitted
servo does not explain what its joint does."""
LEAST_USUAL = 0.3
"""Motion of a joint in the logs that judge, relative to that in all logs, below which they say nothing of it."""
LONGEST_DELAY = 0.3
"""A delay [s] longer than that of any servo, which a reversed command looks like in a motion of one frequency."""
CLEAR = 2.0
"""Standard errors by which held or linear inputs must explain a log better than the other ones to be preferred."""
MIRRORED = (
    "on which side of its link the load is: with the offsets of joints open too, a mirrored load with other offsets "
    "may explain these logs as well, and the solution nearest to the first values is given"
)


class Gain(NamedTuple):
    """Log-likelihood with linear inputs minus that with held ones, and its standard error."""

    of_linear: float
    standard_error: float

    @classmethod
    def of(cls, less: Float[np.ndarray, "B"]) -> "Gain":
        """The gain from what linear inputs lower the negative log-likelihood by in each of B independent parts."""
        # The variance of a sum of independent terms is their number times that of one; errors may be correlated within.
        return cls(float(np.sum(less)), float(np.sqrt(len(less)) * np.std(less, ddof=1)))

    @property
    def clear(self) -> bool:
        """Whether the gain exceeds `CLEAR` standard errors."""
        return abs(self.of_linear) > CLEAR * self.standard_error


def misread_sentence(finding: Finding, log: str, machine: str) -> str:
    """What is wrong with the inputs of a log, or of the logs of one machine, with the line that mends it."""
    # The model file is that of all machines.
    place = " in overrides for these logs (from Python)" if machine and finding.line.startswith("[") else ""
    where = f"the logs of {machine}" if machine else log
    mended = f"Mend it: {finding.line}{place}, and fit again; `covariant check` looks closer"
    return f"In {where} {finding.evidence}. {mended}"


def unlike_servos(
    family: RobotFamily, best: RobotFit, logs: Sequence[Aligned], judging: Sequence[int], left: Float[np.ndarray, "n"]
) -> str:
    """A sentence on joints that do not follow their commands as servos do, by the errors left (n,) in those of the logs
    that judge; or ""."""
    file, circles = logs[0].loaded.file, logs[0].loaded.model.circles
    each = np.square([np.nanstd(scoring.unwrap(np.asarray(log.raw.y, float), circles), axis=0) for log in logs])
    usual, moved = np.sqrt(each.mean(axis=0)), np.sqrt(each[list(judging)].mean(axis=0))
    # A joint that moves less than usual may be held by its friction.
    moves = (moved > LEAST_MOTION * moved.max()) & (moved > LEAST_USUAL * usual)
    wrong = moves & (left > LEAST_FOLLOWED * moved)
    names = [name for name, one in zip(file.columns.q, wrong, strict=True) if one]
    for number, value in zip(family.numbers, best.values, strict=True):
        if (number.group, number.number) == ("servo", "delay") and value > LONGEST_DELAY:
            names.append(file.columns.q[number.joint] if number.joint >= 0 else number.target)
    if not names:
        return ""
    follow = "follows its command" if len(set(names)) == 1 else "follow their commands"
    return (
        f"{', '.join(dict.fromkeys(names))} {follow} as no servo does: look for units, signs and the order of "
        "commands, as `covariant check` does"
    )


def robot_details(best: RobotFit) -> dict[str, Any]:
    """What the log does not determine, in sentences, and which combinations it does."""
    errors, beyond = zip(best.names, best.standard_errors, strict=True), dict(best.beyond)
    unknown = [name for name, error in errors if np.isnan(error) and name not in beyond]
    combinations = best.combinations
    sentences = []
    if best.kept:
        sentences.append(f"the numbers of {', '.join(best.kept)} stay as they are: with others it is predicted worse")
    if unknown:
        shown = "does not show by itself" if len(unknown) == 1 else "does not show by themselves"
        sentences.append(f"this log {shown} {', '.join(unknown)}: the nearest values to the first ones are kept")
    sentences += [f"only the combination {text} is determined" for text in combinations.determined]
    sentences += [
        f"{name} cannot be told from zero by this log: {value:.3g} ± {error:.2g}"
        for name, _, value, error, determined in number_rows(best)
        if np.isfinite(error) and not determined
    ]
    places = any(name.startswith("payload.") and not name.partition("@")[0].endswith(".mass") for name in best.names)
    if places and any(name.startswith("offsets.") for name in best.names):
        sentences.append(MIRRORED)
    return {
        "undetermined": sentences,
        "unlike": list(best.unlike),
        "combinations": list(combinations.determined),
        "redundant": list(combinations.absorbed),
        "rank": combinations.rank,
        "window": float(f"{2 * best.half:.4g}"),
        "residual_torque": [float(f"{size:.4g}") for size in best.torque],
    }


def servo_details(best: RobotFit, family: RobotFamily) -> dict[str, Any]:
    """What the logs do not determine of servos, and how large the residual positions are."""
    details = robot_details(best)
    position = details.pop("residual_torque")
    at = {number.name: i for i, number in enumerate(family.numbers)}
    ratios = [
        number.target
        for number in family.numbers
        if (number.group, number.number) == ("servo", "stiffness")
        and not best.determined[at[number.name]]
        and (f"servo.{number.target}.armature" in at or f"armature.{number.target}" in at)
    ]
    if ratios:
        sentence = (
            f"stiffness and inertia of {', '.join(ratios)} act by their ratio alone where no weight pulls: a second "
            "log with a known mass in the hand separates them, given by overrides of its own, "
            "[{}, {'parameters.payload': {'LINK': [mass, x, y, z]}}]"
        )
        details["undetermined"] = [*details["undetermined"], sentence]
    details["undetermined"] += [
        f"{name} is at least {size:.3g} {family.numbers[at[name]].unit}, the largest of what the logs demand"
        for name, size in best.beyond
    ]
    details["undetermined"] += [
        f"{delay} is hardly told from {damping} (correlation {correlation:.3f}): in slow motion both only make a joint "
        "late. Steps and fast reversals separate them: `covariant design excitation MODEL --parameters "
        f"{delay},{damping} -o excitation.csv`"
        for delay, damping, correlation in best.alike
    ]
    return {**details, "residual_position": position, "open_loop": True}


def number_rows(best: Fit | RobotFit):
    """Name, values before and after, standard error and whether it is determined, of each number."""
    return zip(best.names, best.first, best.values, best.standard_errors, best.determined, strict=True)


def input_details(used: str, stated: bool, gain: Gain | None) -> dict[str, Any]:
    """How inputs were taken to go between stamps, whether the model file says so, and how well the logs show it."""
    return {
        "between": used,
        "stated": stated,
        "log_likelihood_gain": None if gain is None else float(f"{abs(gain.of_linear):.4g}"),
        "gain_standard_error": None if gain is None else float(f"{gain.standard_error:.3g}"),
        "sentence": "" if gain is None else _input_sentence(used, gain),
    }


def _input_sentence(used: str, gain: Gain) -> str:
    other = next(word for word in BETWEEN if word != used)
    size = f"{abs(gain.of_linear):.3g} ± {gain.standard_error:.2g}"
    if not gain.clear:
        return (
            f"Inputs are taken as {used} from one stamp to the next; the log hardly tells that from {other} (the "
            f"log-likelihoods differ by {size})."
        )
    phrase = {"held": "held from one stamp to the next", "linear": "linear between stamps"}[used]
    return f"Inputs {phrase} explain the log better than {other} ones, by {size} in log-likelihood; they are used."
