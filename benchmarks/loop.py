"""An arm under computed torque whose velocities come from encoders: torque ripple and tracking error against the gain.

python benchmarks/loop.py docs/images/twice_the_gain.png

MuJoCo moves a Panda at 1 kHz. Its masses are each off by up to 5 %, each joint has friction that nobody knows, of up
to .9 N m and .9 N m s. Torques have noise of .05 N m and act one sample late, and a load comes and goes. The controller
is `M(a + w²e + 1.6wė) + h` by the file of the robot. Its velocity comes from the C that `covariant.export` writes of a
filtered difference, of tracking loops of second and third order, and of `IntrinsicForce`, with and without its force.
Ripple is the root mean square of the torque above about 25 Hz.

Each of them is tuned in the same way: of a grid over its one to three numbers that setting is taken with which the arm
tracks best at the gain that the ripple allows, on the machines of `TUNED`. The tables are of those of `JUDGED`, which
have other masses, frictions, motions, loads and noise.
"""

import functools
import importlib
import itertools
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

import covariant
from covariant.models import robots
from covariant.report import PALETTE, new_figure, save_figure

RATE, STEPS, SECONDS = 1000.0, 4, 1.6
REST = np.array([0.0, 0.2, 0.0, -1.6, 0.0, 1.8, 0.5])
SWING = np.array([0.4, 0.25, 0.35, 0.3, 0.45, 0.35, 0.5])
PACE = np.array([2.1, 2.9, 2.5, 3.3, 3.7, 2.3, 4.1])
FRICTION = np.array([0.6, 0.6, 0.5, 0.5, 0.3, 0.3, 0.2])
ROTORS = np.array([0.3, 0.3, 0.2, 0.2, 0.05, 0.05, 0.03])
"""Inertias of rotors as felt at the joints [kg m²], which the arm has only where that is asked."""
NOISE, MASSES, LOST = 0.05, 0.05, 0.5
LOAD, LOADED = np.array([0.0, 4.0, 0.0, 2.0, 0.0, 0.0, 0.0]), (0.6, 1.1)
DAMPING, THIRD = 0.5**0.5, 0.35
"""Damping ratio of two poles, and the third one, the rate at which the force is learnt, over their frequency."""
GAINS = (58.0, 70.0, 84.0, 100.0, 120.0, 145.0, 175.0, 210.0, 250.0, 300.0, 360.0, 430.0)
SHOWN = (0, 2, 4, 6, 8)
"""Which of the gains the table has."""
LIMITS = {17: 1.0, 20: 0.2}
"""Ripple [N m] that is allowed, by the bits of the encoders."""
OWN, WITHOUT = "`intrinsic-force`", "without its force"
BEST, BEST_DIFFERENCE = (100.0, 1.0), (17.5,)
"""The settings that are found for 17 bits."""
TUNED, JUDGED = (0, 1), tuple(range(10, 18))


class Row(NamedTuple):
    """Torque ripple [N m] and tracking error [mrad], root mean squares over all joints."""

    ripple: float
    tracking: float

    def __str__(self) -> str:
        return f"{self.ripple:.2f} / {self.tracking:.2f}"


class Limit(NamedTuple):
    """Gain Kd = 1.6 w [1/s] at which the ripple is the one that is allowed, and the tracking error [mrad] there."""

    damping: float
    tracking: float


class Kind(NamedTuple):
    """A source of velocities: its exported module, its parameters by one or two numbers, and grids of these."""

    module: Any
    parameters: Callable[..., dict[str, float]]
    grids: tuple[Sequence[float], ...]

    def maker(self, *setting: float) -> Callable[[], Any]:
        """What makes an observer with these numbers."""
        return lambda: self.module.Observer(self.parameters(*setting))


def exported(spec: str | Path, folder: str, observer: str, parameters: Sequence[str], suffix: str = "", **more) -> Any:
    """The Python module around the C of an observer. The gate is left out: no reading is wrong here."""
    overrides = {
        "measurement.std": 2 * np.pi / 2**17 / 12**0.5,
        "uncertainty.acceleration": 1.0,
        "uncertainty.motion_acceleration": 10.0,
        "uncertainty.motion_time": 0.2,
    }
    if observer == "intrinsic-force":
        overrides |= {"design.natural_frequency": 180.0, "design.force_rate": THIRD * 180.0}
    name = f"{Path(spec).stem}_{observer.replace('-', '_')}{suffix}"
    covariant.export(
        str(spec),
        f"{folder}/{name}",
        observer=observer,
        rate=RATE,
        name=name,
        python=True,
        parameters=list(parameters),
        gate=False,
        overrides=overrides | more,
    )
    sys.path.insert(0, f"{folder}/{name}/python")
    return importlib.import_module(name)


def poles(frequency: float, third: float = THIRD, damping: float = DAMPING) -> dict[str, float]:
    """Gains of two poles at a frequency [rad/s] with a damping ratio, and of one at `third` times the frequency."""
    return {"alpha": 2 * damping * frequency, "beta": frequency**2, "force_rate": third * frequency}


def panda(folder: str, rotors: bool = False) -> Any:
    """The module of `IntrinsicForce` for the robot of the file, or for the same with `ROTORS`."""
    armature = {f"panda_joint{i + 1}": float(inertia) for i, inertia in enumerate(ROTORS)}
    more = {"suffix": "_rotors", "parameters.armature": armature} if rotors else {}
    return exported("panda", folder, "intrinsic-force", ["alpha", "beta", "force_rate"], **more)


def kinds(folder: str) -> dict[str, Kind]:
    """The sources of velocities by name, exported to a folder."""
    # The tracking loop of third order is the observer itself, of joints that are free unit masses without torques.
    masses = Path(folder) / "masses.xml"
    joint = '<body><joint name="j{}" type="slide"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
    bodies = "".join(joint.format(i) for i in range(7))
    masses.write_text(f'<mujoco><option gravity="0 0 0"/><worldbody>{bodies}</worldbody></mujoco>', encoding="utf-8")
    arm, free = panda(folder), exported(masses, folder, "intrinsic-force", ["alpha", "beta", "force_rate"])
    difference = exported("panda", folder, "filtered-derivative", ["bandwidth"])
    loop = exported("panda", folder, "pll", ["bandwidth", "damping"])
    return {
        "filtered difference": Kind(
            difference,
            lambda hertz: {"bandwidth": 2 * np.pi * hertz},
            ((10.0, 12.5, 15.0, 17.5, 20.0, 25.0, 30.0, 40.0, 60.0, 90.0),),
        ),
        "tracking loop of 2nd order": Kind(
            loop,
            lambda frequency, damping: {"bandwidth": frequency, "damping": damping},
            ((200.0, 300.0, 350.0, 400.0, 450.0, 520.0, 700.0, 900.0), (0.7, 1.0, 1.4, 1.7, 2.0, 2.5)),
        ),
        "tracking loop of 3rd order": Kind(
            free, poles, ((200.0, 250.0, 300.0, 400.0, 500.0, 700.0), (0.02, 0.05, 0.1, 0.2), (0.7, 1.0, 1.4))
        ),
        OWN: Kind(arm, poles, ((80.0, 100.0, 115.0, 130.0, 150.0, 180.0, 220.0, 280.0), (0.2, 0.35, 0.6, 1.0, 1.5))),
        WITHOUT: Kind(arm, functools.partial(poles, third=0.0), ((130.0, 180.0, 215.0, 250.0, 320.0, 400.0, 520.0),)),
    }


@functools.cache
def machine(seed: int | None = None, masses: float = MASSES, rotors: float = 0.0) -> mujoco.MjModel:
    """The robot of the file, or one with masses and inertias that are off and with friction; and a part of `ROTORS`."""
    model = mujoco.MjModel.from_xml_string(robots.located("panda").read_text(encoding="utf-8"))
    model.opt.timestep, model.opt.gravity[:] = 1 / (RATE * STEPS), (0, 0, -9.81)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.jnt_limited[:], model.dof_armature[:] = 0, rotors * ROTORS
    model.dof_frictionloss[:] = model.dof_damping[:] = 0
    if seed is not None:
        random = np.random.default_rng(seed)
        factors = random.uniform(1 - masses, 1 + masses, model.nbody)
        model.body_mass[:] *= factors
        model.body_inertia[:] *= factors[:, None]
        model.dof_frictionloss[:], model.dof_damping[:] = FRICTION * random.uniform(0.5, 1.5, (2, 7))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def run(
    make: Callable[[], Any],
    gain: float,
    bits: int = 17,
    seed: int = 0,
    masses: float = MASSES,
    rotors: tuple[float, float] = (0.0, 0.0),
    late: int = 0,
) -> Row | None:
    """A run in which the velocity comes from an observer; None where the loop is unstable.

    The observer is told the torque that acted, or the one of `late` samples before that. The arm has the first part of
    `ROTORS`, and the controller knows of the second.
    """
    plant, known = machine(seed, masses, rotors[0]), machine(rotors=rotors[1])
    random, observer = np.random.default_rng((seed, 1)), make()
    real, expected, inertia = mujoco.MjData(plant), mujoco.MjData(known), np.zeros((7, 7))
    dt, tick, count = 1 / RATE, 2 * np.pi / 2**bits, round(SECONDS * RATE)
    pace, load = PACE * random.uniform(0.8, 1.2, 7), LOAD * random.uniform(0.5, 1.5) * random.choice((-1.0, 1.0))
    real.qpos[:] = REST
    mujoco.mj_forward(plant, real)
    commands, rows = [], np.empty((count, 2, 7))
    for k in range(count):
        observer.step(tick * np.round(real.qpos / tick), dt, u=commands[-2 - late] if commands else np.zeros(7))
        # The exported C of a tracking loop has one array for both, the others two or three.
        q, v = np.split(np.concatenate(observer.estimate())[:14], 2)
        turn = pace * k * dt
        ahead = REST + SWING * (1 - np.cos(turn)), SWING * pace * np.sin(turn), SWING * pace**2 * np.cos(turn)
        expected.qpos[:], expected.qvel[:] = q, v
        mujoco.mj_fwdPosition(known, expected)
        mujoco.mj_fwdVelocity(known, expected)
        mujoco.mj_fullM(known, expected, inertia)
        new = inertia @ (ahead[2] + gain**2 * (ahead[0] - q) + 1.6 * gain * (ahead[1] - v)) + expected.qfrc_bias
        rows[k] = new, ahead[0] - real.qpos
        if not (np.isfinite(rows[k]).all() and np.abs(rows[k, 1]).max() < LOST):
            return None
        # The command of a sample acts over the next one.
        commands = [*commands[-3:], new] if commands else [new] * 4
        loaded = load if LOADED[0] < k * dt < LOADED[1] else 0.0
        real.qfrc_applied[:] = commands[-2] + NOISE * random.standard_normal(7) + loaded
        mujoco.mj_step(plant, real, nstep=STEPS)
    window = np.hanning(41) / np.hanning(41).sum()
    fast = rows[:, 0] - np.apply_along_axis(lambda u: np.convolve(u, window, "same"), 0, rows[:, 0])
    ripple, tracking = (float(np.sqrt(np.mean(part**2))) for part in (fast[320:-40], rows[300:, 1]))
    return Row(ripple, 1e3 * tracking)


def at_limit(make: Callable[[], Any], bits: int, seed: int, **machine: Any) -> Limit:
    """Gain and tracking error at the ripple that is allowed, between those of `GAINS`; NaN where it is never below."""
    last, limit = None, np.log(LIMITS[bits])
    for gain in GAINS:
        row = run(make, gain, bits, seed, **machine)
        if row is None:
            break
        new = np.log([row.ripple, 1.6 * gain, row.tracking])
        if new[0] > limit:
            if last is None:
                break
            share = (limit - last[0]) / (new[0] - last[0])
            return Limit(*np.exp(last + share * (new - last))[1:])
        last = new
    return Limit(np.nan, np.nan) if last is None else Limit(*np.exp(last)[1:])


def tune(kind: Kind, bits: int) -> tuple[float, ...]:
    """The setting of the grids with which the arms of `TUNED` track best at the ripple that is allowed."""

    def error(setting: tuple[float, ...]) -> float:
        mean = np.mean([at_limit(kind.maker(*setting), bits, seed).tracking for seed in TUNED])
        return float(np.nan_to_num(mean, nan=np.inf))

    return min(itertools.product(*kind.grids), key=error)


def across(make: Callable[[], Any], bits: int) -> list[Row | None]:
    """Root mean squares over the arms of `JUDGED` for each of `GAINS`; None from that on where one is unstable."""
    found: list[Row | None] = []
    for gain in GAINS:
        rows = [] if None in found else [run(make, gain, bits, seed) for seed in JUDGED]
        found.append(None if None in rows or not rows else Row(*np.sqrt(np.mean(np.square(rows), axis=0))))
    return found


def print_tables(sources: dict[str, Kind], bits: int) -> dict[str, list[Row | None]]:
    """Print what the tuned sources allow, and their errors at some gains; returns those at `GAINS`."""
    tuned, allowed, rows = {}, {}, {}
    print(
        f"\n| {bits} bits | setting | Kd at {LIMITS[bits]:g} N m | error there [mrad] |\n|---|---|--:|--:|", flush=True
    )
    for name, kind in sources.items():
        setting = tuned[name] = tune(kind, bits)
        make = kind.maker(*setting)
        allowed[name] = np.array([at_limit(make, bits, seed) for seed in JUDGED])
        rows[name] = across(make, bits)
        (low, _), (high, _), (kd, error) = (f(allowed[name], axis=0) for f in (np.min, np.max, np.mean))
        numbers = ", ".join(map("{:g}".format, setting))
        print(f"| {name} | {numbers} | {kd:.0f} ({low:.0f} to {high:.0f}) | {error:.2f} |", flush=True)
    own, rivals = allowed[OWN], np.stack([found for name, found in allowed.items() if name not in (OWN, WITHOUT)])
    gain, error = own[:, 0] / rivals[..., 0].max(axis=0), rivals[..., 1].min(axis=0) / own[:, 1]
    print(f"\n{OWN} and the best rival of each arm: gain × {spread(gain)}, tracking error ÷ {spread(error)}")
    print(f"\n| {bits} bits | {' | '.join(f'w = {GAINS[i]:g}' for i in SHOWN)} |\n{'|---' * (len(SHOWN) + 1)}|")
    for name, found in rows.items():
        print(f"| {name} | {' | '.join(str(found[i] or 'unstable') for i in SHOWN)} |")
    return rows


def print_losses(sources: dict[str, Kind], rotors: Any, bits: int = 17) -> None:
    """Print what the observer and a difference allow on arms of which more is unknown, with settings tuned before."""
    own, difference = sources[OWN].maker(*BEST), sources["filtered difference"].maker(*BEST_DIFFERENCE)
    known = Kind(rotors, poles, ()).maker(*BEST)
    changes = {
        "as above": (own, {}),
        "masses off by up to 20 %": (own, {"masses": 0.2}),
        "the torque told one sample late": (own, {"late": 1}),
        "the torque told one sample early": (own, {"late": -1}),
        "rotors that the file does not know": (own, {"rotors": (1.0, 0.0)}),
        "rotors 10 % heavier than in the file": (known, {"rotors": (1.1, 1.0)}),
    }
    print(f"\n| {bits} bits | Kd | error [mrad] | filtered difference: Kd | error [mrad] |\n|---|--:|--:|--:|--:|")
    for name, (make, change) in changes.items():
        pairs = [
            np.mean([at_limit(each, bits, seed, **change) for seed in JUDGED], axis=0) for each in (make, difference)
        ]
        cells = " | ".join(f"{kd:.0f} | {error:.2f}" for kd, error in pairs)
        print(f"| {name} | {cells} |", flush=True)


def spread(values: np.ndarray) -> str:
    """Mean, least and largest value."""
    return f"{np.mean(values):.2f} ({np.min(values):.2f} to {np.max(values):.2f})"


def draw(rows: dict[int, dict[str, list[Row | None]]], path: str) -> None:
    """Draw ripple and tracking error against the gain, for both encoders."""
    titles = [f"{bits} bits: {what}" for what in ("torque ripple", "tracking error") for bits in rows]
    figure, axes = new_figure(2, len(rows), panel=(4.35, 2.5), titles=titles)
    colours = dict(zip((OWN, WITHOUT), (PALETTE[0], PALETTE[5]), strict=True))
    others = iter((PALETTE[2], PALETTE[3], PALETTE[6]))
    for column, (bits, sources) in enumerate(rows.items()):
        for name, found in sources.items():
            colour = colours.get(name) or colours.setdefault(name, next(others))
            stable = [(1.6 * gain, *row) for gain, row in zip(GAINS, found, strict=True) if row is not None]
            kd, *values = np.transpose(stable)
            for axis, each in zip(axes[:, column], values, strict=True):
                style = {"ls": "--"} if name == WITHOUT else {}
                axis.loglog(kd, each, color=colour, lw=2.2 if name == OWN else 1.4, label=name.strip("`"), **style)
                axis.plot(kd[-1], each[-1], "x" if None in found else "", color=colour)
        axes[0, column].axhline(LIMITS[bits], color="0.4", lw=1, ls=":")
        axes[0, column].set_ylim(LIMITS[bits] / 30, LIMITS[bits] * 10)
        axes[1, column].set_xlabel("gain Kd [1/s]; x: unstable above")
        axes[1, column].set_xticks([100, 200, 400])
    for axis in axes.flat:
        axis.minorticks_off()
        axis.xaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_major_formatter("{x:g}")
    axes[0, 0].set_ylabel("[N m]")
    axes[1, 0].set_ylabel("[mrad]")
    axes[0, 0].legend(loc="lower right", fontsize=8)
    save_figure(figure, path)


def main() -> None:
    """Print the tables for two encoders, and draw them where a file is named."""
    with tempfile.TemporaryDirectory() as folder:
        sources = kinds(folder)
        rows = {bits: print_tables(sources, bits) for bits in LIMITS}
        print_losses(sources, panda(folder, rotors=True))
    for path in sys.argv[1:]:
        draw(rows, path)


if __name__ == "__main__":
    main()
