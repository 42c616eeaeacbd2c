"""The velocity field of a fluid from where its particles are, and nothing else.

A shear flow on a periodic square rolls up into vortices. The fluid is Zeitlin's: a motion on SU(21), slowed by a little
viscosity, whose element g says which label is now at which place, as a camera sees it that follows dyed water. The
observer starts with a velocity field that is half wrong. Although its gain is small compared with the vorticity, its
error follows the law s² + αs + β of a flat space, because it compensates the curvature of the group. Without that term
the instability of the shear flow, which makes the weather hard to foretell, works against the observer.
"""

import functools
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # at this size more threads only get in each other's way

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from covariant.models import Motion, advance, fluid
from covariant.observers import Intrinsic
from covariant.report import PALETTE, new_figure, save_figure

OUT = Path(__file__).parent / "out"
FIGURE, MOVIE = OUT / "08_ideal_fluid.png", OUT / "08_ideal_fluid.gif"

n, dt, duration, points = 21, 0.025, 16.0, 96
t = np.arange(round(duration / dt) + 1) * dt
x1, x2 = np.meshgrid(*2 * [2 * np.pi * np.arange(points) / points], indexing="ij")
stream = jnp.asarray(np.cos(2 * x2) + 0.02 * np.cos(x1 + 0.4) + 0.01 * np.sin(x1 + x2))  # [m²/s]

system = fluid.ideal_fluid(n, viscosity=0.01)


@eqx.filter_jit
def flow(v):
    """Motion of the fluid at every stamp."""

    def step(motion, _):
        after = advance(system, 0.0, motion, jnp.zeros(0), dt, 1)
        return after, after

    start = Motion(system.group.identity(), v)
    after = jax.lax.scan(step, start, None, length=len(t) - 1)[1]
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, after)


truth = flow(fluid.velocity_coordinates(n, fluid.modes(n, stream)))
alpha = 1.2  # less than a third of the largest vorticity
beta = 0.21 * alpha**2  # s² + αs + β has the roots −0.3α and −0.7α
speed = functools.partial(system.space.norm, system.group.identity())  # the same wherever the particles are


@eqx.filter_jit
def follow(observer, v, g):
    """Velocities estimated at every stamp from the measured g, starting with the velocity v."""

    def step(state, y):
        state, _ = observer.step(state, jnp.zeros(0), y, dt)
        return state, state.v

    after = jax.lax.scan(step, observer.init(g[0])._replace(v=v), g[1:])[1]
    return jnp.concatenate([v[None], after])


wrong = fluid.velocity_coordinates(n, fluid.modes(n, jnp.asarray(np.sin(x1 + x2) + 0.4 * np.cos(2 * x1 + 1))))
guess = truth.v[0] + 0.5 * speed(truth.v[0]) / speed(wrong) * wrong
estimates = {
    label: follow(Intrinsic(system, alpha, beta, curvature=curvature, substeps=1), guess, truth.q)
    for label, curvature in (("with curvature", True), ("without curvature", False))
}

speeds = jax.jit(jax.vmap(speed))
error = {label: np.asarray(speeds(v - truth.v) / speeds(truth.v)) for label, v in estimates.items()}
late = t > duration / 2
for label, values in error.items():
    decay = -np.polyfit(t[late], np.log(values[late]), 1)[0]
    print(f"{label}: {values.max():.2f} of the speed at worst, {values[-1]:.1e} in the end, decay {decay:.3f} 1/s")
print(f"the slow root is {0.3 * alpha:.3f} 1/s")

maps = jax.jit(jax.vmap(lambda v: fluid.vorticity(n, v, points)))
shown = [round(s / dt) for s in (0.0, 3.0, 6.0, 9.0)]
look = {"cmap": "RdBu_r", "vmin": -4.5, "vmax": 4.5, "origin": "lower", "extent": (0, 2 * np.pi, 0, 2 * np.pi)}
ticks = {"xticks": (0, np.pi, 2 * np.pi), "yticks": (0, np.pi, 2 * np.pi)}
names = {"xticklabels": ("0", "π", "2π"), "yticklabels": ("0", "π", "2π")}


def picture(ax, values):
    """Draw a field with x₁ to the right; returns the image."""
    ax.grid(visible=False)
    ax.set(**ticks, **names)
    return ax.imshow(np.asarray(values).T, **look)


titles = [f"t = {t[k]:g} s" for k in shown]
figure, axes = new_figure(3, 4, panel=(2.35, 2.2), titles=titles, sharex=False)
for row, v in enumerate((truth.v, estimates["with curvature"])):
    for ax, values in zip(axes[row], maps(v[jnp.asarray(shown)]), strict=True):
        image = picture(ax, values)
    axes[row, 0].set_ylabel(("true", "estimated")[row] + "\nx₂ [m]")
for ax in axes[1]:
    ax.set_xlabel("x₁ [m]")
figure.colorbar(image, ax=axes[:2].ravel().tolist(), shrink=0.8, label="vorticity [1/s]")
for ax in axes[2]:
    ax.remove()
curve = figure.add_subplot(axes[2, 0].get_gridspec()[2, :])
curve.spines[["top", "right"]].set_visible(False)
curve.grid(color=PALETTE.shade, linewidth=0.7)
for color, (label, values) in zip((PALETTE.covariant, PALETTE.sky), error.items(), strict=False):
    curve.semilogy(t, values, color, label=label)
k = np.argmin(abs(t - 0.6 * duration))
line = 2 * error["with curvature"][k] * np.exp(-0.3 * alpha * (t - t[k]))
curve.semilogy(t[t > 4], line[t > 4], PALETTE.text, linestyle="--", label="slope of the slow root, −0.3α")
curve.set(xlim=(0, duration), xlabel="t [s]", ylabel="|ṽ − v| / |v|")
curve.set_title("Error of the velocity field in the kinetic-energy norm", loc="left")
curve.legend(frameon=False)
curve.tick_params(labelsize=8)
OUT.mkdir(exist_ok=True)
save_figure(figure, FIGURE)

film, axes = new_figure(1, 2, panel=(2.6, 2.4), titles=("true vorticity", "estimate"))
images = [picture(ax, np.zeros((points, points))) for ax in axes[0]]
clock = film.suptitle("t = 0.0 s", x=0.5)
film.set_dpi(80)
canvas = FigureCanvasAgg(film)
canvas.draw()
film.set_layout_engine("none")  # where everything is stays from now on


def frame(k):
    """The film at stamp k, in 40 colours."""
    clock.set_text(f"t = {t[k]:.1f} s")
    for drawn, v in zip(images, (truth.v, estimates["with curvature"]), strict=True):
        drawn.set_data(np.asarray(maps(v[k : k + 1])[0]).T)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(40, dither=Image.Dither.NONE)


frames = [frame(k) for k in range(0, round(12 / dt) + 1, 8)]
frames[0].save(MOVIE, save_all=True, append_images=frames[1:], duration=100, loop=0)
