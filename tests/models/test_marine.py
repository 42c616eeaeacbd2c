"""Ships and underwater vehicles: kinematics, energy, one vehicle in Euler angles and on SE(3), published manoeuvres."""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.geometry.lie import SO3, quaternion_from_rotation, rotation_from_quaternion
from covariant.models import marine

CRAFT = {"supply": marine.supply_vessel, "cybership": marine.cybership, "odin": marine.odin}
ANGLES = jnp.array([0.3, -0.5, 2.1])
workboat = runpy.run_path(str(Path(__file__).parents[2] / "gallery" / "workboat.py"))


def test_euler_rotation_turns_by_yaw_then_pitch_then_roll():
    roll, pitch, yaw = (SO3.exp(a * axis) for a, axis in zip(ANGLES, jnp.eye(3), strict=True))
    np.testing.assert_allclose(marine.euler_rotation(ANGLES), yaw @ pitch @ roll, atol=1e-15)
    np.testing.assert_allclose(
        marine.yaw_rotation(ANGLES[2]), marine.euler_rotation(jnp.array([0.0, 0.0, ANGLES[2]])), atol=1e-15
    )


def test_euler_rates_are_those_of_the_rotation():
    omega = jnp.array([0.4, -1.0, 0.7])
    moved = jax.jvp(marine.euler_rotation, (ANGLES,), (marine.euler_rates(ANGLES) @ omega,))[1]
    np.testing.assert_allclose(moved, marine.euler_rotation(ANGLES) @ SO3.hat(omega), atol=1e-14)


def test_quaternion_craft_moves_and_measures_as_the_rotation_does():
    robot = marine.odin(quaternion=True)
    first, second = (
        jnp.concatenate([position, quaternion_from_rotation(SO3.exp(turn))])
        for position, turn in ((jnp.arange(3.0), ANGLES), (jnp.ones(3), ANGLES[::-1]))
    )
    twist = jnp.array([0.2, 0.5, -0.3, 0.4, -1.0, 0.7])
    rate = robot.transform(first) @ twist
    rotation, rotation_rate = jax.jvp(rotation_from_quaternion, (first[3:],), (rate[3:],))
    np.testing.assert_allclose(rate[:3], rotation @ twist[:3], atol=1e-14)
    np.testing.assert_allclose(rotation_rate, rotation @ SO3.hat(twist[3:]), atol=1e-14)
    assert abs(first[3:] @ rate[3:]) < 1e-15  # its length stays
    step = robot.displacement(first, second)
    between = quaternion_from_rotation(rotation.T @ rotation_from_quaternion(second[3:]))
    np.testing.assert_allclose(step[:3], rotation.T @ (second - first)[:3], atol=1e-14)
    np.testing.assert_allclose(step[3:], 2 * between[1:], atol=1e-14)
    euler = marine.odin().restoring(jnp.concatenate([jnp.zeros(3), ANGLES]))
    same = quaternion_from_rotation(marine.euler_rotation(ANGLES))
    np.testing.assert_allclose(robot.restoring(jnp.concatenate([jnp.zeros(3), same])), euler, atol=1e-13)
    roll, pitch, _ = ANGLES
    moment = np.array([np.cos(pitch) * np.sin(roll), np.sin(pitch), 0.0])  # (85)
    np.testing.assert_allclose(euler[3:], 0.05 * 125.0 * 9.81 * moment, atol=1e-13)


@pytest.mark.exhaustive("3")
@pytest.mark.parametrize("n", [3, 6])
def test_coriolis_matrix_does_no_work_and_is_that_of_kirchhoff(n):
    random = np.random.default_rng(n)
    root = random.normal(size=(n, n))
    mass, nu, other = root @ root.T + n * np.eye(n), jnp.asarray(random.normal(size=n)), random.normal(size=n)
    c = marine.coriolis_matrix(mass)(nu)
    np.testing.assert_allclose(c, -c.T, atol=1e-12)
    group = models.underwater_vehicle().group if n == 6 else models.hovercraft().group
    np.testing.assert_allclose(c @ nu, -group.coadjoint(nu, jnp.asarray(mass) @ nu), atol=1e-12)
    assert abs(other @ c @ other) < 1e-10


def test_planar_coriolis_matrix_is_the_printed_one():
    ship = marine.cybership()
    u, v, r = nu = jnp.array([0.7, -0.2, 0.3])
    m = ship.mass
    lateral = m[1, 1] * v + m[1, 2] * r
    expected = jnp.array([[0.0, 0.0, -lateral], [0.0, 0.0, m[0, 0] * u], [lateral, -m[0, 0] * u, 0.0]])
    np.testing.assert_allclose(ship.coriolis(nu), expected, atol=1e-12)  # Fossen 2011, equation (6.99)


def test_a_ship_moves_as_the_one_of_the_gallery_that_is_written_out_in_numpy():
    """Also astern, with the sides of rudder, sway and yaw exchanged, and in a current."""
    random = np.random.default_rng(0)
    for hull in workboat["HULLS"].values():
        for current in (np.zeros(2), random.normal(size=2)):
            numbers = hull.mass, 0.0, hull.drag, hull.quadratic_drag, hull.rudder, hull.rudder_arm
            ship = marine.ship(*numbers, current=current.tolist())
            for _ in range(10):
                x, (rudder, thrust) = random.normal(size=6), random.normal(size=2)
                state = ship.group.exp(jnp.asarray(x[:3])), jnp.asarray(x[3:])
                found = models.acceleration(ship, 0.0, *state, jnp.array([rudder, thrust]))
                expected = hull.rates(x, rudder, thrust, current)[3:]
                np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_a_ship_that_drifts_with_the_water_feels_nothing_and_a_coupled_one_turns_as_in_water_at_rest():
    current = jnp.array([0.4, -0.3])
    ship = marine.ship(coupling=300.0, current=current.tolist())
    g, still = ship.group.exp(jnp.array([0.0, 0.0, 0.7])), jnp.array([0.3, -0.2, 0.5])
    flow = jnp.append(g[:2, :2].T @ current, 0.0)
    np.testing.assert_allclose(models.acceleration(ship, 0.0, g, flow, jnp.zeros(2)), 0.0, atol=1e-15)
    u = jnp.array([0.2, 400.0])
    # Seen from the water the motion is that in water at rest; the velocity of the water turns in the body.
    expected = models.acceleration(marine.ship(coupling=300.0), 0.0, g, still, u)
    expected += still[2] * jnp.array([flow[1], -flow[0], 0.0])
    np.testing.assert_allclose(models.acceleration(ship, 0.0, g, still + flow, u), expected, rtol=1e-12)
    driven = marine.ship((1650.0, 2300.0, 4200.0), propeller=3.0)
    at_rest = models.acceleration(driven, 0.0, jnp.eye(3), jnp.zeros(3), jnp.array([0.4, -2.0]))
    np.testing.assert_allclose(at_rest, [-12.0 / 1650.0, 0.0, 0.0], rtol=1e-12)
    assert (driven.input_names, driven.logged_units["u"]) == (("rudder", "propeller"), ("rad", "rad/s"))
    coupled = marine.ship((1650.0, 2300.0, 4200.0), 200.0)
    nu, m = jnp.array([1.2, -0.4, 0.3]), np.diag([1650.0, 2300.0, 4200.0])
    m[1, 2] = m[2, 1] = 200.0
    with_inertia = m @ models.acceleration(coupled, 0.0, jnp.eye(3), nu, jnp.zeros(2))
    without_drag = with_inertia - models.resistance(coupled, 0.0, jnp.eye(3), nu, jnp.zeros(2))
    np.testing.assert_allclose(without_drag, -marine.coriolis_matrix(m)(nu) @ nu, rtol=1e-12)


@pytest.mark.parametrize("name", CRAFT)
def test_every_parameter_says_where_it_comes_from_and_drag_takes_energy(name):
    craft = CRAFT[name]()
    random = np.random.default_rng(1)
    for nu in random.normal(size=(50, len(craft.coordinates))) * 0.2:
        along = np.array([nu[0], *[0.0] * (len(nu) - 1)]) if name == "cybership" else nu  # identified, sway with yaw
        assert along @ craft.damping(jnp.asarray(along)) @ along > 0
    assert craft.parameters
    assert all(p.source and p.unit for p in craft.parameters.values())


def test_supply_vessel_has_the_published_dimensionless_form():
    bis = marine.supply_vessel(length=1.0, mass=1.0, gravity=1.0)
    full = marine.supply_vessel()
    stretch = np.diag([1.0, 1.0, 76.2])
    np.testing.assert_allclose(full.mass, 6000e3 * stretch @ bis.mass @ stretch)
    rate = np.sqrt(9.81 / 76.2)
    values = [np.linalg.eigvals(np.linalg.solve(c.mass, c.damping(jnp.zeros(3)))) for c in (full, bis)]
    np.testing.assert_allclose(np.sort(values[0]), rate * np.sort(values[1]), rtol=1e-12)
    np.testing.assert_allclose(bis.mass[1, 2], -0.0744)


def test_tanker_refuses_an_unknown_derivative():
    with pytest.raises(ValueError, match=r"unknown entry of hull 'Yvw'\. Did you mean 'Yv"):
        marine.manoeuvring_ship(hull={"Yvw": 1.0})


def test_station_puts_bias_and_thrust_where_they_act():
    station = marine.Station(marine.supply_vessel(), None, bias_time=100.0, thruster_time=5.0)
    assert station.parts == {"eta": slice(0, 3), "nu": slice(3, 6), "bias": slice(6, 9), "thrust": slice(9, 12)}
    x = jnp.zeros(12).at[2].set(np.pi / 2).at[6:9].set(jnp.array([6e6, 0.0, 0.0]))
    rate = station.model().f(jnp.zeros(()), x, jnp.array([5.0, 0.0, 0.0]))
    assert rate[4] < -0.3  # a force to the north pushes a ship that points east to port
    np.testing.assert_allclose(rate[6:9], -x[6:9] / 100.0)
    np.testing.assert_allclose(rate[9:], [1.0, 0.0, 0.0])


BAD = {
    "mass not symmetric": (
        lambda: marine.surface_ship([[1.0, 1.0, 0], [0, 1.0, 0], [0, 0, 1.0]], np.eye(3)),
        "symmetric",
    ),
    "mass not positive": (lambda: marine.surface_ship(-np.eye(3), np.eye(3)), "mass must be positive definite"),
    "mass not square": (lambda: marine.surface_ship(np.eye(2), np.eye(3)), "mass must be a matrix of 3 rows"),
    "waves": (lambda: marine.Waves((0.8, 0.0, 0.8), (0.1,) * 3, (1.0,) * 3), "frequency needs three positive numbers"),
    "craft in space": (lambda: marine.Station(marine.odin()), "a station needs a ship in the plane"),
    "time": (lambda: marine.Station(marine.supply_vessel(), bias_time=-1.0), "bias_time must be positive"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_ships_are_refused_in_one_line(case):
    make, message = BAD[case]
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
