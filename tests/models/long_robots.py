"""What takes long of `test_robots.py`."""

import re

import compare_robots
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_robots import ARM, NAMES, arm, folder, inertial, state

import scalargraph
from covariant.geometry.lie import SE3
from covariant.models import ModelError, acceleration, friction, load, robots
from covariant.observers import Intrinsic

HEAVY = ARM.replace('<link name="base"/>', f'<link name="base">{inertial("0.1 0 0.05", 4, 0.05, 0.06, 0.04)}</link>')


@pytest.fixture(scope="module")
def floating_arm(folder):
    """In the air, with a base that has a mass and two joints that stand still."""
    (folder / "floating.urdf").write_text(HEAVY)
    return robots.load(folder / "floating.urdf", floating=True, lock={"bend": 0.3, "roll": -0.2})


@pytest.mark.exhaustive
def test_a_free_fall_keeps_the_momentum_that_weight_leaves(floating_arm):
    """In the air the weight of all links acts at the common centre: the base accelerates so that this one falls."""
    q, (v, u, *_) = state(floating_arm, 2)
    space, mass = floating_arm.space, float(floating_arm.space.mass)
    assert mass == pytest.approx(4 + 2.5 + 1.2 + 0.3 + 0.8 + 0.9)

    def centre(q):
        return space.first_moment(q, space.joints(q)) / mass

    def fall(q, v):
        rate = acceleration(floating_arm, jnp.zeros(()), q, v, u[: floating_arm.inputs])
        speed = lambda q, v: jax.jvp(centre, (q,), (space.manifold.tangent(q, v),))[1]  # noqa: E731
        return jax.jvp(speed, (q, v), (space.manifold.tangent(q, v), rate))[1]

    np.testing.assert_allclose(jax.jit(fall)(q, v), [0, 0, -9.81], atol=1e-10)


@eqx.filter_jit
def energies(model, q, v):
    """Twice the kinetic energy, and the potential one."""
    return jnp.stack([model.space.inner(q, v, v), model.potential(q)])


@pytest.mark.exhaustive
def test_ten_turns_of_a_continuous_joint_are_none(arm):
    assert arm.manifold.circles == (0,)
    q, _ = state(arm, 3)
    round_about = q.at[0].add(20 * np.pi)
    np.testing.assert_allclose(arm.manifold.local(q, round_about), 0, atol=1e-12)
    np.testing.assert_allclose(arm.space(round_about), arm.space(q), rtol=1e-10, atol=1e-12)


@pytest.mark.exhaustive
def test_a_model_file_names_the_file_of_a_robot_beside_it(folder):
    """Every command takes the URDF file itself, or a model file that adds what is known of sensors and logs."""
    plain = load(str(folder / "arm.urdf"))
    assert (plain.name, plain.columns.q) == ("arm", NAMES)
    (folder / "in_the_air.toml").write_text("""system = "robot"
[parameters]
path = "floating.urdf"
floating = true
lock = {bend = 0.3, roll = -0.2}
[columns]
q = ["turn", "slide"]
position = ["x", "y", "z"]
quaternion_wxyz = ["qw", "qx", "qy", "qz"]
[measurement]
std = 1e-3
""")
    (folder / "floating.urdf").write_text(HEAVY)
    file = load(str(folder / "in_the_air.toml"))
    assert (file.dimension, file.model.coordinates) == (8, ("turn", "slide"))
    wrongs = {"lock={elbow=1.0}": "unknown joint 'elbow'", 'path="none.urdf"': "give the path of a URDF or MJCF file"}
    for wrong, words in wrongs.items():
        with pytest.raises(ModelError, match=words):
            load(str(folder / "in_the_air.toml"), [f"parameters.{wrong}"])


TREES = {
    "arm": lambda: ARM,
    "panda": lambda: robots.located("panda").read_text(encoding="utf-8"),
    "quadruped": lambda: robots.located("quadruped").read_text(encoding="utf-8"),
    "16 joints on the ground": lambda: compare_robots.tree(1),
    "15 joints in the air": lambda: compare_robots.tree(6),
}
"""Two of them at random: branched, turning, sliding, following ones, and balls."""


@pytest.mark.exhaustive
@pytest.mark.parametrize("text", TREES.values(), ids=TREES)
def test_trees_move_as_in_mujoco(text):
    """More are compared by `tools/compare_robots.py`, with Pinocchio too."""
    assert compare_robots.compared(text(), 5)["MuJoCo"] < compare_robots.TOLERANCE


@pytest.mark.exhaustive
def test_shipped_robots_are_found_by_their_names_and_say_where_their_numbers_are_from():
    for name in robots.ROBOTS:
        text = robots.located(name).read_text(encoding="utf-8")
        comment = text[text.index("<!--") : text.index("-->")]
        assert "chosen" in comment or re.search(r"(BSD|Apache License)", comment)
        assert "mesh" not in text
        assert not robots.read(name).doubts
    assert load("double_pendulum").columns.q == ("shoulder", "elbow")
    assert robots.load("quadruped").space.floating


def operations(model) -> int:
    """Those of an observer's right-hand side: what a microcontroller computes at every instant."""
    observer, zero = Intrinsic(model, 8.0, 30.0), jnp.zeros(len(model.coordinates))
    state = observer.init(zero)

    def right_hand_side(q, v, u, y):
        rate = observer.flow(jnp.zeros(()), state._replace(q=q, v=v), u, y)
        return rate.q, rate.v

    return scalargraph.operations(scalargraph.lower(right_hand_side, zero, zero, zero, zero).graph.nodes)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("joints", "most"), [(12, 11_500), (20, 27_000)])
def test_operations_of_an_observer_of_a_long_arm(folder, joints, most):
    """Of links that are symmetric about their axes, in one chain, with axes in turn along the arm and across."""
    rows = ['<link name="l0"/>']
    for i in range(1, joints + 1):
        rows.append(
            f'<link name="l{i}"><inertial><origin xyz="0 0 {0.05 + 0.001 * i}"/><mass value="{3 - 0.1 * i}"/>'
            f'<inertia ixx="{0.02 - 0.0003 * i}" iyy="{0.02 - 0.0003 * i}" izz="0.004" ixy="0" ixz="0" iyz="0"/>'
            f'</inertial></link><joint name="j{i}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/>'
            f'<origin xyz="0 0 0.2"/><axis xyz="{"0 0 1" if i % 2 else "0 1 0"}"/>'
            '<limit lower="-2" upper="2" effort="50" velocity="2"/></joint>'
        )
    (folder / "long.urdf").write_text(f"<robot name='long'>{''.join(rows)}</robot>")
    assert operations(robots.load(folder / "long.urdf")) <= most


@pytest.mark.exhaustive
def test_a_payload_moves_with_its_link_and_can_be_differentiated(folder, arm):
    """In the frame of the link, whatever it is welded to; energies are those of a mass point there."""
    load_ = (0.7, 0.1, -0.2, 0.3)
    loaded = robots.load(folder / "arm.urdf", payload={"flange": load_})
    q, (v, *_) = state(arm, 5)
    flange = jax.jit(lambda q: (arm.space.pose(q, "flange"), arm.space.jacobian(q, "flange")))
    at, jacobian = map(np.asarray, flange(q))
    place = at[:3, 3] + at[:3, :3] @ np.array(load_[1:])
    twist = jacobian @ np.asarray(v)
    speed = twist[:3] + np.cross(twist[3:], np.array(load_[1:]))
    more = energies(loaded, q, v) - energies(arm, q, v)
    assert float(more[0]) == pytest.approx(0.7 * float(speed @ speed), rel=1e-10)
    assert float(more[1]) == pytest.approx(0.7 * 9.81 * float(place[2]), rel=1e-10)
    weight = jax.grad(lambda m: robots.load(folder / "arm.urdf", payload={"flange": (m, *load_[1:])}).potential(q))
    assert float(weight(0.7)) == pytest.approx(9.81 * float(place[2]), rel=1e-10)
    unknown, short = "unknown link of payload 'hand'", "give mass, x, y, z"
    for wrong, words in (({"hand": load_}, unknown), ({"flange": (1.0,)}, short)):
        with pytest.raises(ValueError, match=words):
            robots.load(folder / "arm.urdf", payload=wrong)


LINKS = ("wrist", "elbow", "base")


@pytest.mark.exhaustive
def test_poses_and_jacobians_of_links(floating_arm):
    """The Jacobian gives the rate of the pose; the Coriolis matrix and its transpose that of the inertia matrix."""
    q, (v, *_) = state(floating_arm, 6)
    space, manifold = floating_arm.space, floating_arm.manifold

    @jax.jit
    def moving():
        along = (manifold.tangent(q, v),)
        poses = [jax.jvp(lambda x, link=link: space.pose(x, link), (q,), along) for link in LINKS]
        twists = [space.jacobian(q, link) @ v for link in LINKS]
        coriolis = space.coriolis_matrix(q, v)
        return poses, twists, coriolis, jax.jvp(space, (q,), along)[1], space.connection_force(q, v, v)

    poses, twists, coriolis, change, force = moving()
    for (pose, rate), twist in zip(poses, twists, strict=True):
        np.testing.assert_allclose(twist, SE3.vee(jnp.linalg.inv(pose) @ rate), atol=1e-12)
    np.testing.assert_allclose(coriolis + coriolis.T, change, atol=1e-10)
    np.testing.assert_allclose(coriolis @ v, force, atol=1e-10)
    with pytest.raises(ValueError, match="unknown link 'hand'"):
        space.pose(q, "hand")


@pytest.mark.exhaustive
def test_a_floating_joint_carries_the_robot_and_nothing_stands_beside(tmp_path):
    """`floating=True` and a floating joint at the root are one and the same."""
    loose = '<link name="world"/><joint name="air" type="floating"><parent link="world"/><child link="base"/></joint>'
    (tmp_path / "a.urdf").write_text(HEAVY.replace('<link name="base">', loose + '<link name="base">'))
    assert robots.load(tmp_path / "a.urdf").space.floating
    beside = (
        '<link name="more"/><joint name="beside" type="revolute"><parent link="world"/><child link="more"/></joint>'
    )
    (tmp_path / "b.urdf").write_text(HEAVY.replace('<link name="base">', loose + beside + '<link name="base">'))
    with pytest.raises(ValueError, match="joint 'beside': one floating joint is supported"):
        robots.load(tmp_path / "b.urdf")


@pytest.mark.exhaustive
def test_dry_friction_is_left_out_where_it_is_compensated():
    t, q, v, u = jnp.array(0.0), jnp.zeros(4), jnp.array([0.5, -0.3, 0.1, 1.0]), jnp.zeros(4)
    with_it, without = (robots.load("scara", dry_friction=dry) for dry in (True, False))
    np.testing.assert_allclose(friction(without, t, q, 2 * v, u), 2 * friction(without, t, q, v, u), rtol=1e-12)
    left_out = with_it.space(q) @ (friction(with_it, t, q, v, u) - friction(without, t, q, v, u))
    dry = np.array([joint.friction for joint in robots.read("scara").joints if joint.friction])
    np.testing.assert_allclose(left_out, -dry * 2 / np.pi * np.arctan(100 * v), rtol=1e-9)


ANTENNA = """<link name="antenna"><inertial><mass value="1e-6"/><inertia ixx="2.4e-8" ixy="6.1e-8" ixz="1.2e-8"
  iyy="2.8e-8" iyz="0.8e-8" izz="3.8e-8"/></inertial></link>
  <joint name="glue" type="fixed"><parent link="base"/><child link="antenna"/></joint></robot>"""


@pytest.mark.exhaustive
def test_a_fixed_link_of_negative_inertia_is_a_doubt_where_the_sum_is_positive(folder):
    path = folder / "antenna.urdf"
    path.write_text(ARM.replace("</robot>", ANTENNA))
    assert "link 'antenna'" in robots.read(path).doubts[0]
    np.testing.assert_allclose(
        robots.load(path).space(jnp.zeros(4)), robots.load(folder / "arm.urdf").space(jnp.zeros(4))
    )
    with pytest.raises(
        ValueError, match=r"link 'antenna': the inertia .* must not be negative.* with all that is fixed"
    ):
        robots.load(path, floating=True)
    path.write_text(ARM.replace("</robot>", ANTENNA.replace('link="base"', 'link="wrist"')))
    assert robots.load(path).coordinates == NAMES
    loose = ANTENNA.replace('"fixed"', '"continuous"')
    path.write_text(ARM.replace("</robot>", loose))
    with pytest.raises(ValueError, match="link 'antenna': the inertia about the centre of mass must not be negative"):
        robots.load(path)
    assert robots.load(path, lock={"glue": 0.2}).coordinates == NAMES


def test_a_drone_of_one_link_flies(folder):
    path = folder / "drone.urdf"
    path.write_text(
        f"<robot name='drone'><link name='body'>{inertial('0 0 0.01', 1.2, 0.01, 0.011, 0.019)}</link></robot>"
    )
    drone = robots.load(path, floating=True)
    assert (drone.manifold, len(drone.velocities)) == (SE3, 6)
    centre = np.array([0, 0, 0.01])
    about = np.diag([0.01, 0.011, 0.019]) + 1.2 * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    hat = np.cross(centre, np.eye(3)).T
    blocks = np.block([[1.2 * np.eye(3), -1.2 * hat], [1.2 * hat, about]])
    np.testing.assert_allclose(drone.space(jnp.eye(4)), blocks, atol=1e-12)
