from ._craft import (
    Craft as Craft,
    coriolis_matrix as coriolis_matrix,
    euler_rates as euler_rates,
    euler_rotation as euler_rotation,
    euler_transform as euler_transform,
    positive_definite as positive_definite,
    yaw_rotation as yaw_rotation,
)
from ._dynamic_positioning import Station as Station, Waves as Waves
from ._manoeuvring import manoeuvring_ship as manoeuvring_ship
from ._odin import odin as odin
from ._ship import ship as ship
from ._ships import cybership as cybership, supply_vessel as supply_vessel, surface_ship as surface_ship

__all__ = ["Craft", "Station", "Waves", "euler_rotation", "odin", "supply_vessel"]
