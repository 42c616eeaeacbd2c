"""Simulated twins of machines as they are: each has one thing that its model file does not know.

Each function of `TWINS` makes one log, from a seed, with its true velocities. Rigid bodies with contacts and arms are
moved by MuJoCo, pendulums by the library with friction added. The models are what a user writes from a data sheet.

Run `python benchmarks/twins.py` from the repository's root to see what they are like.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import covariant
from covariant import logs, models, simulation
from covariant.geometry import lie
from covariant.models import robots

STEPS = 4
"""Steps of a simulation in a row."""
TICK = 2 * np.pi / 2**13
"""Tick of the encoders of pendulums [rad]."""
ENCODERS = {"measurement_std": TICK / np.sqrt(12), "quantum": TICK}
"""What model files say of them: a tick, and the standard deviation that it has."""
FINE = 2 * np.pi / 2**17
"""Tick of the encoders of arms [rad]."""
QUATERNION = {"quaternion_wxyz": ("qw", "qx", "qy", "qz")}
"""Columns of an attitude."""
CRAFT = models.marine.cybership()
TRIPLE = {
    "mass": (0.5, 0.4, 0.3),
    "length": (0.3, 0.25, 0.2),
    "com": (0.15, 0.12, 0.1),
    "inertia": (4e-3, 3e-3, 2e-3),
    "viscous": (0.01, 0.01, 0.005),
}
"""Parameters of the triple pendulum."""
ACROBOT = {
    "mass": (0.6, 0.6),
    "length": (0.3, 0.2),
    "com": (0.3, 0.2),
    "inertia": (0.004, 0.003),
}
"""Parameters of the pendulum with two links and one motor, from its data sheet: without friction."""
FRICTION = {"viscous": (0.01, 0.01), "coulomb": (0.02, 0.02)}
"""What the data sheet leaves out [N m s/rad, N m]."""
CUBE = {"mass": 0.37, "half": 0.0524, "inertia": 8.1e-4}
"""A tossed cube: mass [kg], half of an edge [m], moment of inertia [kg m²]."""
RACQUET = (4e-3, 7e-3, 1e-2)
"""Moments of inertia [kg m²] of a body that is spun about its middle axis."""


class Twin(NamedTuple):
    """A log with its truth.

    Attributes:
        name: Name in tables.
        file: The model file of a user.
        record: The log: T stamps [s], inputs (T, m), positions (T, n) or matrices (T, N, N).
        v: Velocities (T, n) to judge by, in the frame of the model; the true ones, where the log is simulated.
        force: True forces (T, n) that the model does not know [N or N m]; None where they are not compared.
    """

    name: str
    file: models.ModelFile
    record: covariant.Record
    v: np.ndarray
    force: np.ndarray | None = None

    @property
    def std(self) -> float:
        """Noise of a reading [its unit]."""
        assert self.file.typical_std is not None
        return self.file.typical_std


def ticked(q: np.ndarray, tick: float) -> np.ndarray:
    """What an encoder reads."""
    return tick * np.round(np.asarray(q) / tick)


def driven(
    model: models.MechanicalSystem,
    law: Callable[[jax.Array, jax.Array], jax.Array],
    q0: list[float],
    rate: float,
    seconds: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, inputs, positions and velocities of a model under a law of its state (q, v) and of time."""
    t, n = jnp.asarray(np.arange(round(seconds * rate)) / rate), len(q0)

    def row(x, now):
        u = law(now, x)
        q, v = models.advance(model, now, models.Motion(x[:n], x[n:]), u, 1 / rate, STEPS)
        return jnp.concatenate([q, v]), (u, x)

    start = jnp.concatenate([jnp.asarray(q0, float), jnp.zeros(n)])
    u, x = jax.jit(lambda: jax.lax.scan(row, start, t)[1])()
    return np.asarray(t), np.asarray(u), np.asarray(x[:, :n]), np.asarray(x[:, n:])


def swing_up(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """An acrobot whose elbow pumps energy until it turns over: stamps, torques, positions and velocities."""

    def pump(t: jax.Array, x: jax.Array) -> jax.Array:
        aim = 0.9 * jnp.arctan(1.5 * x[2])
        return jnp.clip(8.0 * (aim - x[1]) - 0.3 * x[3], -2.0, 2.0)[None]

    start = 0.6 + 0.1 * np.random.default_rng(seed).random()
    return driven(models.pendulum_chain(**ACROBOT, **FRICTION, actuated=[1]), pump, [start, 0.0], 250.0, 12.0)


def acrobot_late(seed: int = 0) -> Twin:
    """The swing-up as logged: the shoulder is read a row late, and the model file does not know it."""
    t, u, q, v = swing_up(seed)
    y = ticked(q, TICK)
    y[1:, 0] = y[:-1, 0].copy()
    file = models.ModelFile("acrobot", models.pendulum_chain(**ACROBOT, actuated=[1]), **ENCODERS, acceleration_std=5.0)
    return Twin("acrobot, a joint a row late", file, covariant.Record(t, u, y), v)


def acrobot(seed: int = 0) -> Twin:
    """The same log, shifted back as `check` advises."""
    late = acrobot_late(seed)
    t, u, y = map(np.asarray, late.record[:3])
    shifted = np.stack([y[1:, 0], y[:-1, 1]], axis=1)
    return Twin("acrobot, shifted", late.file, covariant.Record(t[:-1], u[:-1], shifted), late.v[:-1])


def passive_elbow(seed: int = 0) -> Twin:
    """One motor at the shoulder and a passive elbow, with friction in both."""
    random = np.random.default_rng(seed)
    pace, phase = jnp.array([0.7, 1.3]), jnp.asarray(random.uniform(0, 2 * np.pi, 2))

    def sines(t: jax.Array, x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.array([0.5, 0.3]) * jnp.sin(2 * jnp.pi * pace * t + phase))[None]

    true = models.pendulum_chain(**ACROBOT, **FRICTION, actuated=[0])
    t, u, q, v = driven(true, sines, [0.2, 0.1], 200.0, 12.0)
    model = models.pendulum_chain(**ACROBOT, actuated=[0])
    file = models.ModelFile("passive elbow", model, **ENCODERS, acceleration_std=5.0)
    return Twin("one motor, passive elbow", file, covariant.Record(t, u, ticked(q, TICK)), v)


def pushed_double(seed: int = 0) -> Twin:
    """The double pendulum of the examples within strong pushes."""
    log = covariant.simulate(
        "examples/demo_double_pendulum.toml",
        duration=12.0,
        rate=250.0,
        q0=[0.5, 0.2],
        amplitude=[0.2, 0.05],
        push=[0.8, 0.3],
        quantum=1.534e-3,
        seed=seed,
    )
    file = models.load("examples/demo_double_pendulum.toml")
    force = np.stack([log.columns[f"true_external_force{k}"] for k in (1, 2)], axis=1)
    return Twin(
        "double pendulum, pushes", file, covariant.Record(*log.record[:3]), np.asarray(log.record.x)[:, 2:], force
    )


def triple(seed: int = 1) -> Twin:
    """A triple pendulum, driven at the first joint, with dry friction that its model does not know."""
    std = 2e-4
    file = models.ModelFile(
        "triple pendulum",
        models.pendulum_chain(**TRIPLE),
        measurement_std=std,
        acceleration_std=1.0,
        correlation_time=0.02,
    )
    log = covariant.simulate(
        models.pendulum_chain(**TRIPLE, coulomb=(0.01, 0.01, 0.005)),
        duration=10.0,
        rate=200.0,
        q0=[1.0, -0.5, 0.5],
        amplitude=[0.3, 0.0, 0.0],
        frequency=0.7,
        noise=std,
        seed=seed,
    ).record
    return Twin("triple pendulum", file, covariant.Record(*log[:3]), np.asarray(log.x)[:, 3:])


def turned(q: jax.Array) -> jax.Array:
    """The inertia (3, 3) of the ship as seen from the shore."""
    turn = models.marine.yaw_rotation(q[2])
    return turn @ CRAFT.mass @ turn.T


def pushed(t: jax.Array, q: jax.Array, u: jax.Array) -> jax.Array:
    """Forces of the thrusters, given in the ship, as seen from the shore."""
    return models.marine.yaw_rotation(q[2]) @ u


def drag(q: jax.Array, v: jax.Array) -> jax.Array:
    """Drag of the water, identified in the ship, as seen from the shore."""
    turn = models.marine.yaw_rotation(q[2])
    inside = turn.T @ v
    return -turn @ CRAFT.damping(inside) @ inside


def ship(seed: int = 2) -> Twin:
    """CyberShip II under known forces of its thrusters, pushed by wind and current that its model does not know."""
    std, random = 2e-3, np.random.default_rng(seed)
    names = {"coordinates": ("north", "east", "heading"), "units": ("m", "m", "rad")}
    model = models.Lagrangian(turned, None, pushed, drag, (2,), **names)
    file = models.ModelFile(
        "ship", model, measurement_std=std, acceleration_std=0.01, correlation_time=1.0, reference_half=1.0
    )
    t = np.arange(1800) * 0.1
    pace = np.array([0.05, 0.067, 0.083])
    u = np.array([1.0, 0.5, 0.2]) * np.sin(2 * np.pi * pace * t[:, None])
    # A lasting force, and one that is forgotten within 20 s, each of half the size.
    decay = np.exp(-0.1 / 20)
    force = np.zeros((len(t), 3))
    for k in range(1, len(t)):
        force[k] = decay * force[k - 1] + np.sqrt(1 - decay**2) * random.normal(size=3)
    force = np.array([0.3, 0.2, 0.05]) * (1 + force)
    acting = simulation.hold(jnp.asarray(t), jnp.asarray(u + force))
    true = simulation.simulate(model, jnp.zeros(6), jnp.asarray(t), acting)
    y = np.asarray(true.y) + random.normal(0, std, (len(t), 3))
    return Twin("ship", file, covariant.Record(t, u, y), np.asarray(true.x)[:, 3:])


def height(g: jax.Array) -> jax.Array:
    """Potential energy of the cube [J]."""
    return CUBE["mass"] * 9.81 * g[2, 3]


def cube(seed: int = 0) -> Twin:
    """A cube that is picked up, turned and tossed onto a floor again and again; its model knows gravity only."""
    import mujoco

    half, mass, inertia = CUBE["half"], CUBE["mass"], CUBE["inertia"]
    machine = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="0.0005" gravity="0 0 -9.81"/>
        <worldbody><geom type="plane" size="5 5 .1" friction=".3 .005 .0001"/>
        <body pos="0 0 .4"><freejoint/><inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
        <geom type="box" size="{half} {half} {half}" solref="-20000 -20" friction=".3 .005 .0001"/></body>
        </worldbody></mujoco>""")
    data, random, rate, steps = mujoco.MjData(machine), np.random.default_rng(seed), 148.0, 2000
    every, period, count = steps / rate, 1.5, round(12 * rate)
    g, v, row, aim = np.tile(np.eye(4), (count, 1, 1)), np.empty((count, 6)), 0, np.zeros(6)
    for k in range(round(count * every) + 1):
        phase = (k / steps) % period
        if phase < 1 / steps:
            aim = np.concatenate([random.uniform((-0.8, -0.8, 0.5), (0.8, 0.8, 1.5)), random.uniform(-8, 8, 3)])
        data.xfrc_applied[1] = 0
        if phase < 0.4:  # the hand: lifts the cube, then gives it the velocity of the toss
            twist = np.concatenate([data.qvel[:3], data.xmat[1].reshape(3, 3) @ data.qvel[3:]])
            place = np.concatenate([np.array([0, 0, 0.35]) - data.qpos[:3], np.zeros(3)])
            wanted = 8.0 * place if phase < 0.25 else aim
            force = np.array([mass] * 3 + [inertia] * 3) * 60.0 * (wanted - twist)
            force[2] += 9.81 * mass
            data.xfrc_applied[1] = force
        if k >= row * every and row < count:
            mujoco.mj_forward(machine, data)
            g[row, :3, :3], g[row, :3, 3] = data.xmat[1].reshape(3, 3), data.qpos[:3]
            v[row] = np.concatenate([g[row, :3, :3].T @ data.qvel[:3], data.qvel[3:]])
            row += 1
        mujoco.mj_step(machine, data)
    std = (5e-4,) * 3 + (5e-3,) * 3
    error = random.normal(size=(count, 6)) * std
    y = np.asarray(jnp.asarray(g) @ jax.vmap(lie.SE3.exp)(jnp.asarray(error)))
    body = models.GroupSystem(
        lie.SE3,
        jnp.diag(jnp.array([mass] * 3 + [inertia] * 3)),
        height,
        velocities=("v1", "v2", "v3", "w1", "w2", "w3"),
        units=("m/s",) * 3 + ("rad/s",) * 3,
    )
    file = models.ModelFile(
        "cube",
        body,
        columns=logs.Columns(position=("x", "y", "z"), **QUATERNION),
        measurement_std=std,
        acceleration_std=5.0,
    )
    return Twin("tossed cube", file, covariant.Record(np.arange(count) / rate, np.zeros((count, 6)), y), v)


def racquet(seed: int = 0) -> Twin:
    """A racquet that spins about its middle axis in the air, whose drag the model does not know."""
    random = np.random.default_rng(seed)
    air = models.heavy_top(RACQUET, moment=0.0, viscous=2e-4)
    t = jnp.asarray(np.arange(1200) / 120.0)
    start = models.Motion(lie.SO3.exp(jnp.asarray(random.normal(size=3))), jnp.array([0.05, 9.0, 0.1]))
    true = simulation.simulate(air, start, t)
    noise = jax.vmap(lie.SO3.exp)(jnp.asarray(random.normal(0, 2e-3, (len(t), 3))))
    file = models.ModelFile(
        "racquet", models.free_body(RACQUET), logs.Columns(**QUATERNION), measurement_std=2e-3, acceleration_std=1.0
    )
    record = covariant.Record(np.asarray(t), np.zeros((len(t), 3)), np.asarray(true.y @ noise))
    return Twin("spinning racquet", file, record, np.asarray(true.x.v))


class Plant(NamedTuple):
    """What the joints of a simulated arm have beside their rigid bodies; every part (n,), or a number for all.

    Attributes:
        viscous, coulomb: Friction [N m s/rad, N m].
        stribeck: Friction at rest beyond the Coulomb friction [N m], gone above about .1 rad/s.
        load: Friction as a fraction of the torque in the joint.
        cogging: Torque of the cogging [N m], 50 periods a turn.
        armature: Inertia of the rotors as felt at the joints [kg m²].
        mass: Largest relative error of the masses of the file.
    """

    viscous: np.ndarray
    coulomb: np.ndarray
    stribeck: np.ndarray
    load: float = 0.0
    cogging: float = 0.0
    armature: np.ndarray | float = 0.0
    mass: float = 0.0

    def torque(self, q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Torques (n,) [N m] that act beside the motors', at positions and rates (n,) and motor torques u (n,)."""
        dry = self.coulomb + self.stribeck * np.exp(-((v / 0.1) ** 2)) + self.load * np.abs(u)
        return -self.viscous * v - dry * np.tanh(v / 0.01) + self.cogging * np.sin(50 * q)


class ArmLog(NamedTuple):
    """Stamps (T,), motor torques, positions, velocities and what acts beside the motors (T, n) of a simulated arm."""

    t: np.ndarray
    u: np.ndarray
    q: np.ndarray
    v: np.ndarray
    beside: np.ndarray


def moved(
    name: str, plant: Plant, middle: np.ndarray, rate: float, seconds: float, seed: int, compensated: bool = True
) -> ArmLog:
    """A robot of the library, moved by MuJoCo under a controller that knows its file, and its friction if that is
    `compensated`."""
    import mujoco

    random, n = np.random.default_rng(seed), len(middle)
    machine = mujoco.MjModel.from_xml_string(robots.located(name).read_text(encoding="utf-8"))
    machine.opt.timestep, machine.opt.gravity[:] = 1 / (rate * STEPS), (0, 0, -9.81)
    machine.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    machine.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    machine.jnt_limited[:], machine.dof_damping[:], machine.dof_frictionloss[:] = 0, 0, 0
    machine.dof_armature[:] = 0
    file, now = mujoco.MjData(machine), mujoco.MjModel.from_xml_string(robots.located(name).read_text(encoding="utf-8"))
    now.opt.gravity[:] = machine.opt.gravity
    now.dof_armature[:] = plant.armature
    scale = random.uniform(1 - plant.mass, 1 + plant.mass, machine.nbody)
    machine.body_mass[:] *= scale
    machine.body_inertia[:] *= scale[:, None]
    machine.dof_armature[:] = plant.armature
    data = mujoco.MjData(machine)
    mujoco.mj_setConst(machine, data)
    pace = 2 * np.pi * random.uniform(0.15, 0.7, (3, n))
    size, phase = random.uniform(0.5, 1.0, (3, n)) * 0.5 / pace, random.uniform(0, 2 * np.pi, (3, n))

    def wanted(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s, c = np.sin(pace * t + phase), np.cos(pace * t + phase)
        q = middle + np.sum(size * (s - np.sin(phase)), axis=0)
        return q, np.sum(size * pace * c, axis=0), -np.sum(size * pace**2 * s, axis=0)

    count, inertia = round(seconds * rate), np.zeros((n, n))
    log = ArmLog(np.arange(count) / rate, *np.empty((4, count, n)))
    data.qpos[:], data.qvel[:] = wanted(0.0)[:2]
    for k in range(count):
        q, v, a = wanted(k / rate)
        file.qpos[:], file.qvel[:] = data.qpos, data.qvel
        mujoco.mj_fwdPosition(now, file)
        mujoco.mj_fwdVelocity(now, file)
        mujoco.mj_fullM(now, file, inertia)
        u = (
            inertia @ (a + 900 * (q - data.qpos) + 48 * (v - data.qvel))
            + file.qfrc_bias
            - (plant.torque(q, v, file.qfrc_bias) if compensated else 0.0)
        )
        log.u[k], log.q[k], log.v[k] = u, data.qpos, data.qvel
        for step in range(STEPS):
            beside = plant.torque(data.qpos, data.qvel, u)
            if step == 0:
                log.beside[k] = beside
            data.qfrc_applied[:] = u + beside
            mujoco.mj_step(machine, data)
    return log


def six_joints(seed: int = 0) -> Twin:
    """A UR5e fitted for viscous and Coulomb friction and rotors; its friction grows with the load, and motors cog."""
    coulomb = np.array([6.0, 6.0, 4.0, 1.5, 1.5, 1.2])
    armature = np.array([1.0, 1.0, 0.6, 0.15, 0.15, 0.15])
    plant = Plant(1.2 * coulomb, coulomb, 0.4 * coulomb, 0.06, 0.25, armature, 0.02)
    log = moved("ur5e", plant, np.array([0.0, -1.2, 1.2, -1.0, 1.0, 0.3]), 250.0, 12.0, seed)
    # What a fit of friction finds: least squares of the torques beside the motors', joint by joint.
    friction = {}
    names = models.load("ur5e").need_mechanical("ur5e", "").coordinates
    for name, v, beside in zip(names, log.v.T, log.beside.T, strict=True):
        columns = np.stack([v, np.tanh(v / 0.01)], axis=1)
        viscous, dry = np.maximum(np.linalg.lstsq(columns, -beside, rcond=None)[0], 0)
        friction[name] = {"viscous": float(viscous), "coulomb": float(dry), "smoothing": 0.01}
    file = models.load(
        "ur5e",
        {
            "parameters.friction": friction,
            "parameters.armature": dict(zip(names, armature.tolist(), strict=True)),
            "measurement.quantum": FINE,
            "uncertainty.acceleration": 1.0,
        },
    )
    random = np.random.default_rng(seed)
    u = log.u + random.normal(size=log.u.shape) * 0.1 * coulomb
    return Twin("six joints, fitted", file, covariant.Record(log.t, u, ticked(log.q, FINE)), log.v)


def panda(seed: int = 0, compensated: bool = False) -> Twin:
    """A Panda with friction of .2 to .6 N m that the model does not know, and masses that are off by 5 %."""
    friction = np.array([0.6, 0.6, 0.5, 0.5, 0.3, 0.3, 0.2])
    plant = Plant(friction, friction, 0 * friction, mass=0.05)
    log = moved("panda", plant, np.array([0.0, 0.2, 0.0, -1.6, 0.0, 1.8, 0.5]), 500.0, 6.0, seed, compensated)
    file = models.load("panda", {"measurement.quantum": FINE, "uncertainty.acceleration": 5.0})
    record = covariant.Record(log.t, log.u, ticked(log.q, FINE))
    return Twin("panda, unknown friction", file, record, log.v, log.beside)


TWINS: dict[str, Callable[[], Twin]] = {
    "acrobot late": acrobot_late,
    "acrobot": acrobot,
    "cube": cube,
    "racquet": racquet,
    "six joints": six_joints,
    "passive elbow": passive_elbow,
    "pushed double": pushed_double,
    "panda": panda,
    "triple pendulum": triple,
    "ship": ship,
}
"""Functions that make the logs, by short names."""


if __name__ == "__main__":
    for twin in TWINS.values():
        began = time.perf_counter()
        log = twin()
        size = np.round(np.sqrt(np.mean(log.v**2, axis=0)), 3)
        print(f"{log.name}: {len(log.v)} rows, rms velocity {size}, {time.perf_counter() - began:.1f} s", flush=True)
