"""The induction motor in two-phase coordinates fixed to the stator, with linear magnetic circuits.

Source: Marino, Peresada & Valigi 1993, Adaptive input-output linearizing control of induction motors, section II.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from covariant.models._parameters import Parameter, Parametric, check_parameters, values
from covariant.models._state_space import StateSpace
from scalargraph.errors import InputError

_SOURCE = "Marino, Peresada & Valigi 1993"


def induction_motor(
    stator_resistance: float = 0.18,
    rotor_resistance: float = 0.15,
    stator_inductance: float = 0.0699,
    rotor_inductance: float = 0.0699,
    mutual_inductance: float = 0.068,
    inertia: float = 0.0586,
    pole_pairs: int = 1,
    load: float | None = 0.0,
) -> StateSpace:
    """Induction motor with linear magnetic circuits, in two-phase coordinates fixed to the stator.

    The states are the stator currents i [A] and the rotor flux linkages ψ [Wb], each along α and β, and the rotor speed
    ω [rad/s].

    Inputs are the stator voltages [V], and the currents are measured. The two phases are scaled so that `u·i` is the
    electrical power of all three.

    Args:
        stator_resistance: Stator resistance [Ω].
        rotor_resistance: Rotor resistance [Ω].
        stator_inductance: Stator inductance of the two equivalent phases [H].
        rotor_inductance: Rotor inductance of the two equivalent phases [H].
        mutual_inductance: Mutual inductance [H]; its square must be below the product of the other two.
        inertia: Inertia of the rotor [kg m²].
        pole_pairs: Number of pole pairs.
        load: Known constant torque [N m] against positive speed; None for an unknown one, which becomes a sixth
            state.

    Returns:
        The system with five or six states and two inputs.

    Raises:
        ValueError: A parameter other than the load is not positive, or the mutual inductance is too large.

    Example:
        >>> from covariant import models
        >>> models.induction_motor(load=None).coordinates[-2:]
        ('speed', 'load')
    """
    parameters = {
        "stator_resistance": Parameter(stator_resistance, "ohm", _SOURCE),
        "rotor_resistance": Parameter(rotor_resistance, "ohm", _SOURCE),
        "stator_inductance": Parameter(stator_inductance, "H", _SOURCE),
        "rotor_inductance": Parameter(rotor_inductance, "H", _SOURCE),
        "mutual_inductance": Parameter(mutual_inductance, "H", _SOURCE),
        "inertia": Parameter(inertia, "kg m^2", _SOURCE),
        "pole_pairs": Parameter(pole_pairs, "1", _SOURCE),
    } | ({} if load is None else {"load": Parameter(load, "N m", "chosen")})
    check_parameters("induction_motor", parameters, signed=("load",))
    coupling = mutual_inductance / rotor_inductance
    leakage = stator_inductance - coupling * mutual_inductance
    # The magnetic energy is positive definite if and only if M² < Ls Lr; leakage is (Ls Lr − M²)/Lr.
    if leakage <= 0:
        raise InputError(
            f"induction_motor: mutual_inductance {mutual_inductance:g} H must be below the geometric mean of the other "
            f"two, {(stator_inductance * rotor_inductance) ** 0.5:g} H"
        )

    unknown_load = load is None
    return StateSpace(
        Parametric(_f, coupling=coupling, leakage=leakage, **values(parameters)),
        _currents,
        coordinates=("i_alpha", "i_beta", "psi_alpha", "psi_beta", "speed") + ("load",) * unknown_load,
        units=("A", "A", "Wb", "Wb", "rad/s") + ("N m",) * unknown_load,
        outputs=("i_alpha", "i_beta"),
        inputs=2,
        box=((-100.0, 100.0),) * 2 + ((-1.5, 1.5),) * 2 + ((-250.0, 250.0),) + ((-100.0, 100.0),) * unknown_load,
        parameters=parameters,
    )


class _Motor(NamedTuple):
    """The parameters of `induction_motor`, with `coupling` M/L_r and `leakage` L_s − M²/L_r [H]."""

    stator_resistance: Array
    rotor_resistance: Array
    stator_inductance: Array
    rotor_inductance: Array
    mutual_inductance: Array
    inertia: Array
    pole_pairs: Array
    coupling: Array
    leakage: Array
    load: Array | None = None


def _f(t, x, u, **parameters):
    motor = _Motor(**parameters)
    current, flux, speed = x[:2], x[2:4], x[4]
    rotated_flux = jnp.stack([-flux[1], flux[0]])  # by +90°
    # The rotor is short-circuited: the resistive voltage drop of its current (ψ − M i)/Lr drives the flux.
    induced = motor.rotor_resistance / motor.rotor_inductance * (motor.mutual_inductance * current - flux)
    flux_dot = induced + motor.pole_pairs * speed * rotated_flux
    # Faraday's law in the stator, u = Rs i + (leakage i + coupling ψ)', solved for i'.
    current_dot = (u - motor.stator_resistance * current - motor.coupling * flux_dot) / motor.leakage
    # There is no factor 3/2, as the two phases are scaled so that u·i is the power of all three.
    torque = motor.pole_pairs * motor.coupling * (rotated_flux @ current)
    resisting = x[5] if motor.load is None else motor.load
    load_dot = jnp.zeros_like(x[5:])
    return jnp.concatenate([current_dot, flux_dot, ((torque - resisting) / motor.inertia)[None], load_dot])


def _currents(t, x, u):
    return x[:2]
