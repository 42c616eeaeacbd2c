"""Lists the assumptions of a certificate that no computation checks."""

ASSUMED = (
    "the true motion solves the model, keeps to the region of positions, and to the bounds of velocities, inputs and "
    "times",
    "the observer runs in continuous time",
    "the measured positions are exact up to the stated bound of the noise",
    "without an error the observer moves as the model",
    "the code of the model is read as exact functions of real numbers, with its constants as they were computed",
    "the running observer does not round",
    "Stumpff's functions and logarithms of rotations are read as what they approximate",
    "trusted are JAX's tracing, the reading of its jaxprs and the description of the observer, which prover and "
    "checker share, IEEE doubles in NumPy, + − × ÷ √ and products of matrices, and what is argued on paper: Theorem 1, "
    "and contraction of Lipschitz flows",
)
"""The lines that `covariant certify --check` prints last."""
ASSUMED_WITH_SAMPLES = (
    "the true motion solves the model, with the input that the observer is given and up to the stated unknown force, "
    "and keeps to the region of positions, and to the bounds of velocities and inputs",
    "measurements are exact up to the stated bound of the noise, of all coordinates unless they are lost, and come at "
    "the stated times, which are known exactly",
    *ASSUMED[4:7],
    "trusted are JAX's tracing, the reading of its jaxprs and the description of the observer, which prover and "
    "checker share, IEEE doubles in NumPy, + − × ÷ √ and products of matrices, and what is argued on paper: that the "
    "two inequalities compose, and contraction of Lipschitz maps",
)
"""The same lines for observers with sampled measurements."""
PREDICTIONS = (
    "predictions solve the model exactly: errors of the Runge–Kutta steps are not covered. They may be proved for a "
    "fixed number of substeps, and where friction is steep, as atan(100 v), for many more of them and more boxes"
)
"""A further line if no claim "prediction" bounds the errors of predictions."""
SMOOTH_FACTOR = (
    "corrections are those of first order in the missing acceleration: the division by 1 + s/18, and a restart where "
    "s > (π/2)², are not covered for errors of second order"
)
"""A further line if no claim "missing" bounds the factor of the correction."""
