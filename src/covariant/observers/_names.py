"""Lists the names of the observers in the registry, without loading the observers."""

OBSERVER_NAMES = (
    "intrinsic",
    "intrinsic2",
    "intrinsic-force",
    "geodesic",
    "lagrangian-metric",
    "measured-coefficients",
    "copy",
    "intrinsic-kalman",
    "ekf",
    "ukf",
    "filtered-derivative",
    "pll",
    "pll3",
    "high-gain",
    "levant",
    "savitzky-golay",
    "joint-kalman",
    "tracking-loop",
    "salcudean",
)
"""Names of the first entries of `REGISTRY`, for mechanical systems, in the order of the registry."""
STATE_OBSERVER_NAMES = ("covariance-ekf", "information-ekf", "riccati", "legged-base")
"""Names of the entries of `REGISTRY` for state-space models, in the order of the registry."""
SMOOTHED = ("intrinsic-kalman", "ekf", "ukf", "joint-kalman", "covariance-ekf")
"""Names of the entries of `REGISTRY` that `smooth` accepts, the filters with a covariance and a gate, in order."""
