"""Defines what a certificate of convergence from all first errors says: its numbers, its file, its statement.

Let x_i = (ω_i e_i, ζ_i) be the error of coordinate i after a sample, in `|x|² = Σ x_iᵀP_i x_i/w_i²`. With the gain
matrices P_i of `_channel`, γ = 1/R at the rate μ, and the coupling of `_coupling` below R, `|d/ω|_W ≤ R|ζ|_W` gives for
exact measurements `|x⁺| ≤ e^(−μτ)|x|` after every sample, whatever |x| is: the quadratic forms of the coordinates,
divided by w_i², are added, and their supplies `τ Σ (γ²d_i²/ω_i² − ζ_i²)/w_i²` are ≤ 0 together.

What is added to the acceleration, at most D_i, and what the acceleration changes within a sample, at most J_i in a
second, move x by at most `τ(|f| + |l|)D/2` and `τ² max(|f|, |l|)J/2`, with f and l the changes by an acceleration at
the beginning and at the end of the sample: between them the change is linear. Errors n_i of the measurement move it by
|(k₁, k₂/ω)| ω n. With c the norm of these sums,

    |x| ≤ e^(−μt)|x₀| + r,   r = sup c(τ)/(1 − e^(−μτ)),   |ζ_i| ≤ w_i √(P_i⁻¹)₂₂ |x|.

Source: an addition. Desoer & Vidyasagar 1975, Feedback systems, for small gains; Jiang, Teel & Praly 1994, Small-gain
theorem for ISS systems, Math. Control Signals Systems 7, for bounded disturbances.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant.certificates.base import (
    MOST_LOST,
    Hypothesis,
    Statement,
    need_joint_friction,
    need_known,
    read_fields,
    read_interval,
    read_metric,
    read_recipe,
    rounded_down,
    rounded_up,
    write,
)
from covariant.certificates.everywhere._channel import Channel
from covariant.models import MechanicalSystem, recipe_text
from scalargraph import enclose, lower
from scalargraph.errors import InputError
from scalargraph.proofs import LETTERS, digest, parse_file, read_file, saved_levels

FORMAT = "covariant certificate of all first errors 1"
MOST_JOINTS = len(LETTERS)
DISTURBING = {
    "noise": "unit of noise",
    "acceleration": "unit/s² of unknown acceleration",
    "jerk": "unit/s³ of jerk",
}
"""What leaves an error in the end."""
CELLS = 64
"""Parts of an interval of ages on which the disturbances are bounded."""
POSITIVE = ("velocity", "alpha", "beta", "weights")
NOT_NEGATIVE = ("viscous", "dry", "noise", "disturbance", "jerk", "acceleration")
ASSUMED = (
    "the true motion solves the model, with the input that the observer is given and up to the stated unknown force, "
    "and keeps to the configurations and to the bounds of velocities",
    "within a sample, the acceleration that the model has at the true motion changes by no more than the stated jerk, "
    "beside jumps of the input between samples",
    "measurements are of all coordinates, unless a sample is lost, exact up to the stated noise, and come at the "
    "stated times; what their noise changes in the acceleration of the model counts as unknown force",
    "the code of the model is read as exact functions of real numbers, with its constants as they were computed",
    "the running observer does not round",
    "trusted are JAX's tracing, the reading of its jaxprs, IEEE doubles in NumPy, and what is argued on paper: that "
    "gains below 1 in a loop compose, and the reduction of a sample to its channel",
)


class GlobalDocument(NamedTuple):
    """The numbers of a certificate of convergence from all first errors, for n coordinates.

    Attributes:
        recipe: recipe of the model; None for one that was given as an object.
        low, high: box (n,) of the measured configurations, at which the observer evaluates the model.
        velocity: bounds V (n,) of the true speeds, to which the observer clips.
        alpha, beta: gains (n,).
        weights: W (n,).
        viscous: F (n,).
        dry: bounds (n,) of how much more than F times their distance friction differs between two velocities.
        noise: bounds (n,) of the errors of measurements.
        disturbance: bounds (n,) of unknown forces.
        jerk: bounds (n,) of the change of the acceleration within a sample, per second.
        acceleration: proved bounds D (n,) of the acceleration by `dry` and `disturbance`.
        interval: shortest and longest time (2,) between samples [s].
        lost: samples that may be lost in a row.
        rate: μ [1/s].
        coupling: R, the proved bound of the coupling.
        metrics: P (n, 2, 2).
        levels: tree of boxes on which R and D are proved.
    """

    recipe: dict[str, Any] | None
    low: Float[np.ndarray, "n"]
    high: Float[np.ndarray, "n"]
    velocity: Float[np.ndarray, "n"]
    alpha: Float[np.ndarray, "n"]
    beta: Float[np.ndarray, "n"]
    weights: Float[np.ndarray, "n"]
    viscous: Float[np.ndarray, "n"]
    dry: Float[np.ndarray, "n"]
    noise: Float[np.ndarray, "n"]
    disturbance: Float[np.ndarray, "n"]
    jerk: Float[np.ndarray, "n"]
    acceleration: Float[np.ndarray, "n"]
    interval: Float[np.ndarray, "2"]
    lost: int
    rate: float
    coupling: float
    metrics: Float[np.ndarray, "n 2 2"]
    levels: tuple[str, ...]

    @property
    def omega(self) -> Float[np.ndarray, "n"]:
        """ω (n,) [1/s]."""
        return np.sqrt(self.beta)

    @property
    def force(self) -> Float[np.ndarray, "n"]:
        """Bounds (n,) of all forces that are unknown."""
        return self.dry + self.disturbance

    def scaled(self, coupling: Any) -> Any:
        """B = diag(1/ω) W⁻¹ N W (..., n, n) of a coupling N."""
        return coupling * self.weights / (self.weights * self.omega)[:, None]

    @property
    def square(self) -> float:
        """γ², rounded down: a little less than 1/R²."""
        return (1 - 1e-12) / self.coupling**2

    @property
    def ages(self) -> Float[np.ndarray, "p 2"]:
        """Least and largest age of a measurement at the next one, for each number of samples lost between them."""
        counts = np.arange(1.0, self.lost + 2)[:, None]
        return counts * self.interval * [1 - 1e-9, 1 + 1e-9]  # stamps are rounded

    def radius(self) -> float:
        """r, an upper bound of |x| in the end."""
        n, d, j = self.noise, self.acceleration, self.jerk
        if not np.any([n, d, j]):
            return 0.0

        def ratio(tau):
            square = 0.0
            for i, omega in enumerate(self.omega.tolist()):
                channel, p = Channel.of(self.alpha[i], self.beta[i], tau), self.metrics[i]
                first, last, moved = (jnp.sqrt(x @ p @ x) for x in (channel.first, channel.last, channel.noise))
                moved = moved * omega * n[i] + tau * (first + last) / 2 * d[i]
                moved = moved + tau * tau * jnp.maximum(first, last) / 2 * j[i]
                square = square + (moved / self.weights[i]) ** 2
            return jnp.sqrt(square) / -jnp.expm1(-self.rate * tau)

        lowered = lower(ratio, jnp.zeros(()), real=True)._replace(conditions=None)
        ends = np.concatenate([np.linspace(first, last, CELLS + 1) for first, last in self.ages]).reshape(-1, CELLS + 1)
        found = enclose(lowered, ends[:, :-1].reshape(-1, 1), ends[:, 1:].reshape(-1, 1))
        return math.inf if not np.isfinite(found.high).all() else float(found.high.max())

    @property
    def reach(self) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Bounds (n,) of the errors of position and of velocity where |x| = 1."""
        inverse = np.linalg.inv(self.metrics)
        unit = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)) * self.weights[:, None] * (1 + 1e-9)
        return unit[:, 0] / self.omega, unit[:, 1]

    def document(self) -> dict[str, Any]:
        """Data for the file."""
        content = {"format": FORMAT, **self._asdict(), "levels": list(self.levels)}
        content = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in content.items()}
        return content | {"digest": digest(content)}

    def save(self, path: str | Path) -> Path:
        """Write the file."""
        if self.recipe is None:
            raise InputError("a certificate is saved with its model; give certify_globally(..., recipe=...)")
        return write(Path(path), self.document(), read=read_document)


def read_document(path: str | Path, content: bytes | None = None) -> GlobalDocument | None:
    """Read a file, and check its types and sizes; None for a certificate of another kind."""
    top = parse_file(path, read_file(path) if content is None else content)
    if not isinstance(top.value, dict) or top.value.get("format") != FORMAT:
        return None
    fields = read_fields(top, ["format", *GlobalDocument._fields, "digest"])
    n = len(fields["low"].vector(1, MOST_JOINTS))
    numbers: dict[str, Any] = {key: fields[key].vector(n, n) for key in ("low", "high", *POSITIVE)}
    numbers |= {key: fields[key].vector(n, n, least=0.0) for key in NOT_NEGATIVE}
    for key in POSITIVE:
        fields[key].need((numbers[key] > 0).all(), "positive numbers")
    fields["high"].need((numbers["low"] <= numbers["high"]).all(), "no less than low")
    numbers |= {key: fields[key].positive() for key in ("rate", "coupling")}
    numbers |= {"interval": read_interval(fields["interval"]), "lost": fields["lost"].whole(0, MOST_LOST)}
    numbers["metrics"] = np.stack([read_metric(row) for row in fields["metrics"].rows(n, n)])
    numbers["levels"] = saved_levels(fields["levels"], n)
    return GlobalDocument(recipe=read_recipe(fields["recipe"]), **numbers)


def need_covered(model: MechanicalSystem) -> None:
    """Refuse models that the statement does not cover."""
    need_known(model)
    if not model.manifold.commuting:
        raise InputError("certify_globally needs a model in coordinates; on a group there are no differences of them")
    need_joint_friction(model)


def statement_of(
    document: GlobalDocument, model: MechanicalSystem, hypotheses: tuple[Hypothesis, ...], proved: bool
) -> Statement:
    """The statement that follows from the numbers of a document."""
    n, units = len(model.coordinates), model.units or ("",) * len(model.coordinates)
    bounds = zip(model.coordinates, document.low, document.high, units, strict=True)
    position, velocity = document.reach
    stated = {key: value.tolist() for key, value in document._asdict().items() if isinstance(value, np.ndarray)}
    lines = [
        f"model: {'one that was given as an object' if document.recipe is None else recipe_text(document.recipe)}",
        "observer: measured-coefficients, speed = {velocity}, alpha = {alpha} 1/s, beta = {beta} 1/s²".format(**stated),
        f"samples {' to '.join(map(repr, dict.fromkeys(stated['interval'])))} s apart, of which at most {document.lost}"
        " in a row are lost, as rows or without them",
        "measured configurations: "
        + ", ".join(f"{low:.4g} ≤ {name} ≤ {high:.4g} {unit}".rstrip() for name, low, high, unit in bounds),
        "true velocities up to {velocity}".format(**stated),
        "friction: between velocities it differs by up to {viscous} times their distance, and {dry}".format(**stated),
        "noise of measurements up to {noise}, unknown forces up to {disturbance}, together accelerations up to "
        "{}; jerk up to {jerk}".format(_rounded(document.acceleration), **stated),
    ]
    claim = "from every first error of positions and velocities, the error of the estimate falls"
    claim += f" at {rounded_down(document.rate)} 1/s or faster" if document.rate else ""
    if proved:
        radius, none = document.radius(), document._replace(**dict.fromkeys(DISTURBING, np.zeros(n)))
        lines += [
            f"an error of the norm 1 is at most {_rounded(position)} of the positions and {_rounded(velocity)} of the "
            "velocities; weights {weights}, P {metrics}".format(**stated),
            *(
                f"each {what} in every coordinate leaves velocities off by at most "
                f"{_rounded(velocity * none._replace(**{key: np.ones(n)}).radius())}"
                for key, what in DISTURBING.items()
            ),
        ]
        claim += f", to within {_rounded(velocity * radius)} of the velocities" if radius else ""
    assumed = tuple(Hypothesis(text, "assumed") for text in ASSUMED)
    return Statement(claim, tuple(lines), (*hypotheses, *assumed), document.rate)


def _rounded(values: np.ndarray) -> str:
    """Numbers rounded up to four digits."""
    return f"[{', '.join(rounded_up(x) for x in values.tolist())}]"
