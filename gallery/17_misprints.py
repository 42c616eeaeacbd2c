"""Four misprints, and what they do: the formula of a paper as printed, beside the corrected one.

Four papers describe the observers of this library, and all of them have misprints. Some are seen at once, as a matrix
that does not fit. These four are not: the code runs, and the estimate is wrong, or right for the wrong reason. The sign
of a curvature term makes an observer diverge slowly. Another one does no harm on an elongated top, whose curvature is
positive, and ruins the estimate on a tumbling disc. A stopping rule leaves every entry of a metric right to 1e-3, and
the metric several hundred times too large in one direction. A theorem calls an observer contracting whose error grows.
`covariant.papers.errata` lists all of them, each with the test that shows it.

Sources: Aghannan & Rouchon 2003, (14); Maithripala, Berg & Dayawansa 2004, (8) and (18); Sanfelice & Praly 2015,
figure 1; Jouffroy & Fossen 2004, Theorem 2.

Figure: (14) as printed is off by 510 after 40 s, corrected by 1.4e-10; entries of the metric are right to 0.001 and
its distance is 6.6; Theorem 2 promises −2.5 1/s, and +0.5 1/s happens.
"""

from pathlib import Path

import numpy as np
import scipy.linalg

from covariant.papers import aghannan_rouchon, jouffroy_fossen, maithripala, sanfelice_praly
from covariant.report import PALETTE, new_figure, save_figure

FIGURE = Path(__file__).parent / "out" / "17_misprints.png"
PRINTED, CORRECTED = (
    {"color": PALETTE.purple, "label": "as printed"},
    {"color": PALETTE.covariant, "label": "corrected"},
)

titles = (
    "Ball and beam, (14): curvature terms",
    "Tumbling disc, (8), (18): curvature",
    "Metric at λ = 8 1/s: when to stop",
    "Theorem 2: is it contracting?",
)
figure, axes = new_figure(2, 2, panel=(4.5, 3.4), titles=titles, sharex=False)
beam, disc, metric, theorem = axes.flat

t = np.linspace(0.0, 40.0, 401)
observers = aghannan_rouchon.figure4_observers()
for key, look in (("printed14", PRINTED), ("corrected14", CORRECTED)):
    error = aghannan_rouchon.figure4(observers[key], t, rtol=1e-8).error
    beam.semilogy(t, np.where(np.isfinite(error), error, np.nan), **look)
    print(f"(14) {look['label']}: error {error[100]:.2g} after 10 s, {error[-1]:.2g} after 40 s")

t = np.linspace(0.0, 10.0, maithripala.POINTS)
for make, look in ((maithripala.printed, PRINTED), (maithripala.corrected(True), CORRECTED)):
    error = maithripala.follow(maithripala.DISC, maithripala.TUMBLING, make, t).error
    disc.semilogy(t, error, **look)
    print(f"(8), (18) {look['label']}: error {error[-1]:.2g} rad/s after 10 s")

curves = sanfelice_praly.figure1(8.0)
metric.semilogy(curves["t"], curves["entry"], color=PALETTE.purple, label="as published: largest error of an entry")
# The affine-invariant distance is at least |log| of the largest generalised eigenvalue: a factor of 715 is 6.6.
metric.semilogy(curves["t"], curves["distance"], color=PALETTE.covariant, label="in truth: affine-invariant distance")
print(f"metric: entries are right to {curves['entry'][-1]:.1g}, and the distance is {curves['distance'][-1]:.2g}")

case = jouffroy_fossen.COUNTEREXAMPLES["called contracting, diverges slowly"]
# Plant and observer with the same input u = gx̂: x' = ax + bgx̂, x̂' = ax̂ + bgx̂ + k(x − x̂).
loop = np.array([[case.a, case.b * case.g], [case.k, case.a + case.b * case.g - case.k]])
t = np.linspace(0.0, 6.0, 61)
states = np.stack([scipy.linalg.expm(loop * s) @ (1.0, 0.0) for s in t])
error = np.abs(states[:, 0] - states[:, 1])
theorem.semilogy(t, np.exp(case.printed * t), color=PALETTE.purple, label=f"promised: e^({case.printed:+.1f} t)")
theorem.semilogy(t, error, color=PALETTE.covariant, label=f"what happens: e^({case.true:+.1f} t)")
print(f"Theorem 2: promised {case.printed:+.1f} 1/s, measured {np.polyfit(t, np.log(error), 1)[0]:+.2f} 1/s")

beam.set(xlabel="t [s]", ylabel="|(q̂ − q, v̂ − v)|", ylim=(1e-10, 1e3))
disc.set(xlabel="t [s]", ylabel="|ω̂ − ω| [rad/s]")
metric.set(xlabel="t [s], the metric is used at 0")
theorem.set(xlabel="t [s]", ylabel="|x̂ − x|", ylim=(1e-4, 1e2))
for ax in axes.flat:
    ax.legend()
FIGURE.parent.mkdir(exist_ok=True)
save_figure(figure, FIGURE)
