"""How far the exact observer (2) is from its approximation (5), and what this takes from the rate of (5).

Let c be the shortest geodesic from the measurement q to the estimate q̂, d its length, and e = q̂ − q in coordinates.
Where f₅ contracts at λ/2 in the metric G of Q on states, the truth solves (5), and the first variation of the distance
at the end of the estimate is `D⁺d_G ≤ −(λ/2) d_G + |f₂ − f₅|_G`. In the frame (ξ, ζ) the difference is (−αρ, δ − βρ):

    ρ = ξ − e = −∫ s Γ(c', c') ds
    δ = T S − (S − Γ(e, S)) + R(ξ, v̂)v̂ − R(q)(e, v̂)v̂
      = ∫ (1−s)[Γ(Γ(c', c'), W) + Γ(c', Γ(c', W)) − (∂Γ)(c', c', W) − Γ(q)(Γ(c', c'), S) + R(q)(Γ(c', c'), v̂)v̂] ds
        + ∫ (∂R)(c', c', v̂)v̂ − R(Γ(c', c'), v̂)v̂ ds

with W parallel along c, from c'' = −Γ(c', c') and W' = −Γ(c', W). Lengths of c' and W are constant along c, and with
K ≥ |Γ| that of constant components changes by E = e^(Kd) at most, since ∂_u<w, w> = 2<Γ(u, w), w>. With the bounds
K, K', S, R, R' of the claims on remainders hence

    |f₂ − f₅|_G ≤ L₂ d²,  L₂ = E²[½K √½(aα² + 2cαβ + bβ²) + √(b/2) (½S(K' + 3K²) + R' + (3/2)KR)].

The frame makes G(ξ, ζ) ≥ (det Q/2b)|ξ|², so that d ≤ √(2b/det Q) d_G.

Two geodesics from q to q̂ that are no longer than d differ by w, w(0) = w(1) = 0, with |w''| ≤ F⁴E⁴(K'd²|w| + 2Kd|w'|),
where F = 1/(1 − KdE) bounds how lengths change along the chords between them. As 4|w| ≤ 2 max|w'| ≤ max|w''|, there
is one only where F⁴E⁴(K'd²/4 + Kd) < 1.
Source: Aghannan & Rouchon 2003, equations (2), (5) and Theorem 1; Lohmiller & Slotine 1998, section 3.7.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.certificates.base._claims import AbstractClaim, RemainderClaim, select

ROUND = 1e-6
"""Relative margin that covers rounding."""


class Remainder(NamedTuple):
    """What the exact observer loses against its approximation within a radius.

    Attributes:
        rate: largest loss `L₂ d²/d_G` [1/s] of the decay rate of distances; infinite where two geodesics of this length
            may lead to the measurement.
        distance: largest length d of the geodesic to the measurement, in the metric on configurations.
    """

    rate: float = 0.0
    distance: float = 0.0

    @classmethod
    def of(
        cls, gains: tuple[float, float], q: Float[np.ndarray, "2 2"], claims: Sequence[AbstractClaim], radius: float
    ) -> "Remainder":
        """Compute it from the claims on remainders; nothing is lost where there are none."""
        bounds = [math.sqrt(claim.square) for claim in select(claims, RemainderClaim)]
        if not bounds or not radius:
            return cls()
        (k, k1, s, r, r1), (a, c, b) = bounds, (q[0, 0], q[0, 1], q[1, 1])
        distance = math.sqrt(2 * b / (a * b - c * c)) * radius * (1 + ROUND)
        stretch = math.exp(min(k * distance, 1.0))
        chords = stretch / max(1 - k * distance * stretch, 1e-3)
        if chords**4 * (k1 * distance**2 / 4 + k * distance) >= 1:
            return cls(math.inf, distance)
        of_acceleration = s * (k1 + 3 * k * k) / 2 + r1 + 1.5 * k * r
        largest = stretch**2 * (k * gain_length(gains, q) / 2 + math.sqrt(b / 2) * of_acceleration)
        return cls(float(largest * distance**2 / radius * (1 + ROUND)), float(distance))


def gain_length(gains: tuple[float, float], q: Float[np.ndarray, "2 2"]) -> float:
    """Compute the length `√½(aα² + 2cαβ + bβ²)` that an error of the logarithm of length 1 adds to the flow."""
    both = np.array(gains, float)
    return math.sqrt(both @ q @ both / 2)
