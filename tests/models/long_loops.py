"""What takes long of `test_loops.py`."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_loops import BUILT, JOINT, LINK, four_bar, urdf

import covariant
from covariant import models
from covariant.models import acceleration, robots
from covariant.models.robots import located, robot_space
from covariant.verbs import MisfitError
from scalargraph import evaluate_batch

LOOPED = ("four_bar", "five_bar", "parallel_ankle", "delta")


FLOATING = """<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint name="free"/>
 <inertial pos="0.01 0 0.02" mass="1" diaginertia="0.01 0.02 0.03"/>
 <body name="a"><joint name="a" axis="0 -1 0"/><inertial pos=".075 0 0" mass=".5" diaginertia=".002 .002 .002"/>
  <body name="b" pos=".15 0 0"><joint name="b" axis="0 -1 0"/>
   <inertial pos=".2 0 0" mass=".6" diaginertia=".01 .01 .01"/></body></body>
 <body name="c" pos=".35 0 0"><joint name="c" axis="0 -1 0"/>
  <inertial pos=".15 0 0" mass=".8" diaginertia=".008 .008 .008"/></body></body></worldbody>
<equality><connect body1="b" body2="c" anchor=".4 0 0"/></equality></mujoco>"""


ZERO = jnp.zeros(())


PIN = {"pin": {"links": ["coupler", "rocker"], "points": [[0.4, 0, 0], [0.3, 0, 0]]}}


@functools.cache
def loaded(name, dry=False):
    """A shipped robot; `dry` without the friction of its joints."""
    none = {joint.name: {"viscous": 0.0} for joint in robots.read(name).joints} if dry else None
    return robots.load(name, friction=none)


def state(model, seed=0, size=1.0):
    """A configuration on the leaf near the assembly, and a velocity along it."""
    random, space = np.random.default_rng(seed), model.space
    n = len(model.manifold.zero(space.assembly))

    def along(way, v):
        q = model.manifold.retract(space.assembly, space.projected(space.assembly, way))
        return space.restored(space.restored(q, v)[0], v)  # so long a way needs more Newton steps

    q, v = evaluate_batch(along, 0.2 * random.normal(size=(1, n)), size * random.normal(size=(1, n)))
    return jnp.asarray(q[0]), jnp.asarray(v[0])


def moved(model, q, v, u):
    """The acceleration, by NumPy: nothing is compiled."""
    return evaluate_batch(lambda q, v, u: acceleration(model, ZERO, q, v, u), q[None], v[None], u[None])[0]


def of_multipliers(model):
    """Acceleration and multipliers by the equations of the tree, and both as the leaf has them."""
    space, tree = model.space, robot_space(model.space)

    @jax.jit
    def terms(q, v, u):
        def along(t):
            return space.constraint(tree.manifold.retract(q, t * v))

        rows = jax.jacfwd(lambda s: space.constraint(tree.manifold.retract(q, s)))(jnp.zeros_like(v))
        bent = jax.jvp(lambda t: jax.jvp(along, (t,), (jnp.ones(()),))[1], (ZERO,), (jnp.ones(()),))[1]
        zero = ZERO
        force = models.applied_force(model, zero, q, u) + models.resistance(model, zero, q, v, u)
        leaf = acceleration(model, zero, q, v, u), space.load(q, v, force)
        return tree(q), rows, bent, force - tree.connection_force(q, v, v), leaf

    def solved(q, v, u):
        matrix, rows, bent, force, leaf = (jax.tree.map(np.asarray, part) for part in terms(q, v, u))
        both = np.block([[matrix, -rows.T], [rows, np.zeros((len(bent),) * 2)]])
        found = np.linalg.solve(both, np.concatenate([force, -bent]))
        return np.split(found, [-len(bent)]), leaf

    return solved


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["four_bar", "delta", "parallel_ankle"])
def test_loops_move_as_multipliers_say(name):
    model = loaded(name)
    q, v = state(model)
    theirs, ours = of_multipliers(model)(q, v, jnp.linspace(0.5, 1.0, model.inputs))
    for one, other in zip(theirs, ours, strict=True):
        assert_allclose(other, one, rtol=1e-10, atol=1e-10 * np.abs(one).max())
    assert np.abs(model.space.constraint(q)).max() < 1e-14


@pytest.mark.exhaustive
def test_a_floating_base_may_carry_a_loop(tmp_path):
    path = tmp_path / "floating.xml"
    path.write_text(FLOATING)
    with pytest.raises(ValueError, match="rank 1 and 2"):  # at qpos0 all links are in one line: a change point
        robots.load(path)
    path.write_text(FLOATING.replace('anchor=".4 0 0"/>', 'anchor=".2 0 .3"/>'))
    model = robots.load(path, actuated=["a"])
    q, v = state(model, size=0.5)
    theirs, ours = of_multipliers(model)(q, v, jnp.ones(1))
    for one, other in zip(theirs, ours, strict=True):
        assert_allclose(other, one, rtol=1e-10, atol=1e-10 * np.abs(one).max())


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", LOOPED)
def test_rows_span_those_of_mujoco(name):
    model, engine = loaded(name), mujoco.MjModel.from_xml_path(str(located(name)))
    data = mujoco.MjData(engine)
    rows_at = jax.jit(lambda q: model.space.normals(q).rows)
    for seed in range(3):
        q, _ = state(model, seed)
        data.qpos[:] = q
        mujoco.mj_forward(engine, data)
        theirs, rows = data.efc_J.reshape(data.nefc, -1), np.asarray(rows_at(q))
        assert np.linalg.matrix_rank(theirs, tol=1e-9) == len(rows)
        assert np.abs(theirs - theirs @ np.linalg.pinv(rows) @ rows).max() < 1e-11


@pytest.mark.exhaustive
def test_a_table_closes_the_loop_of_a_tree(tmp_path):
    path = four_bar(tmp_path)
    with pytest.raises(ValueError, match=r"loop 'pin': the loop does not close near.*give the assembly"):
        robots.load(path, loops=PIN)
    with pytest.raises(ValueError, match=r"do not close where assembly says.*the closest is assembly = \{crank"):
        robots.load(path, loops=PIN, assembly=BUILT | {"rocker": 0.8})
    model, other = robots.load(path, loops=PIN, assembly=BUILT, actuated=["crank"]), loaded("four_bar")
    assert model.space.constraint(model.space.assembly).shape == (2,)
    q, v = state(other)
    free = [moved(m, q, v, jnp.ones(1)) for m in (model, other)]
    # The tree has none of the friction of the shipped file.
    assert_allclose(free[0], moved(loaded("four_bar", dry=True), q, v, jnp.ones(1)), rtol=1e-10)
    assert np.abs(free[0] - free[1]).max() > 1e-3
    text = robots.robot_text(".xml", path, 1e-3, loops=PIN, assembly=BUILT, actuated=["crank"]).text
    (tmp_path / "back.xml").write_text(text)
    assert_allclose(moved(robots.load(tmp_path / "back.xml"), q, v, jnp.ones(1)), free[0], rtol=1e-9)
    with pytest.raises(ValueError, match="URDF has no closed loops, such as 'pin'"):
        robots.robot_text(".urdf", path, 1e-3, loops=PIN, assembly=BUILT)


def test_a_polynomial_between_joints(tmp_path):
    """A cam of second order moves as its coordinate alone does, with the inertia m + m₂ (2 c₂ x)²."""
    path = urdf(
        tmp_path,
        LINK.format("cart", 2.0, 0, 1.0),
        LINK.format("lift", 3.0, 0, 1.0),
        *(
            JOINT.format(name, "base", name, 0, 0, axis)
            .replace("continuous", "prismatic")
            .replace("</joint>", '<limit lower="-9" upper="9" effort="9" velocity="9"/></joint>')
            for name, axis in (("cart", "1 0 0"), ("lift", "0 1 0"))
        ),
    )
    loops = {"cam": {"joints": ["lift", "cart"], "polynomial": [0.0, 0.0, 0.5]}}
    model, x, v, force = robots.load(path, loops=loops, actuated=["cart"]), 0.7, 1.3, 4.0
    q, rate = jnp.array([x, 0.5 * x**2]), jnp.array([v, x * v])
    found = moved(model, q, rate, jnp.array([force]))
    assert_allclose(found[0], (force - 3.0 * x * v**2) / (2.0 + 3.0 * x**2), rtol=1e-12)
    assert_allclose(found[1], v**2 + x * found[0], rtol=1e-12)


@pytest.mark.exhaustive
def test_overconstrained_and_branching_linkages_are_refused(tmp_path):
    # Bennett's linkage moves only by its exact lengths and twists: sin(α)/a = sin(β)/b.
    a, alpha, beta, first = 0.3, 0.6, 1.1, 1.0
    b = a * np.sin(beta) / np.sin(alpha)
    second = 2 * np.arctan(np.sin((alpha + beta) / 2) / np.sin((beta - alpha) / 2) / np.tan(first / 2))
    lengths, twists = (0.0, a, b, a), (0.0, alpha, beta, alpha)
    names = ("base", "l1", "l2", "l3", "l4")
    parts = [LINK.format(name, 1.0, 0.1, 0.01) for name in names[1:]]
    parts += [JOINT.format(f"j{k + 1}", names[k], names[k + 1], lengths[k], twists[k], "0 0 1") for k in range(4)]
    loops = {"weld": {"links": ["l4", "base"], "points": [[b, 0, 0], [0, 0, 0]], "rpy": [beta, 0, 0]}}
    assembly = dict(zip(("j1", "j2", "j3", "j4"), (first, second, -first, -second), strict=True))
    with pytest.raises(ValueError, match="an overconstrained linkage, which closes by its exact lengths alone"):
        robots.load(urdf(tmp_path, *parts), loops=loops, assembly=assembly)
    # A parallelogram in one line may go on as a parallelogram or crossed.
    crank = 0.25
    pin = {"pin": {"links": ["coupler", "rocker"], "points": [[0.35, 0, 0], [0.15, 0, 0]]}}
    path = four_bar(tmp_path)
    with pytest.raises(ValueError, match="such a change point it can go on in two ways"):
        robots.load(path, loops=pin)
    model = robots.load(path, loops=pin, assembly={"crank": crank, "coupler": -crank, "rocker": crank})
    places = jnp.stack([model.space.assembly, jnp.zeros(3)])
    assert evaluate_batch(model.space.regular, places).tolist() == [True, False]


def test_numbers_of_a_linkage_are_not_fitted():
    with pytest.raises(models.ModelError, match="numbers of a robot with closed loops are not fitted"):
        models.robot_family("four_bar", ["friction"])


@pytest.mark.exhaustive
def test_a_log_from_the_rocker_alone_is_refused_at_the_dead_centre():
    """The crank turns round; without a torque the model explains nothing of it either, which is not the cause."""
    pandas = pytest.importorskip("pandas")
    t = np.arange(0.0, 1.0, 0.01)
    crank = 0.33 + 8 * t
    # From the rocker's axis to the crank's end, and the angle that it makes with the rocker.
    x, z = 0.15 * np.cos(crank) - 0.35, 0.15 * np.sin(crank)
    inside = np.arccos((x**2 + z**2 + 0.3**2 - 0.4**2) / (2 * np.hypot(x, z) * 0.3))
    rocker = np.unwrap(np.arctan2(z, x)) - inside
    frame = pandas.DataFrame({"t": t, "rocker": rocker, "u1": 0.0})
    with pytest.raises(
        MisfitError, match=r"0\.\d+ s after its start .* dead centre of rocker, .* nothing about crank, c"
    ):
        covariant.estimate("four_bar", frame, overrides={"measurement.std": 1e-4, "uncertainty.acceleration": 2.0})
