"""A controller that never sees a velocity: an underwater robot follows a path in six degrees of freedom.

Positions and attitudes are measured; the velocities that the backstepping controller needs come from a contracting
observer, a copy of the robot with output injection. Jouffroy & Fossen (2004) print its gain as K2 = I − K_p, which
makes the true error unstable; with a symmetric positive definite K2 the observer contracts in a metric with a cross
term, at a rate that `proofs.prove_at_corners` proves over a set of attitudes and velocities. The paper's
condition for the two together depends on the units it is written in; the weighted one does not, and holds for any
coupling of this form.
"""

from pathlib import Path

from covariant.papers import jouffroy_fossen as paper

OUT = Path(__file__).parent / "out"
OUT.mkdir(exist_ok=True)

loop = paper.odin_loop()
print(
    f"certified {paper.RATE / 2:g} 1/s; measured: observer {paper.tail_rate(loop.t, loop.observer):.2f} 1/s, "
    f"tracking {paper.tail_rate(loop.t, loop.tracking):.2f} 1/s"
)
paper.draw_odin(loop, OUT / "11_output_feedback.png")
