"""Models servos: motors with a position controller, a gear and friction, whose input is a commanded position.

At rest, their torque depends on the measured position and on time only, which the force S(q, t) of Aghannan & Rouchon
2003, section II, allows. The part that depends on the speed belongs to the dissipation.

Source: Duclusaud et al. 2025, Extended Friction Models for the Physics Simulation of Servo Actuators, section III, for
the controller behind a limited voltage, and for friction that depends on the load of the gear.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._names import refuse_unknown
from covariant._typing import Number
from covariant.models._mechanical import MechanicalSystem
from covariant.models._parameters import ANY_SIGN, POSITIVE, ZERO_OR_MORE, check_range, known
from covariant.models._state_space import StateSpace
from covariant.models.robots._axes import Axis, Freedom
from covariant.models.robots._description import Description, FrictionLaw, Joint, Motor, Servo, numbers
from scalargraph.errors import InputError

FLAGS = ("switch", "logged_supply")
"""Keys of a servo table that are true or false."""
OF_SERVO = tuple(field for field in Servo._fields if field not in (*FLAGS, "command_scale"))
"""Keys of a servo table that are numbers of the servo."""
OF_GEAR = (*FrictionLaw._fields, "armature")
"""Keys of a servo table that are numbers of the gear; the joint has them."""
_RANGES: dict[Any, float] = {
    **dict.fromkeys(("stiffness", "gain", "limit", "pwm_limit"), POSITIVE),
    **dict.fromkeys(("supply", "resistance", "torque_constant", "stribeck_velocity", "smoothing"), POSITIVE),
    **dict.fromkeys(("offset", "feedforward", "asymmetry"), ANY_SIGN),
}
_ABOVE_ZERO, _SIGNED = ("stribeck_velocity", "smoothing"), ("asymmetry",)
_DRIVE = ("supply", "resistance", "torque_constant")


class Servos(Functional):
    """The servos of a robot as one function of positions, rates and inputs.

    Attributes:
        rows: Rate of each servo (k, n) per rate of each coordinate.
        zero: Position (k,) of each servo where all coordinates are zero [rad or m].
        commands: Commanded position (k, m) per unit of each input.
        stiffness: Torque (k,) per unit of the command's error [N m/rad or N/m].
        offset: Position (k,) that is added to each command [rad or m].
        damping: Damping (k,) within the limit [N m s/rad or N s/m].
        dead_band: Error (k,) up to which a servo has no torque [rad or m].
        limit: Largest torque (k,) [N m or N]; infinite without a limit.
        back_emf: Damping (k,) that the limit does not clip, while a servo is on [N m s/rad or N s/m].
        supply: Voltage (k,) at which stiffness and limit hold [V].
        load: Dry friction (k,) per unit of the motor's torque [1].
        load_external: Dry friction (k,) per unit of the weight's torque on the joint [1].
        smoothing: Speed (k,) over which dry friction rises to its size [rad/s or m/s].
        delay: Time (m,) from the stamp of each input until it acts [s].
        lead: Time (m,) [s]; each input has its rate, multiplied by this time, added.
        switches: Index of the input that switches each servo; −1 for one that is always on.
        volts: Index of the input that is the voltage of each servo; −1 if the voltage is constant.
        circles: Whether the position of each servo is an angle on a full circle.
        limited: Whether any torque is limited.
        banded: Whether any servo has a dead band.
        loaded: Whether any friction depends on the torque of a motor.
        weighted: Whether any friction depends on the weight.
        input_names: Names of the m inputs.
        input_units: Units of the m inputs.
    """

    rows: Float[Array, "k n"]
    zero: Float[Array, "k"]
    commands: Float[Array, "k m"]
    stiffness: Float[Array, "k"]
    offset: Float[Array, "k"]
    damping: Float[Array, "k"]
    dead_band: Float[Array, "k"]
    limit: Float[Array, "k"]
    back_emf: Float[Array, "k"]
    supply: Float[Array, "k"]
    load: Float[Array, "k"]
    load_external: Float[Array, "k"]
    smoothing: Float[Array, "k"]
    delay: Float[Array, "m"]
    lead: Float[Array, "m"]
    switches: tuple[int, ...] = eqx.field(static=True)
    volts: tuple[int, ...] = eqx.field(static=True)
    circles: tuple[bool, ...] = eqx.field(static=True)
    limited: bool = eqx.field(static=True)
    banded: bool = eqx.field(static=True)
    loaded: bool = eqx.field(static=True)
    weighted: bool = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    input_units: tuple[str, ...] = eqx.field(static=True)

    def torque(self, q: Float[Array, "n"], v: Float[Array, "n"], u: Float[Array, "m"]) -> Float[Array, "k"]:
        """Torques of the servos (k,) at joint coordinates q and rates v, with inputs u."""
        rate = self.rows @ v
        error = self.commands @ u + self.offset - self.rows @ q - self.zero
        if any(self.circles):
            error = error - jnp.where(np.array(self.circles), 2 * np.pi * jnp.round(error / (2 * np.pi)), 0.0)
        if self.banded:
            error = error - jnp.clip(error, -self.dead_band, self.dead_band)
        supply_ratio = _input_ratio(u, self.volts, self.supply)
        controller_torque = supply_ratio * self.stiffness * error - self.damping * rate
        if self.limited:
            controller_torque = jnp.clip(controller_torque, -supply_ratio * self.limit, supply_ratio * self.limit)
        return _input_ratio(u, self.switches, jnp.ones_like(rate)) * (controller_torque - self.back_emf * rate)

    def added_friction(self, torque: Float[Array, "k"], weight: Float[Array, "k"]) -> Float[Array, "k"]:
        """Dry friction (k,) caused by the load, the torques of the motors and of the weight at the servos."""
        return jnp.abs(self.load_external * weight - self.load * torque)

    def cast(self, dtype: np.dtype) -> "Servos":
        """The servos with numbers of another type, so that a single-precision state keeps its precision."""
        return jax.tree.map(lambda leaf: leaf.astype(dtype), self)


def _input_ratio(u: Array, places: tuple[int, ...], usual: Array) -> Array:
    """Inputs at these indices, divided by their nominal values; 1 where an index is −1."""
    if all(place < 0 for place in places):
        return jnp.ones_like(usual)
    return jnp.where(np.array(places) < 0, 1.0, u[np.array(places)] / usual)


class ServoForce(Functional):
    """Generalised force of torque-controlled motors, and of servos at zero speed.

    Attributes:
        servos: The servos.
        motors: Generalised force (n, m) per unit of each input that is a torque.
        base: Zeros (b,), for the velocities of a floating base.
    """

    servos: Servos
    motors: Float[Array, "n m"]
    base: Float[Array, "b"]

    def __call__(self, t: Number, q: Array, u: Array) -> Array:
        servos, (motors, base) = self.servos.cast(u.dtype), (part.astype(u.dtype) for part in (self.motors, self.base))
        joints = _last(q, servos.rows.shape[1])
        torque = servos.rows.T @ servos.torque(joints, jnp.zeros_like(joints), u)
        balls = jnp.zeros(motors.shape[0] - torque.shape[0], u.dtype)
        return jnp.concatenate([base, motors @ u + jnp.concatenate([balls, torque])])


class ServoDissipation(Functional):
    """Part of the servo torques that depends on the speed, and the friction of all joints.

    Attributes:
        servos: The servos.
        friction: Friction of the joints without the part that depends on the load, `(q, v) -> (n,)`.
        potential: Potential energy of the robot; its gradient gives the torque of the weight.
    """

    servos: Servos
    friction: Callable[[Array, Array], Array]
    potential: Callable[[Array], Array]

    def __call__(self, t: Number, q: Array, v: Array, u: Array) -> Array:
        servos = self.servos.cast(v.dtype)
        n = servos.rows.shape[1]
        joints, rates = _last(q, n), _last(v, n)
        torque = servos.torque(joints, rates, u)
        damping_torque = torque - servos.torque(joints, jnp.zeros_like(rates), u)
        if servos.loaded:
            weight = jnp.zeros_like(torque)
            if servos.weighted:
                # A servo drives one coordinate with the ratio in its row, so the weight at the servo is torque / ratio.
                slope = jax.grad(self.potential)(q)
                weight = -servos.rows @ _last(slope, n) / jnp.sum(servos.rows**2, axis=1)
            sign = jnp.tanh(servos.rows @ rates / servos.smoothing)
            damping_torque = damping_torque - servos.added_friction(torque, weight) * sign
        without_servo = jnp.zeros(v.shape[0] - n, v.dtype)
        return self.friction(q, v) + jnp.concatenate([without_servo, servos.rows.T @ damping_torque])


class ServoDamping(Functional):
    """`ServoDissipation` of servos whose dissipation is linear in the speed, and so independent of their inputs.

    Attributes:
        servos: The servos.
        friction: Friction of the joints, `(q, v) -> (n,)`.
    """

    servos: Servos
    friction: Callable[[Array, Array], Array]

    def __call__(self, q: Array, v: Array) -> Array:
        servos = self.servos.cast(v.dtype)
        n = servos.rows.shape[1]
        damping_torque = servos.rows.T @ ((servos.damping + servos.back_emf) * (servos.rows @ _last(v, n)))
        return self.friction(q, v) - jnp.concatenate([jnp.zeros(v.shape[0] - n, v.dtype), damping_torque])


def loss(servos: Servos, friction: Any, potential: Any) -> ServoDamping | ServoDissipation:
    """The dissipation of a robot from its servos and the friction of its joints, linear where possible."""
    linear = not servos.limited and not servos.loaded and all(place < 0 for place in servos.switches)
    return ServoDamping(servos, friction) if linear else ServoDissipation(servos, friction, potential)


def _last(values: Array, n: int) -> Array:
    return values[values.shape[0] - n :]


class Driven(NamedTuple):
    """An input of a robot: a torque, or the command of a servo.

    Attributes:
        axis: Index of the axis that it drives.
        servo: The servo; None for a torque.
        named: Whether the input is named after its joint, and not u1, u2, ….
    """

    axis: int
    servo: Servo | None
    named: bool = False


def servos_of(axes: Sequence[Axis], freedom: Freedom, inputs: Sequence[Driven]) -> Servos | None:
    """The servos among the inputs of a robot; None if all inputs are torques."""
    chosen = [(i, each.axis, each.servo) for i, each in enumerate(inputs) if each.servo is not None]
    if not chosen:
        return None
    names = [f"cmd_{axes[each.axis].name}" if each.named else f"u{i + 1}" for i, each in enumerate(inputs)]
    units = ["" if each.servo is None else "rad" if axes[each.axis].turn.any() else "m" for each in inputs]
    switches, volts = [], []
    for flag, places, name, unit in (("switch", switches, "on", "1"), ("logged_supply", volts, "volts", "V")):
        for _, axis, servo in chosen:
            places.append(len(names) if getattr(servo, flag) else -1)
            if getattr(servo, flag):
                names.append(f"{name}_{axes[axis].name}")
                units.append(unit)
    own, at = [servo for _, _, servo in chosen], [axis for _, axis, _ in chosen]
    laws = [axes[axis].joint.law or FrictionLaw() for axis in at]
    limits = [drive_limit(servo) for servo in own]
    commands = np.zeros((len(own), len(names)))
    commands[np.arange(len(own)), [i for i, _, _ in chosen]] = [servo.command_scale for servo in own]

    def column(values: Iterable[Number]) -> Array:
        return jnp.asarray(numbers(values))

    def of_inputs(values: dict[int, Number]) -> Array:
        return column(values.get(i, 0.0) for i in range(len(names)))

    return Servos(
        rows=jnp.asarray(freedom.matrix[np.ix_(at, range(len(freedom.balls), freedom.matrix.shape[1]))]),
        zero=jnp.asarray(freedom.offset[at]),
        commands=jnp.asarray(commands),
        stiffness=column(servo.gain * servo.stiffness for servo in own),
        offset=column(servo.offset for servo in own),
        damping=column(servo.damping for servo in own),
        dead_band=column(servo.dead_band for servo in own),
        limit=column(limit for limit, _ in limits),
        back_emf=column(back_emf for _, back_emf in limits),
        supply=column(servo.supply if servo.logged_supply else 1.0 for servo in own),
        load=column(law.load for law in laws),
        load_external=column(law.load_external for law in laws),
        smoothing=column(law.smoothing for law in laws),
        delay=of_inputs({i: servo.delay for i, _, servo in chosen}),
        lead=of_inputs({i: servo.feedforward / (servo.gain * servo.stiffness) for i, _, servo in chosen}),
        switches=tuple(switches),
        volts=tuple(volts),
        circles=tuple(axes[axis].circle for axis in at),
        limited=not (known([limit for limit, _ in limits]) and all(np.isinf(limit) for limit, _ in limits)),
        banded=_any(servo.dead_band for servo in own),
        loaded=_any(part for law in laws for part in (law.load, law.load_external)),
        weighted=_any(law.load_external for law in laws),
        input_names=tuple(names),
        input_units=tuple(units),
    )


def servos_in(model: MechanicalSystem | StateSpace) -> Servos | None:
    """The servos of a model; None if its inputs are torques."""
    return model.force.servos if isinstance(model.force, ServoForce) else None


def servo_of(motor: Motor) -> Servo | None:
    """The servo that a motor of a file describes; None if its input is a torque."""
    if motor.unsupported or not motor.stiffness:
        return None
    return Servo(
        motor.stiffness,
        damping=motor.damping,
        delay=motor.delay,
        offset=motor.constant / motor.stiffness,
        limit=motor.limit,
        command_scale=motor.gain / motor.stiffness,
    )


def _any(values: Iterable[Number]) -> bool:
    """Whether any number is not zero, or is traced and so may differ from zero."""
    return any(not known(value) or bool(value) for value in values)


def with_servos(robot: Description, given: Mapping[str, Mapping[str, Any]]) -> Description:
    """The robot with the servos that tables by joint describe, and with the friction and armature of their gears."""
    given = complete_tables(given)
    for name, table in given.items():
        refuse_unknown("joint of servo", name, [joint.name for joint in robot.joints])
        for key in table:
            refuse_unknown(f"key of [servo.{name}]", key, (*OF_SERVO, *FLAGS, *OF_GEAR, "sign", "like"))
    driving = {motor.joint: motor for motor in robot.motors if motor.joint in given}
    flipped = {name for name, table in given.items() if _sign(name, table) < 0}
    joints = []
    for joint in (_flipped(joint, flipped) for joint in robot.joints):
        # A table adds keys to the servo that the file states.
        own = servo_of(driving[joint.name]) if joint.name in driving and joint.servo is None else joint.servo
        joint = joint._replace(servo=own)
        joints.append(_with_servo(joint, given[joint.name]) if joint.name in given else joint)
    return robot._replace(joints=tuple(joints))


def complete_tables(given: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Tables of servos, each completed by the table named in its key `like`."""
    for name, table in given.items():
        if not isinstance(table, Mapping):
            raise InputError(f"servo.{name} must be a table, [servo.{name}]; got {table!r}")
        other = table.get("like")
        if "like" in table and not (isinstance(other, str) and other in given and "like" not in given[other]):
            raise InputError(
                f"servo.{name}.like must be a joint with a [servo] table that is like no other; got {other!r}"
            )
    shared = {name: {**given.get(table.get("like", ""), {}), **table} for name, table in given.items()}
    return {name: {key: value for key, value in table.items() if key != "like"} for name, table in shared.items()}


def _sign(name: str, table: Mapping[str, Any]) -> int:
    sign = table.get("sign", 1)
    if sign not in (1, -1) or isinstance(sign, bool):
        raise InputError(f"servo {name!r}: sign must be 1 or -1; got {sign!r}")
    return int(sign)


def _flipped(joint: Joint, names: set[str]) -> Joint:
    """The joint with its axis reversed if it is in `names`, and with its ratio reversed if its leader is."""
    if joint.follows is not None and joint.follows.joint in names:
        joint = joint._replace(follows=joint.follows._replace(ratio=-joint.follows.ratio))
    if joint.name not in names:
        return joint
    return joint._replace(axis=-joint.axis, lower=-joint.upper, upper=-joint.lower, rest=-joint.rest)


def _with_servo(joint: Joint, table: Mapping[str, Any]) -> Joint:
    name = joint.name
    if joint.kind not in ("revolute", "continuous", "prismatic") or joint.follows is not None:
        raise InputError(f"servo {name!r}: it drives one axis that moves by itself; this joint is {joint.kind}")
    if joint.servo is None and "stiffness" not in table:
        raise InputError(f"[servo.{name}] needs a stiffness, the torque per unit of the command's error")
    for key, value in table.items():
        if key in FLAGS and not isinstance(value, bool):
            raise InputError(f"servo {name!r}: {key} must be true or false; got {value!r}")
        if key in (*OF_SERVO, *OF_GEAR):
            _check_number(name, key, value)
    servo = (joint.servo or Servo(0.0))._replace(**{k: v for k, v in table.items() if k in (*OF_SERVO, *FLAGS)})
    stated = [key for key in _DRIVE if key in table]
    if stated and ({"limit", "back_emf"} & table.keys() or len(stated) < len(_DRIVE)):
        raise InputError(
            f"[servo.{name}] states its drive by {', '.join(_DRIVE)} together, or limit and back_emf instead; got "
            f"{', '.join(key for key in table if key in (*_DRIVE, 'limit', 'back_emf'))}"
        )
    if "pwm_limit" in table and not stated:
        raise InputError(f"[servo.{name}] pwm_limit is a part of a drive; state {', '.join(_DRIVE)} too, or a limit")
    if servo.logged_supply and not stated:
        raise InputError(f"[servo.{name}] logged_supply needs {', '.join(_DRIVE)}: which voltage its stiffness is for")
    friction = {key: value for key, value in table.items() if key in FrictionLaw._fields}
    if friction and joint.law is not None:
        raise InputError(f"joint {name!r} has friction in [servo.{name}] and in [parameters]; state it in one of them")
    law = checked_law(name, friction) if friction else joint.law
    return joint._replace(servo=servo, law=law, armature=table.get("armature", joint.armature))


def _check_number(name: str, key: str, value: Any) -> None:
    where = f"servo {name!r}: {key}"
    if known(value) and not isinstance(value, int | float | np.number | jax.Array | np.ndarray):
        raise InputError(f"{where} must be one number; got {value!r}")
    if isinstance(value, bool) or np.ndim(value):
        raise InputError(f"{where} must be one number; got {value!r}")
    check_range(where, value, _RANGES.get(key, ZERO_OR_MORE))


def checked_law(name: str, fields: Mapping[str, Any]) -> FrictionLaw:
    """The friction law with these fields; raises `ValueError` for an unknown field or a number out of range."""
    for field, value in fields.items():
        refuse_unknown(f"number of friction of {name!r},", field, FrictionLaw._fields)
        least = ANY_SIGN if field in _SIGNED else POSITIVE if field in _ABOVE_ZERO else ZERO_OR_MORE
        check_range(f"friction of {name!r}: {field}", value, least)
    return FrictionLaw(**fields)


def drive_limit(servo: Servo) -> tuple[Number, Number]:
    """Torque limit and back-EMF damping; if the servo states a drive, both follow from it."""
    if known(servo.supply) and not servo.supply:
        return servo.limit, servo.back_emf
    current = servo.torque_constant / servo.resistance
    return current * servo.supply * servo.pwm_limit, current * servo.torque_constant
