"""What is proved is the step that runs: at which sample intervals, and with how many samples lost.

A microcontroller does not run a flow in continuous time. It predicts with the model in a few Runge–Kutta steps, and
corrects when a sample comes, which may be late or never come. `certificates.certify` with `interval` proves that this
step brings the estimate of a pendulum nearer to the truth, at any interval within a range and with samples missing, and
that the errors of the Runge–Kutta steps do not spoil it. The figure shows the rate that is proved beside the
slowest one that the step really has, at many states of the region, up to intervals at which errors grow.

Figure: 1.86 to 1.98 1/s are proved for intervals from 1 to 50 ms, where the slowest rate found at 400 states is 5
1/s.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from covariant import certificates, models
from covariant.observers import Intrinsic
from covariant.report import PALETTE, new_figure, save_figure

OUT = Path(__file__).parent / "out"
OUT.mkdir(exist_ok=True)
BOUNDS = {"position": (-3.0, 3.0), "velocity": 4.0, "error": 0.1, "input": 0.5}
pendulum = models.Lagrangian(  # 1 kg on .5 m
    lambda q: jnp.array([[0.25]]), lambda q: -0.25 * 19.62 * jnp.cos(q[0]), coordinates=("q",), circles=(0,)
)


OBSERVER = Intrinsic(pendulum, 10.0, 50.0, substeps=4)


def proved(shortest: float, longest: float, lost: int = 0) -> float:
    certificate = certificates.certify(
        OBSERVER, **BOUNDS, rate=4.0, interval=(shortest, longest), lost=lost, checker="off", boxes=20_000
    )
    rate = float(certificate.decay) if certificate.statement.verdict == "holds" else 0.0
    print(f"{1e3 * shortest:g} to {1e3 * longest:g} ms, {lost} lost: ", end="")
    print(
        f"{certificate.statement.verdict}, {rate:.3g} 1/s, {certificate.boxes} boxes, steady {certificate.steady:.2g}"
    )
    return rate


@jax.jit
def slowest(h: jax.Array) -> jax.Array:
    """Rate [1/s] of the slowest eigenvalue of a step over h at the truth, over states of the region."""
    states = jax.random.uniform(jax.random.key(0), (400, 3), minval=-1.0) * jnp.array([3.0, 4.0, 0.5])

    def rate(z):
        def step(x):
            state = OBSERVER.init(x[:1])._replace(q=x[:1], v=x[1:])
            new = OBSERVER.step(state, z[2:], truth[:1], h)[0]
            return jnp.concatenate([new.q, new.v])

        moved = OBSERVER.predict(OBSERVER.init(z[:1])._replace(q=z[:1], v=z[1:2]), z[2:], h)
        truth = jnp.concatenate([moved.q, moved.v])
        # The correction has no derivative at the truth itself; a difference close to it has.
        columns = [(step(z[:2] + off) - step(z[:2] - off)) / 2e-6 for off in 1e-6 * jnp.eye(2)]
        jacobian = jnp.stack(columns, 1)
        half, determinant = jnp.trace(jacobian) / 2, jnp.linalg.det(jacobian)
        root = jnp.sqrt((half**2 - determinant).astype(complex))
        return -jnp.log(jnp.maximum(jnp.abs(half + root), jnp.abs(half - root))) / h

    return jnp.min(jax.vmap(rate)(states))


figure, axes = new_figure(1, 1, panel=(7.2, 3.6), titles=["The sampled observer of a pendulum, alpha = 10, beta = 50"])
panel = np.ravel(axes)[0]
intervals = np.geomspace(1e-3, 0.4, 40)
rates = np.array([float(slowest(jnp.asarray(h))) for h in intervals])
panel.plot(1e3 * intervals, rates, color=PALETTE.truth, lw=3, label="slowest found at 400 states")
for k, (shortest, longest) in enumerate([(0.001, 0.005), (0.005, 0.02), (0.02, 0.05)]):
    label = "proved for every interval in the bar's width" if k == 0 else None
    width = [1e3 * shortest, 1e3 * longest]
    panel.fill_between(width, 0, proved(shortest, longest), color=PALETTE.covariant, alpha=0.5, lw=0, label=label)
panel.plot(
    [10, 36],
    [proved(0.01, 0.012, lost=2)] * 2,
    color=PALETTE.purple,
    lw=3,
    label="proved, 10 to 12 ms, up to 2 samples lost",
)
panel.axhline(0.0, color=PALETTE.truth, lw=0.8)
panel.set(xscale="log", xlabel="time since the last sample [ms]", ylabel="rate [1/s]", ylim=(-1.0, 1.1 * rates.max()))
panel.legend(loc="upper right", bbox_to_anchor=(0.85, 0.9))
print("wrote", save_figure(figure, OUT / "18_what_runs_is_what_is_proved.png"))
