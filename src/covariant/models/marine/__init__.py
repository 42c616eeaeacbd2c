"""Ships and underwater vehicles, with parameters that name their sources."""

from covariant.models.marine._craft import (
    Craft,
    coriolis_matrix,
    euler_rates,
    euler_rotation,
    euler_transform,
    positive_definite,
    yaw_rotation,
)
from covariant.models.marine._dynamic_positioning import Station, Waves
from covariant.models.marine._manoeuvring import manoeuvring_ship
from covariant.models.marine._odin import odin, odin_on_group
from covariant.models.marine._ships import cybership, supply_vessel, surface_ship

__all__ = [
    "Craft",
    "Station",
    "Waves",
    "coriolis_matrix",
    "cybership",
    "euler_rates",
    "euler_rotation",
    "euler_transform",
    "manoeuvring_ship",
    "odin",
    "odin_on_group",
    "positive_definite",
    "supply_vessel",
    "surface_ship",
    "yaw_rotation",
]
