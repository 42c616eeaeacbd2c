"""Checks Theorem 3 of Jouffroy & Fossen 2004 for ODIN: exponential stability of the controller with the observer."""

import numpy as np

from covariant.certificates import CascadeCertificate, cascade, crossed_metric, feedthrough, tracking, virtual
from covariant.models import marine, state_space
from covariant.papers.jouffroy_fossen._odin import CROSS, K2, KD, KP, LAMBDA, odin_box, odin_controller, odin_observer
from scalargraph.proofs import Box, box


def closed_form() -> dict[str, float]:
    """The constants of ODIN's controller that follow from its diagonal matrices, by (91) and (92)."""
    weights = np.append(np.diag(marine.odin().mass), KP)  # of V_con = ½(sᵀMs + η̃ᵀK_pη̃)
    return {
        "c1": weights.min() / 2,
        "c2": weights.max() / 2,
        "c3": min(KP * LAMBDA, KD),  # drag vanishes at rest
        "c4": weights.max(),
    }


def odin_cascade(
    pitch: float = 0.5, attempts: int = 20_000, starts: int = 64, proved: bool = False, units: bool = True
) -> CascadeCertificate:
    """Check Theorem 3 for ODIN over attitudes up to `pitch` in roll and pitch and the velocities of `odin_box`.

    Args:
        pitch: Bound of roll and pitch [rad].
        attempts: Number of random points at which the constants are sampled.
        starts: Number of the worst of these points from which a descent starts.
        proved: Whether every constant is proved instead of sampled.
        units: Whether condition (72) is also tried in other units.

    Returns:
        The certificate of the cascade.
    """
    controller = odin_controller()
    plant = tracking(controller)
    high = [0.0, 0.0, 0.0, pitch, pitch, 0.0] + [0.0] * 6 + [0.5] * 3 + [0.3] * 3
    plant_box = Box(plant.names, plant.units, -np.array(high), np.array(high))
    craft = controller.craft
    heavy = crossed_metric(craft, K2, CROSS)
    mass = float(craft.mass[0, 0])
    error_system = virtual(odin_observer(), lambda z, x: heavy(z, x) / mass)  # V_obs per unit of mass
    tilts: dict[str, tuple[float, float]] = dict.fromkeys(("coupling_roll", "coupling_pitch"), (-pitch, pitch))
    names = [f"{kind}_{name}" for kind in ("coupling", "asked") for name in craft.coordinates]
    coupling_box = box(**{name: tilts.get(name, (0.0, 0.0)) for name in names})
    both = state_space(craft).units
    return cascade(
        (plant, plant_box),
        (error_system, odin_box(pitch=pitch, roll=pitch)),
        (feedthrough(controller), coupling_box),
        units=(both, both) if units else None,
        attempts=attempts,
        starts=starts,
        proved=proved,
    )
