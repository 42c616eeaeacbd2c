"""Finds the columns of a ship's log: its pose in the plane, rudder and propeller, and velocities in the body."""

import math
from typing import NamedTuple

import numpy as np

from covariant.calibration.identification._names import DEGREES, EULER, point_in_plane
from covariant.calibration.identification._roles import LogColumns
from covariant.logs import unit_factor, unit_in_name, words_of
from scalargraph.errors import InputError

RUDDER = words_of("rudder helm steering")
PROPELLER = words_of("thrust thruster propeller prop screw rpm rps revolutions throttle")
"""Words of what steers and of what drives a ship."""
VELOCITIES = (words_of("surge u vx"), words_of("sway v vy"), words_of("r yaw yawrate rot"))
"""Words of surge, sway and yaw rate."""
RADIUS, FLATTENING = 6378137.0, 1 / 298.257223563
"""Equatorial radius [m] and flattening of the ellipsoid of WGS 84."""


class ShipColumns(NamedTuple):
    """Columns of a ship's log: two of a position and the heading, its inputs, and its velocities, if all are logged."""

    pose: tuple[str, ...]
    u: tuple[str, ...]
    v: tuple[str, ...]

    def units(self, log: LogColumns) -> dict[str, tuple[str, ...]]:
        """Units of the inputs and velocities."""
        rudder, propeller = self.u
        label = log.labels[propeller]
        # Without a unit a thrust is in N; another number, squared, is in the unit of the coefficient that is fitted.
        drive = unit_in_name(label, ("N", "rad/s")) or ("rpm" if "rpm" in words_of(propeller) else "")
        drive = drive or ("N" if "thrust" in words_of(propeller) else "rad/s")
        steered = "deg" if np.nanmax(np.abs(log[rudder])) > math.pi / 2 else "rad"
        speeds = [unit_in_name(log.labels[name], ("m/s", "rad/s")) for name in self.v]
        usual = ("m/s", "m/s", "rad/s")
        return {
            "u": (log.unit(rudder, "q") or steered, drive),
            "v": tuple(text or meant for text, meant in zip(speeds, usual, strict=False)),
        }


def plane_and_heading(log: LogColumns) -> tuple[str, ...]:
    """The two coordinates of a point in the plane and the heading, if there are all three."""
    words = {name: words_of(name) for name in log.roles if log.roles[name] in ("q", "") and name != log.t}
    plane = point_in_plane(words)
    turns = [name for name in words if words[name] & (EULER[2] | {"theta"}) and name not in (plane or ())]
    return (*plane, turns[0]) if plane and turns else ()


def ship_columns(log: LogColumns) -> ShipColumns | None:
    """The columns of a ship with one rudder and one propeller; None for another machine."""
    names = {name: words_of(name) for name, role in log.roles.items() if role != "left out" and name != log.t}
    rudders, drives = ([name for name in names if names[name] & words] for words in (RUDDER, PROPELLER))
    if len(rudders) != 1 or len(drives) != 1:
        return None
    _refuse_degrees(log, names)
    pose, u = plane_and_heading(log), (rudders[0], drives[0])
    if not pose:
        return None
    rest = {name: words for name, words in names.items() if name not in (*pose, *u)}
    v = [[name for name, words in rest.items() if words & own] for own in VELOCITIES]
    pose = _ahead(log, *pose)
    return ShipColumns(pose, u, tuple(each[0] for each in v) if all(len(each) == 1 for each in v) else ())


def _ahead(log: LogColumns, x: str, y: str, turn: str) -> tuple[str, str, str]:
    """The pose with the axes in the order in which the ship moves ahead: some logs have east before north."""
    usual = "deg" if np.nanmax(log[turn]) - np.nanmin(log[turn]) > DEGREES else "rad"
    heading = log[turn] * unit_factor(log.unit(turn, "q") or usual)
    ahead = np.cos(heading[:-1]) * np.diff(log[x]) + np.sin(heading[:-1]) * np.diff(log[y])
    exchanged = np.cos(heading[:-1]) * np.diff(log[y]) + np.sin(heading[:-1]) * np.diff(log[x])
    return (y, x, turn) if np.nansum(exchanged) > np.nansum(ahead) else (x, y, turn)


def _refuse_degrees(log: LogColumns, names: dict[str, set[str]]) -> None:
    """Raise `ValueError` for latitudes and longitudes, with the line that converts them to metres."""
    lat, lon = (
        next((name for name, words in names.items() if words & own), "")
        for own in ({"lat", "latitude"}, {"lon", "long", "lng", "longitude"})
    )
    if not (lat and lon) or point_in_plane(names):
        return
    first_lat, first_lon = (log[name][np.isfinite(log[name])][0] for name in (lat, lon))
    eccentricity = FLATTENING * (2 - FLATTENING)
    across = RADIUS / math.sqrt(1 - eccentricity * math.sin(math.radians(first_lat)) ** 2)
    along = across**3 * (1 - eccentricity) / RADIUS**2  # radii of curvature of the prime vertical and of the meridian
    north, east = math.radians(along), math.radians(across) * math.cos(math.radians(first_lat))
    raise InputError(
        f"{lat}, {lon} are degrees on the earth: write metres from its first point into the log, as "
        f'frame["north"], frame["east"] = {north:.2f} * (frame[{lat!r}] - {first_lat:.8g}), '
        f"{east:.2f} * (frame[{lon!r}] - {first_lon:.8g})"
    )
