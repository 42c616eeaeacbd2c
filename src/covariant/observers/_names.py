"""Names of the observers in the registry, available without loading the observers."""

OBSERVER_NAMES = (
    "intrinsic",
    "intrinsic2",
    "geodesic",
    "implicit-geodesic",
    "copy",
    "intrinsic-kalman",
    "ekf",
    "ukf",
    "filtered-derivative",
    "pll",
    "high-gain",
    "levant",
    "savitzky-golay",
    "joint-kalman",
    "salcudean",
)
"""Names of the entries of `REGISTRY` that are for mechanical systems, which come first, in their order."""
STATE_OBSERVER_NAMES = ("covariance-ekf", "information-ekf", "riccati")
"""Names of the entries of `REGISTRY` that are for state-space models, in their order."""
SMOOTHED = ("intrinsic-kalman", "ekf", "ukf", "joint-kalman", "covariance-ekf")
"""Names of the entries of `REGISTRY` that `smooth` takes: the filters with a covariance and a gate, in their order."""
