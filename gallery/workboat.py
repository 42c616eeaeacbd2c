"""Logs of three workboats in zig-zags: positions by GNSS, a compass, rudder and thrust; one does not hold its course.

Simulated here in NumPy alone, by the equations of Fossen (2011), section 6.5, written out: `python
gallery/workboat.py boat.csv` writes a log, and beside it `boat_circle.csv`, of a turning circle.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

RATE, STEPS, SECONDS = 5.0, 40, 300.0
POSITION_STD, HEADING_STD = 0.01, 0.3
GUST, GUST_TIME = 0.001, 0.5
NAMES = ("time_s", "north_m", "east_m", "heading_deg", "rudder_deg", "thrust_N")


class Hull(NamedTuple):
    """Numbers of a hull, as the parameters of the system `ship`."""

    mass: tuple[float, float, float] = (1650.0, 2300.0, 4200.0)
    drag: tuple[float, float, float] = (60.0, 1500.0, 5000.0)
    quadratic_drag: tuple[float, float, float] = (45.0, 500.0, 3500.0)
    rudder: float = 110.0
    rudder_arm: float = 2.6

    def rates(self, x, rudder, thrust, current):
        """Rates of (north, east, heading, surge, sway, yaw rate), in water that moves at `current` (2,) [m/s]."""
        heading, u, v, r = x[2:]
        c, s = np.cos(heading), np.sin(heading)
        # The hull feels the water: velocities through it, and of a current that changes slowly.
        u, v = u - (c * current[0] + s * current[1]), v - (c * current[1] - s * current[0])
        mx, my, mz = self.mass
        normal = self.rudder * u * abs(u) * np.sin(rudder)
        (du, dv, dr), (qu, qv, qr) = self.drag, self.quadratic_drag
        surge = (thrust - (du + qu * abs(u)) * u - normal * np.sin(rudder) + my * v * r) / mx
        sway = (-(dv + qv * abs(v)) * v - normal * np.cos(rudder) - mx * u * r) / my
        yaw = (self.rudder_arm * normal * np.cos(rudder) - (dr + qr * abs(r)) * r + (mx - my) * u * v) / mz
        # The current is constant in the earth and turns in the body: its rate there is added again.
        turning = r * np.array([c * current[1] - s * current[0], -(c * current[0] + s * current[1])])
        over_ground = c * x[3] - s * x[4], s * x[3] + c * x[4]
        return np.array([*over_ground, r, surge + turning[0], sway + turning[1], yaw])

    def eigenvalue(self, speed):
        """The larger eigenvalue of sway and yaw in straight motion [1/s]; a positive one does not hold course."""
        mx, my, mz = self.mass
        a = [[-self.drag[1] / my, -mx * speed / my], [(mx - my) * speed / mz, -self.drag[2] / mz]]
        return float(np.linalg.eigvals(a).real.max())


HULLS = {
    "workboat": Hull(),
    "barge": Hull((5200.0, 8100.0, 21000.0), (150.0, 4600.0, 32000.0), (130.0, 1900.0, 21000.0), 320.0, 3.4),
    "unstable": Hull(drag=(60.0, 300.0, 900.0), quadratic_drag=(45.0, 700.0, 5200.0)),
}


def sail(hull, seed=0, current=0.0, circle=False, seconds=SECONDS, gust=GUST, turns=0.5):
    """A log of zig-zags as a table (T, 6) of `NAMES`, and the true surge, sway and yaw rate (T, 3).

    The current [m/s] towards north turns by `turns` in the time of the log, and wind and waves accelerate the boat by
    random `gust` [m/s² and rad/s²]. A circle is one of the rudder at 20°.
    """
    random = np.random.default_rng(seed)
    full = 1.6 * (60.0 + 45.0 * 2.5) * hull.mass[0] / 1650.0
    x, side, course, angle = np.array([0.0, 0.0, 0.3, 1.0, 0.0, 0.0]), 1.0, 0.3, 0.0
    thrust, rows, truth, pushed = full, [], [], np.zeros(3)
    fade = np.exp(-1.0 / RATE / GUST_TIME)
    for k in range(int(seconds * RATE) + 1):
        if k % 150 == 0 and k and not circle:
            thrust, course = full * random.uniform(0.3, 1.5), course + random.uniform(-1.0, 1.0)
        if side * (x[2] - course) > np.radians(20.0):
            side = -side
        target = np.radians(20.0) * (1.0 if circle else side)
        angle += np.clip(target - angle, -np.radians(15.0) / RATE, np.radians(15.0) / RATE)
        noise = random.normal(0.0, [POSITION_STD, POSITION_STD, np.radians(HEADING_STD)])
        place = x[:3] + noise
        rows.append([k / RATE, *place[:2], np.degrees(place[2]) % 360.0, np.degrees(angle), thrust])
        truth.append(x[3:])
        turn = 2 * np.pi * turns * k / (seconds * RATE)
        flow = current * np.array([np.cos(turn), np.sin(turn)])
        pushed = fade * pushed + random.normal(0.0, gust * np.sqrt(1 - fade**2), 3)
        h, wind = 1.0 / RATE / STEPS, np.append(np.zeros(3), pushed)
        for _ in range(STEPS):  # the midpoint rule
            middle = x + h / 2 * (hull.rates(x, angle, thrust, flow) + wind)
            x = x + h * (hull.rates(middle, angle, thrust, flow) + wind)
    return np.array(rows), np.array(truth)


def write(path, table):
    np.savetxt(path, table, delimiter=",", header=",".join(NAMES), comments="", fmt="%.6g")


if __name__ == "__main__":
    if sys.argv[1:]:
        target = Path(sys.argv[1])
        write(target, sail(HULLS["workboat"])[0])
        write(target.with_stem(f"{target.stem}_circle"), sail(HULLS["workboat"], 1, circle=True)[0])
