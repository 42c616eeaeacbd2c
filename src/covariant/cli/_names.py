"""What the help of the commands names, written down here so that it is shown without loading what it names."""

ESTIMATORS = (
    "intrinsic",
    "intrinsic2",
    "geodesic",
    "copy",
    "ekf",
    "filtered-derivative",
    "savitzky-golay",
    "salcudean",
)
"""As `covariant.design.ESTIMATORS`."""
CERTIFIED = ("intrinsic", "geodesic")
"""As the observers of `covariant.cli._certify`."""
PAPERS = ("aghannan-rouchon", "maithripala", "sanfelice-praly", "jouffroy-fossen")
"""As those of `covariant.cli._reproduce`."""
