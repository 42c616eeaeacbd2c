"""Fit the parameters of a pendulum to a log by the prediction-error method.

A slow observer (30 rad/s) follows the log; whatever it fails to predict of the next position is the model's fault. The
parameters that make the innovations smallest are the fit. Inertia, gravity torque, friction and a constant torque
offset are fitted; the lag between logged and acting torque is given, since it hardly changes the innovations.

    python examples/fit_simple_pendulum.py examples/dfki_simple_pendulum.toml ddp.csv
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from covariant import logs, models
from covariant.observers import Intrinsic
from covariant.signals import lag_inputs

BANDWIDTH = 30.0
COM = 0.45
"""Distance of the centre of mass [m]: only its product with the mass can be told from a log."""
START = np.array([0.2, 3.8, 0.1, 0.0])
"""Inertia about the joint [kg m²], gravity torque m g l [N m], Coulomb friction as cf·atan(100 v) [N m], offset."""


def pendulum(parameters) -> models.Lagrangian:
    inertia, gravity_torque, coulomb, offset = parameters
    return models.Lagrangian(
        lambda q: inertia * jnp.eye(1),
        lambda q: -gravity_torque * jnp.cos(q[0]),
        lambda t, q, u: u + offset,
        lambda q, v: -coulomb * jnp.arctan(100 * v),
        circles=(0,),
    )


def innovations(parameters, t, u, y):
    observer = Intrinsic(pendulum(parameters), 2**0.5 * BANDWIDTH, BANDWIDTH**2, substeps=4)

    def step(state, sample):
        state, info = observer.step(state, *sample)
        return state, info.innovation[0]

    return jax.lax.scan(step, observer.init(y[0]), (u[:-1], y[1:], jnp.diff(t)))[1]


def main() -> None:
    if len(sys.argv) != 3:
        sys.exit("usage: fit_simple_pendulum.py MODEL.toml LOG.csv")
    file = models.load(sys.argv[1])
    record = lag_inputs(logs.read(sys.argv[2], file.columns).record, file.input_lag)
    t, u, y = (jnp.asarray(a) for a in record[:3])
    predict = jax.jit(lambda p: innovations(p, t, u, y)[50:] * 1e3)  # settled; in mrad
    fit = least_squares(lambda p: np.asarray(predict(p)), START, x_scale=[0.01, 0.1, 0.02, 0.02], diff_step=1e-4)
    inertia, gravity_torque, coulomb, offset = fit.x
    print(f"innovation {np.sqrt(np.mean(fit.fun**2)):.3f} mrad rms")
    print(f"mass = [{gravity_torque / 9.81 / COM:.5g}]  # with com = [{COM}]")
    print(f"inertia = [{inertia:.5g}]\ncoulomb = [{coulomb:.5g}]\noffset = [{offset:.5g}]")


if __name__ == "__main__":
    main()
