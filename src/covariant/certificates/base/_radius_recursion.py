"""Bounds the error of an estimate from sample to sample by a recursion, under measurement errors and unknown forces.

Let r be the distance after a measurement. Between samples lengths shrink at the rate μ, and an unknown force adds at
most W per second. The distance at the age h of the measurement is therefore at most

    a = e^(−μh) r + (1 − e^(−μh)) W/μ + hE

where E covers the errors of the prediction's Runge–Kutta steps. By the claim "prediction" of order k, the defect
after a step of length s is at most s^k √square, and its integral over the step at most s^(k+1) √square/(k+1). Hence
`E = σ^k √square/(k+1)` with the longest step σ.
The correction by a measurement with an error then leads to at most `√(a² + G) + hD(a + β)`. G is proved with the
correction, as the sum of the diagonal of Γ. The last term accounts for the factor 1/(1 + s/18) of the correction that
runs, see `Loss`. There |ξ| is at most `limit (a + β)`: a position error within `reach a` has at most the length
`limit a`, and so the errors b of the measurement have at most `limit β`, with β² the mean of (b_i/reach_i)².

Why G is added: a curve γ(s), 0 ≤ s ≤ 1, of constant speed a joins truth x and estimate. The curve C(γ(s); q + s b),
where q is the true position, joins x, a fixed point of the exact correction, with the new estimate. Its speed is
`|J γ' + B b|`, whose square is at most `a² + Σ Γ_i b_i²` where `[J B]ᵀM_0[J B] ≤ diag(M_h, Γ)`. Likewise for W: along
solutions under the force `u + (1 − s) w` speeds obey `|γ'|' ≤ −μ|γ'| + |B w|`.

Source: Lohmiller & Slotine 1998, section 3.7, for W; G is an S-procedure for the linear map of a variation and an
error.
"""

import math
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from covariant.certificates.base._box import Given
from covariant.certificates.base._claims import (
    AbstractClaim,
    CorrectionClaim,
    DisturbanceClaim,
    MissingClaim,
    PredictionClaim,
    reach_squares,
    select,
)
from covariant.certificates.base._sampling import Loss, Sampling, unit_reach
from covariant.certificates.base._tangent_metric import TwoByTwo

ROUND = 1e-12
"""Relative margin for the rounding of the formulas here."""
BISECTIONS = 100
"""Number of bisections in the computation of the steady radius."""


class Recursion(NamedTuple):
    """The numbers of the recursion.

    Attributes:
        decay: μ [1/s].
        force: W [1/s].
        noise: G, for each number of samples (p,) lost before a measurement.
        change: D [1/s].
        steps: E [1/s].
        error: β.
        ages: least and largest ages [s] of a measurement (p, 2).

    Example:
        >>> import numpy as np
        >>> from covariant.certificates.base._radius_recursion import Recursion
        >>> recursion = Recursion(2.0, 0.1, (1e-4,), 0.0, 0.0, 0.0, np.array([[0.01, 0.02]]))
        >>> round(recursion.predicted(1.0, 0.0), 9), round(recursion.steady, 4)
        (1.0, 0.0812)
    """

    decay: float
    force: float
    noise: tuple[float, ...]
    change: float
    steps: float
    error: float
    ages: np.ndarray

    @classmethod
    def of(
        cls, sampling: Sampling, q: TwoByTwo, rate: float, given: Given | None, claims: Sequence[AbstractClaim]
    ) -> "Recursion":
        """Collect the numbers from the proved claims."""
        noise, force = (np.zeros(1),) * 2 if given is None else (given.noise, given.disturbance)
        missing = select(claims, MissingClaim)
        loss = Loss(0.0, 0.0) if not missing else Loss.of(sampling, q, rate, missing[0].square, missing[0].limit)
        reach = unit_reach(reach_squares(claims))
        error = math.sqrt(float(np.mean((noise / reach) ** 2))) if missing else 0.0
        steps = next((c.defect(sampling.longest_step) for c in select(claims, PredictionClaim)), 0.0)
        # Forces within their bounds lie in a ball of radius √count, relative to the bounds.
        square = next((c.square for c in select(claims, DisturbanceClaim)), 0.0)
        return cls(
            rate / 2,
            math.sqrt(np.count_nonzero(force) * square) * (1 + ROUND),
            tuple(math.fsum(c.squares) * (1 + ROUND) for c in select(claims, CorrectionClaim)),
            loss.change,
            steps * (1 + ROUND),
            error * (1 + ROUND),
            sampling.ages,
        )

    def predicted(self, radius: Any, age: Any, numpy: ModuleType = math) -> Any:
        """Bound the distance before a correction."""
        shrunk, added = numpy.exp(-self.decay * age), -numpy.expm1(-self.decay * age) * self.force / self.decay
        return (shrunk * radius + added + age * self.steps) * (1 + ROUND)

    def largest(self, radius: float) -> float:
        """Bound the distances after a correction, at all possible ages, if the distance before was at most a radius."""

        def corrected(added: float, age: float) -> float:
            # With `radius` in place of a in the last term, the bound is convex in the age, since a is convex and enters
            # through an increasing convex function. So its maximum lies at an end of the interval of ages.
            part = self.change * age * (radius + self.error)
            return (math.sqrt(self.predicted(radius, age) ** 2 + added) + part) * (1 + ROUND)

        ends = zip(self.noise, self.ages.tolist(), strict=False)
        return max(corrected(added, age) for added, both in ends for age in both)

    def keeps(self, radius: float) -> bool:
        """Whether distances up to a radius stay below it, between samples and at them."""
        # Between samples the bound is convex in the age, so that it is largest at an end.
        oldest = float(np.max(self.ages))
        return self.predicted(radius, oldest) < radius and self.largest(radius) < radius

    @property
    def disturbed(self) -> bool:
        """Whether noise, forces or step errors add anything."""
        return self.force > 0 or self.steps > 0 or any(self.noise)

    @property
    def steady(self) -> float:
        """An upper bound of the distance that remains in the end; 0 without disturbances, ∞ if nothing bounds it.

        The recursion converges to below it at the rate of the certificate: its slope in r is at most `e^(−μh) + hD`.
        """
        if not self.disturbed:
            return 0.0
        # The recursion does not grow at such distances; the upper end of the bisection always has this property.
        high = 1.0
        while not self.keeps(high):
            high *= 2
            if high > 1e30:
                return math.inf
        low = 0.0
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            low, high = (low, middle) if self.keeps(middle) else (middle, high)
        return high
