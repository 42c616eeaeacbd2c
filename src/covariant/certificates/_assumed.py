"""What a certificate rests on that no machine has checked."""

ASSUMED = (
    "the true motion solves the model, keeps to the region of positions, and to the bounds of velocities, inputs and "
    "times",
    "the observer runs in continuous time",
    "the measured positions are exact up to the stated bound of the noise",
    "coordinates that the model calls circles are periodic",
    "the code of the model is read as exact functions of real numbers, with its constants as they were computed",
    "the running observer does not round",
    "trusted are JAX's tracing, the description of the observer that prover and checker share, and IEEE doubles in "
    "NumPy: + − × ÷ √ and products of matrices",
)
"""Lines that `covariant certify --check` ends with."""
