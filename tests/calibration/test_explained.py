"""What columns are to each other: attitudes, poses, velocities, inputs; and that all questions are asked at once.

Names are drawn from those that people and drives use, in any order.
"""

import numpy as np
import pandas
import pytest
from scipy.spatial.transform import Rotation

from covariant import models
from covariant.calibration import draft

T = np.arange(800) * 0.01
ANGLE = 0.6 * np.sin(2 * T)
RATE = 1.2 * np.cos(2 * T)
PUSH = np.sin(5 * T)
TURNS = np.stack([0.5 * np.sin(T), 0.3 * np.sin(1.3 * T), 0.4 * np.cos(0.7 * T)], axis=1)
BODY = Rotation.from_euler("ZYX", TURNS)
X, Y, HEADING = 0.01 * np.cumsum(np.cos(0.2 * T)), 0.01 * np.cumsum(np.sin(0.2 * T)), 0.2 * T
DRAWS = range(10)


def shuffled(random, columns):
    names = list(columns)
    random.shuffle(names)
    return {name: columns[name] for name in names}


@pytest.mark.parametrize("seed", DRAWS)
def test_four_numbers_of_an_attitude_are_one_in_any_order_of_names(seed):
    random = np.random.default_rng(seed)
    names = [
        *(
            ("qw", "qx", "qy", "qz"),
            ("q_w", "q_x", "q_y", "q_z"),
            ("W", "X", "Y", "Z"),
            ("q[0]", "q[1]", "q[2]", "q[3]"),
        ),
        *(("quat_real", "quat_i", "quat_j", "quat_k"), ("rot/w", "rot/x", "rot/y", "rot/z"), ("Q1", "Q2", "Q3", "Q4")),
        ("pose.orientation.w", "pose.orientation.x", "pose.orientation.y", "pose.orientation.z"),
    ][seed % 8]
    numbers = np.roll(BODY.as_quat(), 1, axis=1).T
    columns = shuffled(random, {"time": T, **dict(zip(names, numbers, strict=True)), "temp": 20 + 0 * T})
    assert draft(columns).quaternion == names


@pytest.mark.parametrize("seed", DRAWS)
def test_angles_about_three_axes_are_an_attitude_and_get_the_line_that_converts_them(seed):
    random = np.random.default_rng(seed)
    names = [
        ("roll", "pitch", "yaw"),
        ("Roll", "Pitch", "Yaw"),
        ("phi", "theta", "psi"),
        ("att_roll", "att_pitch", "heading"),
    ]
    (x, y, z), factor = names[seed % 4], [1.0, 180 / np.pi][seed % 2]
    columns = {
        "time": T,
        x: factor * TURNS[:, 2],
        y: factor * TURNS[:, 1],
        z: factor * TURNS[:, 0] % (2 * np.pi * factor),
    }
    with pytest.raises(ValueError, match="are the angles of a body that turns, and no joints") as error:
        draft(shuffled(random, columns))
    line = str(error.value).partition("as frame")[2].partition(", or name")[0]
    frame = pandas.DataFrame(columns)
    import scipy.spatial.transform

    exec("frame" + line, {"scipy": scipy, "frame": frame})
    turned = Rotation.from_quat(frame[["qx", "qy", "qz", "qw"]].to_numpy())
    assert np.abs((turned.inv() * BODY).magnitude()).max() < 1e-9
    assert draft({name: frame[name].to_numpy() for name in ("time", "qx", "qy", "qz", "qw")}).quaternion[0] == "qw"
    assert draft(columns, {"q": [x, y, z]}).q == (x, y, z)


@pytest.mark.parametrize("seed", DRAWS)
def test_a_pose_in_the_plane_is_that_of_a_craft_whose_systems_are_named(seed):
    random = np.random.default_rng(seed)
    place = [("x", "y"), ("north", "east"), ("pos_x", "pos_y"), ("px", "py"), ("x_m", "y_m")][seed % 5]
    heading = ["heading", "yaw", "psi"][seed % 3]
    inputs = [("rudder_port", "rudder_starboard", "rpm"), ("tau_x", "tau_y", "tau_n")][seed % 2]
    columns = dict(zip((*place, heading), (X, Y, HEADING), strict=True))
    columns |= {"dvl_u": 1 + 0 * T, "dvl_v": 0 * T} | {name: np.sin((k + 2) * T) for k, name in enumerate(inputs)}
    names = ", ".join((*place, heading))
    with pytest.raises(ValueError, match=f"{names} are the pose of a craft in the plane, and no joints") as error:
        draft({"time": T} | shuffled(random, columns))
    for system in ("ship", "manoeuvring_ship", "supply_vessel", "cybership", "hovercraft"):
        assert models.load(system).name == system
        assert f'"{system}"' in str(error.value)
    assert draft({"time": T} | columns, {"q": [*place, heading], "u": []}).q == (*place, heading)


@pytest.mark.parametrize("seed", DRAWS)
def test_a_ship_is_drafted_from_the_names_of_its_logger(seed):
    random = np.random.default_rng(seed)
    place = [("north", "east"), ("x_m", "y_m"), ("N [m]", "E [m]"), ("easting", "northing"), ("px", "py")][seed % 5]
    heading = ["heading", "yaw_deg", "hdg [deg]", "psi"][seed % 4]
    factor = 180 / np.pi if "deg" in heading or seed % 8 == 4 else 1.0
    rates = [("surge", "sway", "r"), ("dvl_u", "dvl_v", "yaw_rate_deg_s"), ()][seed % 3]
    rudder, drive = [("rudder", "rpm"), ("rudder_deg", "thrust_N"), ("helm [rad]", "thrust [kN]")][seed % 3]
    turn = 0.05 * T**2 + 0.2 * T  # rad, more than half a turn
    north, east = 0.01 * np.cumsum(np.cos(turn)), 0.01 * np.cumsum(np.sin(turn))
    swapped = place[0] == "easting" or seed == 6
    path = (east, north) if swapped else (north, east)
    columns = dict(zip((*place, heading), (*path, factor * turn % (2 * np.pi * factor)), strict=True))
    columns |= {name: np.sin((k + 1) * T) for k, name in enumerate(rates)}
    columns |= {rudder: 0.3 * np.sign(np.sin(T)), drive: 1 + 0 * T, "true_surge": 1 + 0 * T, "temp": 0 * T}
    found = draft({"time": T} | shuffled(random, columns))
    expected = place[::-1] if swapped else place
    assert (found.is_ship, found.q, found.u, found.v) == (True, (*expected, heading), (rudder, drive), rates)
    assert found.units.get("angle") == (("deg",) if factor > 1 else None)
    assert found.units["u"] == [("rad", "rpm"), ("deg", "N"), ("rad", "kN")][seed % 3] if seed % 3 else True
    del columns[drive]
    with pytest.raises(ValueError, match="are the pose of a craft in the plane, and no joints"):
        draft({"time": T} | columns)


def test_latitude_and_longitude_get_the_line_that_converts_them():
    north, east = 100 * np.sin(T), 250 * (1 - np.cos(T))
    # The metre of the mean latitude, by arcs of the meridian and of the parallel (Snyder 1987, table of WGS 84).
    lat, lon = 60.0 + north / 111412.0, 5.0 + east / 55800.0
    columns = {"time": T, "lat": lat, "lon": lon, "heading": T, "rudder": np.sin(T), "rpm": 500 + 0 * T}
    with pytest.raises(ValueError, match="degrees on the earth") as error:
        draft(columns)
    frame = pandas.DataFrame(columns)
    exec(str(error.value).partition(", as ")[2].partition("; ")[0], {"frame": frame})
    np.testing.assert_allclose(frame["north"] - frame["north"][0], north, atol=0.02)
    np.testing.assert_allclose(frame["east"] - frame["east"][0], east, atol=0.05)
    assert draft({name: frame[name].to_numpy() for name in frame if name not in ("lat", "lon")}).is_ship


@pytest.mark.parametrize("name", ["rudder_deg", "flap_deg", "elevator [deg]", "fin_angle_deg", "steering_deg"])
def test_what_moves_in_steps_and_has_no_velocity_is_an_input(name):
    steps = 20 * np.sign(np.sin(0.9 * T))
    found = draft({"time": T, "heading_deg": np.degrees(ANGLE) % 360, "rate_deg_s": np.degrees(RATE), name: steps})
    assert (found.q, found.u, found.v) == (("heading_deg",), (name,), ("rate_deg_s",))


PRODUCTS = {
    "moteus": {
        "position": ANGLE,
        "velocity": RATE,
        "torque": PUSH,
        "q_current": RATE,
        "d_current": RATE,
        "mode": 10 + 0 * T,
    },
    "ODrive": {
        "pos_estimate": ANGLE,
        "vel_estimate": RATE,
        "input_torque": PUSH,
        "iq_measured": RATE,
        "bus_voltage": 24 + 0 * T,
    },
    "a driver of ROS": {"joint/position": ANGLE, "joint/velocity": RATE, "joint/effort": PUSH},
    "RTDE": {"actual_q_0": ANGLE, "actual_qd_0": RATE, "actual_current_as_torque_0": PUSH, "actual_current_0": RATE},
    "SimpleFOC": {"theta": ANGLE, "velocity": RATE, "torque": PUSH, "i_q": RATE, "i_d": RATE, "u_q": PUSH},
}


@pytest.mark.parametrize("product", PRODUCTS)
@pytest.mark.parametrize("prefix", ["", "axis0.", "left/"])
def test_names_of_drives_say_what_they_mean(product, prefix):
    columns = {prefix + name: column for name, column in PRODUCTS[product].items()}
    found = draft({"timestamp": T} | columns)
    names = list(columns)
    assert (found.q, found.v, found.u) == ((names[0],), (names[1],), (names[2],))
    assert found.units.get("q") == (("turn",) if product in ("moteus", "ODrive") else None)


@pytest.mark.parametrize(("word", "velocity"), [("w", "vel"), ("qd", "speed"), ("omega", "dq")])
@pytest.mark.parametrize("factor", [0.0437, 180 / np.pi, -1.0])
def test_of_two_velocities_the_slope_is_one_and_the_other_is_named(word, velocity, factor):
    found = draft({"t": T, "q1": ANGLE, "tau": PUSH, word: RATE, velocity: factor * RATE})
    assert found.v == (word,)
    assert any(f"{velocity} is {factor:.3g} times the slope of q1" in each for each in found.remarks)


def test_a_torque_beside_a_command_is_not_the_input_of_the_joint():
    q = np.interp(T - 0.05, T, ANGLE)
    for name in ("tau_ff", "torque_feedforward", "effort_ff"):
        found = draft({"t": T, "q": q, "q_des": ANGLE, name: PUSH})
        assert found.u == ("q_des",)
        assert any(f"q_des + {name} / k" in each for each in found.remarks)
    assert draft({"t": T, "q": ANGLE, "tau_ff": PUSH}).u == ("tau_ff",)


def test_nothing_is_an_input_because_it_is_left_over():
    random = np.random.default_rng(0)
    others = {name: random.normal(size=T.size) for name in ("a", "flow", "battery", "mode", "rssi", "fix", "seq2")}
    found = draft({"t": T, "q1": ANGLE} | others)
    assert (found.u, set(found.left_out)) == ((), set(others))


def test_all_questions_are_asked_at_once_and_the_answers_are_the_last():
    log = {"step": np.arange(800.0), "q1 [ticks]": np.round(500 * ANGLE), "tau [A]": PUSH}
    with pytest.raises(ValueError, match="3 things cannot be told") as error:
        draft(log)
    for answer in ("units.t=", "units.q=", "units.u="):
        assert answer in str(error.value)
    found = draft(log, units={"t": ["0.01 s"], "q": ["turn/4096"], "u": ["0.08 N m"]})
    assert (found.t, found.q, found.u) == ("step", ("q1 [ticks]",), ("tau [A]",))


def test_ticks_of_two_encoders_are_two_numbers():
    columns = {"t": T}
    for k, counts in enumerate((4096, 1000)):
        columns[f"q{k}"] = np.round((k + 1) * np.sin((2 + k) * T) / 2 / np.pi * counts) / counts * 2 * np.pi
    assert draft(columns).quantum == pytest.approx((2 * np.pi / 4096, 2 * np.pi / 1000), rel=1e-3)
    assert isinstance(draft({"t": T, "a": columns["q0"], "q1": columns["q0"]}).quantum, float)


def test_a_draft_replaces_a_file_where_it_is_asked_to(tmp_path, monkeypatch):
    from commands import leave

    monkeypatch.chdir(tmp_path)
    pandas.DataFrame({"t": T, "q1": ANGLE}).to_csv("log.csv", index=False)
    assert leave("init", "log.csv", "-o", "a.toml")[0] == 0
    code, _, error = leave("init", "log.csv", "-o", "a.toml")
    assert (code, "say --overwrite" in error) == (2, True)
    assert leave("init", "log.csv", "-o", "a.toml", "--overwrite")[0] == 0
