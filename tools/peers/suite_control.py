"""python-control's vertical take-off aircraft with an observer of this library in its loop.

The plant is python-control's: the equations and numbers of its example `pvtol`, in NumPy. It designs the state feedback
(`lqr`) and an estimator of its own (`lqe`), connects the systems and integrates them.

Source: Åström & Murray 2021, Feedback Systems, second edition, example 3.12; python-control, examples/pvtol.py.
"""

import control
import jax
import jax.numpy as jnp
import numpy as np
from outcome import Outcome, command_line

from covariant import codegen, models
from covariant.observers import Intrinsic
from covariant.simulation import observe

jax.config.update("jax_enable_x64", True)
MASS, MOMENT, ARM, GRAVITY, DRAG = 4.0, 0.0475, 0.25, 9.8, 0.05
NAMES = ("x", "y", "theta")
STATES = (*NAMES, *(f"{name}_dot" for name in NAMES))
HOVER, TARGET = np.array([0.0, MASS * GRAVITY]), np.array([1.0, 0.5, 0.0, 0.0, 0.0, 0.0])
START = np.array([0.0, 0.0, 0.1, 0.4, -0.3, 0.2])
STAMPS = np.linspace(0.0, 10.0, 101)


def rates(t, x, u, params):
    """Equations of motion as in python-control's example, without its limits of the thrust, which are not reached."""
    c, s = np.cos(x[2]), np.sin(x[2])
    forward = (u[0] * c - u[1] * s - DRAG * x[3]) / MASS
    upward = (u[0] * s + u[1] * c - MASS * GRAVITY - DRAG * x[4]) / MASS
    return np.array([*x[3:], forward, upward, ARM * u[0] / MOMENT])


def aircraft():
    """The same as a mechanical system of this library."""

    def thrust(t, q, u):
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        return jnp.stack([u[0] * c - u[1] * s, u[0] * s + u[1] * c, ARM * u[0]])

    return models.Lagrangian(
        lambda q: jnp.diag(jnp.array([MASS, MASS, MOMENT])),
        lambda q: MASS * GRAVITY * q[1],
        thrust,
        lambda q, v: -DRAG * v * jnp.array([1.0, 1.0, 0.0]),
        coordinates=NAMES,
        units=("m", "m", "rad"),
        inputs=2,
    )


def main() -> None:
    """The plants are equal, so are the loops, and the loop reaches its target."""
    arguments = command_line()
    outcome = Outcome(f"control {control.__version__}")
    model = aircraft()
    states = models.state_space(model)
    plant = control.nlsys(
        rates, lambda t, x, u, params: x, inputs=["u1", "u2"], outputs=list(STATES), states=list(STATES), name="pvtol"
    )
    mine = codegen.plant(states)

    rng = np.random.default_rng(0)
    apart = [
        np.abs(plant.dynamics(0.0, x, u) - mine.dynamics(0.0, x, u)).max()
        for x, u in zip(rng.normal(size=(50, 6)), HOVER + rng.normal(size=(50, 2)), strict=True)
    ]
    outcome.close("equations of motion at 50 states", float(max(apart)), 1e-11)
    theirs, ours = (control.linearize(system, np.zeros(6), HOVER) for system in (plant, mine))
    outcome.close("A of control.linearize", float(np.abs(theirs.A - ours.A).max()), 1e-5)
    outcome.close("B of control.linearize", float(np.abs(theirs.B - ours.B).max()), 1e-5)
    a, _ = states.jacobians(jnp.zeros(()), jnp.zeros(6), jnp.asarray(HOVER))
    outcome.close("A by differentiation beside control.linearize", float(np.abs(theirs.A - a).max()), 1e-5)

    gain, _, _ = control.lqr(theirs.A, theirs.B, np.diag([100, 10, 180, 1, 1, 5]), np.diag([10, 1]))
    observer = Intrinsic(model, 12.0, 60.0)
    estimator = codegen.observer_system(observer, states, START[:3])

    def feedback(estimate):
        return HOVER - gain @ (estimate - TARGET)

    def loop(system):
        """Plant, feedback and an estimator whose outputs are named as those of `observer_system`."""
        labels = [f"observer_{name}" for name in STATES]
        controller = control.nlsys(
            None, lambda t, x, u, params: feedback(u), inputs=labels, outputs=["u1", "u2"], name="feedback"
        )
        return control.interconnect(
            [plant, system, controller], inputs=[], outlist=[*STATES, *labels], outputs=[*STATES, *labels]
        )

    def simulated(system, start):
        response = control.input_output_response(
            loop(system), STAMPS, 0.0, [*START, *start], solve_ivp_kwargs={"rtol": 1e-9, "atol": 1e-11}
        )
        return response.outputs[:6].T, response.outputs[6:].T

    x, estimate = simulated(estimator, estimator.initial)
    first = observer.init(jnp.asarray(START[:3]))
    own, state = observe(
        states, observer, jnp.asarray(START), first, jnp.asarray(STAMPS),
        controller=lambda t, y, estimate: jnp.asarray(HOVER) - jnp.asarray(gain) @ (estimate - jnp.asarray(TARGET)),
    )  # fmt: skip
    outcome.close("states of the loop beside the simulation here", float(np.abs(x - own).max()), 1e-6)
    estimated = np.asarray(jax.vmap(observer.estimate)(state))
    outcome.close("estimates of the loop beside the simulation here", float(np.abs(estimate - estimated).max()), 1e-6)
    outcome.close("distance to the target after 10 s", float(np.abs(x[-1] - TARGET).max()), 0.02)
    outcome.close("error of the estimate after 10 s", float(np.abs(x[-1] - estimate[-1]).max()), 1e-6)

    c_matrix = np.eye(3, 6)
    kalman, _, _ = control.lqe(theirs.A, np.eye(6, 3, -3), c_matrix, np.eye(3), 1e-4 * np.eye(3))
    linear = control.nlsys(
        lambda t, z, s, params: theirs.A @ z + theirs.B @ (s[:2] - HOVER) + kalman @ (s[2:] - c_matrix @ z),
        lambda t, z, s, params: z,
        inputs=["u1", "u2", *NAMES], outputs=[f"observer_{name}" for name in STATES], states=6, name="observer",
    )  # fmt: skip
    y, other = simulated(linear, [*START[:3], 0.0, 0.0, 0.0])
    rows = [
        (who, *(f"{np.sqrt(np.mean((a - b)[:, 3:] ** 2)):.2e}" for a, b in ((p[:20], e[:20]), (p[20:], e[20:]))),
         f"{np.abs(p[-1] - TARGET).max():.1e}")
        for who, p, e in (("`Intrinsic` here", x, estimate), ("`control.lqe`, linear", y, other))
    ]  # fmt: skip
    head = ("estimator", "RMS velocity error, first 2 s", "RMS velocity error, after 2 s", "distance to the target")
    outcome.table("The loop with either estimator", head, rows, "SI units; the same plant and feedback, exact samples.")
    outcome.write(arguments.out)


if __name__ == "__main__":
    main()
