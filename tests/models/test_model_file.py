"""Model files: what they give, how they are overridden, and the one line that everything wrong is named in."""

import math
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from covariant import models
from covariant.logs import Columns
from covariant.models import Lagrangian
from covariant.models.files import _source
from covariant.models.files._check import check_metric
from covariant.models.files._load import load
from covariant.models.files._model_file import ModelError, ModelFile
from scalargraph.errors import InputError

EXAMPLES = Path(__file__).parents[2] / "examples"

USUAL = ("measurement_std", "acceleration_std", "correlation_time", "motion_std", "motion_time")
"""Numbers that every example states; the others are for those who need them."""

WHOLE = """
system = "pendulum_chain"
[parameters]
mass = [1.0, 2.0]
length = [0.5, 0.5]
[columns]
t = "time"
q = ["a", "b"]
u = ["ta", "tb"]
v = ["wa", "wb"]
truth = ["va", "vb"]
[inputs]
lag = 0.01
[measurement]
quantum = 0.12
[uncertainty]
external_force = 0.4
acceleration = 3
correlation_time = 0.002
motion_acceleration = 50.0
motion_time = 0.1
[design]
damping = 0.5
"""

MODULE = """
from covariant.geometry.lie import SO3, Product
from covariant.models import GroupSystem, Lagrangian, StateSpace, heavy_top, lorenz, oscillator, pendulum_chain
from covariant.models.files._model_file import ModelFile
from covariant import models
from covariant.logs import Columns
import jax.numpy as jnp

spring = oscillator()
nameless = Lagrangian(lambda q: jnp.eye(2), lambda q: q @ q)
prepared = ModelFile("stand", oscillator(), Columns(t="stamp", q=("x",)), measurement_std=0.5)
constant = 3.0
top = ModelFile("top", heavy_top(), Columns(quaternion_wxyz=("w", "x", "y", "z")))
spins = GroupSystem(Product((SO3, SO3)), jnp.eye(6))
weather = lorenz()
station = ModelFile("station", weather, Columns(t="stamp", q=("wind",)), measurement_std=0.5)
shapeless = StateSpace(lambda t, x, u: x, lambda t, x, u: x)

def chain(links=3): return pendulum_chain([1.0] * links, [1.0] * links)
def needy(links, *rest, **more): return chain(links)
def lost(): return "a string"
def bad(): raise ValueError("no such luck\\nsecond line")
def stand(): return prepared
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A current folder with a module in it, importable only because it is current."""
    (tmp_path / "my_models.py").write_text(MODULE)
    (tmp_path / "broken.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    yield tmp_path
    for name in ("my_models", "broken"):
        sys.modules.pop(name, None)


def written(folder: Path, text: str) -> str:
    (folder / "m.toml").write_text(text)
    return str(folder / "m.toml")


def stated(file: ModelFile) -> dict[str, object]:
    """The numbers and words in which a model file differs from one that states none, without `measurement_std`."""
    defaults = ModelFile._field_defaults
    return {
        field: value
        for field, value in file._asdict().items()
        if field in defaults and field not in ("columns", "measurement_std") and value != defaults[field]
    }


def fault(spec: str, *overrides: str) -> str:
    """The message of the one error that loading raises: one line that begins with the spec."""
    with pytest.raises(ModelError) as caught:
        load(spec, overrides)
    message = str(caught.value)
    assert message.startswith(f"{spec}: ")
    assert "\n" not in message
    return message.removeprefix(f"{spec}: ")


def test_a_file_gives_everything(tmp_path):
    file = load(written(tmp_path, WHOLE))
    assert file.name == "m"
    assert file.model.parameters["mass"].value.tolist() == [1.0, 2.0]
    assert file.columns == Columns("time", ("a", "b"), ("ta", "tb"), ("wa", "wb"), ("va", "vb"))
    assert file.measurement_std == pytest.approx(0.12 / math.sqrt(12))
    assert stated(file) == {
        "input_lag": 0.01,
        "quantum": 0.12,
        "external_force": 0.4,
        "acceleration_std": 3.0,
        "correlation_time": 0.002,
        "motion_std": 50.0,
        "motion_time": 0.1,
        "damping": 0.5,
        "system": "pendulum_chain",
        "stated": ("mass", "length"),
    }


def test_what_a_file_leaves_out_has_a_default(tmp_path):
    file = load(written(tmp_path, 'system = "ball_and_beam"'))
    assert file.columns == Columns("t", ("r", "theta"), ("u1",))
    assert stated(file) == {"system": "ball_and_beam"}
    assert (file.damping, file.reference_half, file.reference_order) == (math.sqrt(0.5), 0.03, 3)
    assert load("ball_and_beam")._replace(name="m", model=file.model) == file


@pytest.mark.parametrize(
    ("name", "columns"),
    [
        ("dfki_double_pendulum", Columns("t", ("q1", "q2"), ("tau1", "tau2"), ("v1_log", "v2_log"))),
        ("dfki_simple_pendulum", Columns("t", ("q",), ("tau",), ("v_log",))),
        ("multiarm_double", Columns("t", ("th1", "th2"), (), ("w1_denoised", "w2_denoised"))),
        ("multiarm_single", Columns("t", ("th1",), (), ("w1_denoised",))),
    ],
)
def test_examples_load(name, columns):
    file = load(str(EXAMPLES / f"{name}.toml"))
    assert file.name == name
    assert file.columns == columns
    assert None not in [getattr(file, field) for field in USUAL]


@pytest.mark.parametrize(
    ("system", "n", "columns"),
    [
        ("free_body", 3, Columns(u=("u1", "u2", "u3"))),
        ("heavy_top", 3, Columns(u=("u1", "u2", "u3"))),
        ("underwater_vehicle", 6, Columns(u=tuple(f"u{i}" for i in range(1, 7)), position=("px", "py", "pz"))),
        ("hovercraft", 3, Columns(u=("right_thrust", "left_thrust"), position=("px", "py"), angle=("angle",))),
        ("satellite", 6, Columns(u=("u1", "u2", "u3"), angle=("angle1", "angle2", "angle3"))),
        ("duffing", 2, Columns(q=("q",), u=("u1",))),
        ("lorenz", 3, Columns(q=("x",))),
        ("unknown_frequency", 3, Columns(q=("x1",))),
        ("my_models:weather", 3, Columns(q=("x",))),
        ("my_models:station", 3, Columns(t="stamp", q=("wind",))),
    ],
)
def test_systems_name_their_columns_but_for_attitudes(folder, system, n, columns):
    file = load(system)
    attitudes = system in ("free_body", "heavy_top", "underwater_vehicle", "satellite")
    assert (file.dimension, file.columns, file.unnamed_attitudes) == (n, columns, attitudes)


@pytest.mark.parametrize("name", ["heavy_top", "underwater_vehicle"])
def test_examples_on_groups_load_with_the_parameters_they_show(name):
    file, plain = load(str(EXAMPLES / f"{name}.toml")), load(name)
    assert not file.unnamed_attitudes
    assert None not in [getattr(file, field) for field in USUAL]
    shown = {key: value for key, value in file.model.parameters.items() if key != "viscous"}
    assert shown == {key: plain.model.parameters[key] for key in shown}


def test_a_file_gives_a_state_space_model(tmp_path):
    text = 'system = "duffing"\n[parameters]\ncubic = 0.0\n[columns]\nq = ["s"]\ntruth = ["b0", "s0"]\n'
    file = load(written(tmp_path, f"{text}[measurement]\nstd = 0.1"), ["parameters.damping=5.0"])
    assert file.columns == Columns(q=("s",), u=("u1",), truth=("b0", "s0"))
    assert (file.measurement_std, file.model.parameters["damping"].value) == (0.1, 5.0)
    assert file.model.parameters["cubic"].value == 0.0


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ('columns.q=["a", "b"]', "columns.q names 2 columns (a, b); the model has 1 outputs"),
        ('columns.u=["a", "b"]', "columns.u names 2 columns (a, b); the model has 1 inputs"),
        ('columns.truth=["a"]', "columns.truth names 1 columns (a); the model has 2 states"),
        ('columns.v=["a"]', "columns.v: a state-space model has no velocities; name its outputs in columns.q"),
        (
            'columns.angle=["a"]',
            "columns.angle is for a model on a group; this one has outputs: name them in columns.q",
        ),
        ("parameters.damping=-1.0", "damping [N s/m] must be ≥ 0; got -1.0"),
        ('parameters.cubic="much"', "parameter cubic of duffing must be float; got 'much'"),
        ("parameters.cubik=1.0", "unknown parameter of duffing 'cubik'. Did you mean 'cubic'? Known: damping, "),
    ],
)
def test_names_what_is_wrong_with_a_state_space_model(override, words):
    assert words in fault("duffing", override)


def test_a_later_way_to_write_an_attitude_replaces_the_earlier(folder):
    names = Columns(quaternion_wxyz=("w", "x", "y", "z"))
    spec = written(folder, 'system = "heavy_top"\n[columns]\nquaternion_wxyz = ["w", "x", "y", "z"]')
    assert load(spec).columns.measured == load("my_models:top").columns.measured == names.measured
    for each in (spec, "my_models:top"):
        changed = load(each, ['columns.quaternion_xyzw=["x", "y", "z", "w"]']).columns
        assert changed.measured == changed.quaternion_xyzw == ("x", "y", "z", "w")


def test_a_group_that_no_log_can_hold_is_named(folder):
    assert "one attitude or pose, and ball joints, angles or coordinates after it" in fault("my_models:spins")


def test_geared_rotors_of_the_double_pendulum_count_as_its_authors_count_them():
    """M11 = I1 + I2 + m2 l1² + 2c cos q2 + gr² Ir + Ir, M12 = I2 + c cos q2 − gr Ir, M22 = I2 + gr² Ir; c = m2 l1 r2"""
    i1, i2, rotor, gear = 0.053470810264216295, 0.02392374528789766, 7.659297952841183e-05, 6.0
    m2, l1, r2 = 0.6043459469186889, 0.3, 0.18377686083653508
    bend = m2 * l1 * r2 * math.cos(0.7)
    cross = i2 + bend - gear * rotor
    first = i1 + i2 + m2 * l1**2 + 2 * bend + gear**2 * rotor + rotor
    model = load(str(EXAMPLES / "dfki_double_pendulum.toml")).model
    expected = [[first, cross], [cross, i2 + gear**2 * rotor]]
    np.testing.assert_allclose(model.metric(jnp.array([0.3, 0.7])), expected, rtol=1e-12)


def test_the_simple_pendulum_has_the_identified_inertia_and_gravity_torque():
    model = load(str(EXAMPLES / "dfki_simple_pendulum.toml")).model
    np.testing.assert_allclose(model.metric(jnp.zeros(1)), [[0.19287]], rtol=1e-12)
    lift = model.potential(jnp.array([np.pi])) - model.potential(jnp.zeros(1))
    np.testing.assert_allclose(lift, 2 * 0.84141 * 9.81 * 0.45, rtol=1e-12)
    np.testing.assert_allclose(model.force(jnp.zeros(()), jnp.zeros(1), jnp.ones(1)), [1 - 0.027389], rtol=1e-12)


def test_overrides_come_last(tmp_path):
    spec = written(tmp_path, WHOLE)
    changes = ("parameters.mass=[3.0, 4.0]", " columns.t = 't' ", "measurement.std=0.5", "design.damping=1")
    file = load(spec, changes)
    assert file.model.parameters["mass"].value.tolist() == [3.0, 4.0]
    assert file.columns == Columns("t", ("a", "b"), ("ta", "tb"), ("wa", "wb"), ("va", "vb"))
    assert (file.measurement_std, file.damping, file.input_lag) == (0.5, 1.0, 0.01)
    assert load(spec, ["measurement.quantum=12.0"]).measurement_std == pytest.approx(math.sqrt(12))
    assert load("oscillator", ['parameters.chart="r"', "inputs.lag=0.0"]).columns.q == ("r",)
    assert load("oscillator", ['system="ball_and_beam"']).columns.q == ("r", "theta")


def test_what_differs_between_coordinates_is_a_list(tmp_path):
    overrides = ("measurement.std=[3e-4, 4e-4]", "measurement.delay=[0, 0.005]", "inputs.delay=0.002")
    file = load(written(tmp_path, WHOLE), (*overrides, "inputs.between='linear'"))
    assert (file.measurement_std, file.delay) == ((3e-4, 4e-4), (0.0, 0.005))
    assert file.typical_std == pytest.approx(2.5e-4 * 2**0.5)
    assert (file.input_delay, file.input_between) == (0.002, "linear")
    ticks = load(written(tmp_path, WHOLE), ("measurement.quantum=[0.12, 0.03]",))
    assert ticks.quantum == (0.12, 0.03)
    assert ticks.measurement_std == pytest.approx((0.12 / 12**0.5, 0.03 / 12**0.5))


def test_a_module_gives_a_model(folder):
    assert load("my_models:spring").columns == Columns("t", ("q",), ("u1",))
    assert load("my_models:chain").columns.q == ("q1", "q2", "q3")
    assert load("my_models:chain", ["parameters.links=2"]).columns.u == ("u1", "u2")
    assert load("my_models:needy", ["parameters.links=1"]).name == "needy"
    assert load("my_models:nameless", ['columns.q=["x", "y"]']).columns == Columns("t", ("x", "y"), ("u1", "u2"))


@pytest.mark.parametrize("attribute", ["prepared", "stand"])
def test_a_module_gives_a_model_file(folder, attribute):
    file = load(f"my_models:{attribute}", ["inputs.lag=0.25"])
    assert isinstance(file, ModelFile)
    assert (file.name, file.measurement_std, file.input_lag) == ("stand", 0.5, 0.25)
    assert file.columns == Columns("stamp", ("x",), ("u1",))


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("nowhere.toml", "No such file or directory; give the path of a model file"),
        ("pendulum_chian", "unknown model 'pendulum_chian'. Did you mean 'pendulum_chain'? Known: ball_and_beam, "),
        ("no_module:spring", "module 'no_module' cannot be imported: ModuleNotFoundError: No module named 'no_module'"),
        ("broken:spring", "module 'broken' cannot be imported: ZeroDivisionError: division by zero"),
        (":spring", "module '' cannot be imported"),
        ("my_models:sprnig", "unknown attribute of module 'my_models' 'sprnig'. Did you mean 'spring'?"),
        ("my_models:", "unknown attribute of module 'my_models' ''."),
        (
            "my_models:constant",
            "constant must be a Lagrangian, a GroupSystem, a StateSpace, a ModelFile, or a function returning one; "
            "it is a float",
        ),
        (
            "my_models:lost",
            "lost must be a Lagrangian, a GroupSystem, a StateSpace, a ModelFile, or a function returning one; "
            "it returned a str",
        ),
        ("my_models:bad", "no such luck"),
        ("my_models:needy", "needy needs the parameter 'links'; add it to [parameters]"),
        ("my_models:nameless", "the model names no coordinates; give it some, or columns.q"),
        ("my_models:shapeless", "the model names no coordinates; give it some: they say how many states it has"),
    ],
)
def test_names_what_is_wrong_with_a_spec(folder, spec, words):
    assert words in fault(spec)


def test_a_bug_in_a_system_of_the_library_is_no_fault_of_its_parameters(monkeypatch):
    def broken():
        raise ValueError("min() iterable argument is empty")

    for module, kind in (("covariant.models.systems", ValueError), ("my_models", InputError)):
        broken.__module__ = module
        with pytest.raises(ValueError, match="is empty") as caught:
            _source.call("broken", broken, {})
        assert type(caught.value) is kind


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "system = 3 4",
            "not a TOML document: Expected newline or end of document after a statement (at line 1, column 12)",
        ),
        ('system = "oscillator"\n[design]\ndamping 3', "not a TOML document: Expected '='"),
        ('system = "oscillator"\n[design]\ndamping 3', "(at line 3, column 9)"),
        ("", 'system must be a name, as in system = "oscillator"; got None'),
        ("system = 3", 'system must be a name, as in system = "oscillator"; got 3'),
        ('system = "pendulum"', "unknown system 'pendulum'. Did you mean 'pendulum_chain'? Known: ball_and_beam, cyb"),
        ("sistem = 3", "unknown table or key 'sistem'. Did you mean 'system'? Known: system, parameters, columns"),
        ("columns = 3", "columns must be a table, [columns]; got 3"),
        ("[measurement]\nquantun = 1", "unknown key of [measurement] 'quantun'. Did you mean 'quantum'?"),
        ("[design]\ngain = 1", "unknown key of [design] 'gain'. Known: damping"),
    ],
)
def test_names_what_is_wrong_with_the_layout(tmp_path, text, words):
    assert words in fault(written(tmp_path, text))


def test_refuses_text_that_is_not_utf8(tmp_path):
    (tmp_path / "m.toml").write_bytes(b"# \xff\n")
    assert "no text in UTF-8, at byte 2" in fault(str(tmp_path / "m.toml"))


@pytest.mark.core(27)
@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("parameters.masses=[1.0]", "unknown parameter of pendulum_chain 'masses'. Did you mean 'mass'? Known: mass, "),
        ("parameters.mass=[1.0]", "pendulum_chain: length needs one number a link, 1 as in mass; got 2"),
        ("parameters.mass=3.0", "parameter mass of pendulum_chain must be Sequence[float]; got 3.0"),
        ("parameters.angles='left'", "pendulum_chain: angles must be one of relative, absolute; got 'left'"),
        ("parameters.mass=[0.0, 0.0]", "metric is singular or not finite at all 6 points tried, such as q = (0, 0)"),
        (
            "parameters={mass=[1.0], length=[1.0], com=[1.0], gear=[0.0], rotor_inertia=[1.0], actuated=[]}",
            "columns.q names 2 columns (a, b); the model has 1 coordinates",
        ),
        ('columns.q=["a"]', "columns.q names 1 columns (a); the model has 2 coordinates"),
        ("columns.u=[]", "columns.u names 0 columns; the model has 2 inputs"),
        ('columns.v=["a"]', "columns.v names 1 columns (a); the model has 2 coordinates"),
        ('columns.truth=["a"]', "columns.truth names 1 columns (a); the model has 2 coordinates"),
        ('columns.q="a"', 'columns.q must be a list of column names, as in ["q1", "q2"]; got \'a\''),
        ("columns.q=['a', 3]", "columns.q must be a list of column names"),
        ("columns.q=['a', 'a']", "columns.q names a column twice: a, a"),
        ("columns.t=['t']", "columns.t must be the name of a column; got ['t']"),
        ("inputs.lag=-1.0", "inputs.lag must be a number ≥ 0; got -1.0"),
        ("measurement.std=0.0", "measurement.std must be a positive number; got 0.0"),
        ("measurement.std=[0.1, 0.0]", "measurement.std must be a positive number; got 0.0"),
        ("measurement.delay=[0.0, 0.1, 0.2]", "measurement.delay lists 3 numbers; give 2, or one number without"),
        ("measurement.delay=[0.0, -0.1]", "measurement.delay must be a number ≥ 0; got -0.1"),
        ("measurement.delay='late'", "measurement.delay must be a number ≥ 0; got 'late'"),
        ("measurement.quantum=[0.1]", "measurement.quantum lists 1 numbers; give 2, or one number without"),
        ("measurement.quantum=[0.1, 0]", "measurement.quantum must be a positive number; got 0"),
        ("inputs.delay=-1.0", "inputs.delay must be a number ≥ 0; got -1.0"),
        ("inputs.between='spline'", "inputs.between must be one of 'held', 'linear'; got 'spline'"),
        ("reference.order=2.5", "reference.order must be a whole positive number; got 2.5"),
        ("design.damping=inf", "design.damping must be a positive number; got inf"),
        (f"design.damping=1{'0' * 400}", "design.damping must be a positive number; got 1000"),
        ("design.damping=true", "design.damping must be a positive number; got True"),
        ("design.damping='high'", "design.damping must be a positive number; got 'high'"),
        ("measurement={std=1.0, quantum=1.0}", "[measurement] has both std and quantum; keep one"),
        ("design.damping", "override 'design.damping' must be written table.key=value"),
        ("design..damping=1", "override 'design..damping=1' must be written table.key=value"),
        ("design.damping=1_0", "override 'design.damping=1_0': write numbers in plain decimals"),
        ("parameters.mass=[1, 0x10]", "override 'parameters.mass=[1, 0x10]': write numbers in plain decimals"),
        ("=1", "override '=1' must be written table.key=value"),
        ("system.kind=1", "override 'system.kind=1': 'system' is not a table"),
        ("columns.t=stamp", "override 'columns.t=stamp': the value is not TOML (Invalid value); text needs quotes"),
        ("measurement.bias=[0.1]", "measurement.bias lists 1 numbers; give 2, or one number without brackets"),
        ("measurement.bias=-0.1", "measurement.bias must be a number ≥ 0; got -0.1"),
        ("measurement.bias_drift=nan", "measurement.bias_drift must be a number ≥ 0; got nan"),
        ("uncertainty.external_force_time=1", "needs external_force_std and external_force_time together"),
        ("uncertainty.external_force_std=0.1", "needs external_force_std and external_force_time together"),
        ("uncertainty.parameters=0.3", "uncertainty.parameters must name numbers of [parameters]"),
        ('uncertainty.parameters={"mass[0]"=0}', "uncertainty.parameters.mass[0] must be a positive number; got 0"),
        ('uncertainty.parameters={"mas"=0.1}', "unknown number 'mas'. Did you mean 'mass[0]'?"),
        ('uncertainty.parameters={"mass"=0.1, "mass[0]"=0.2}', "mass[0] is named twice; name it once"),
        ("uncertainty.parameters_drift=-1", "uncertainty.parameters_drift must be a number ≥ 0; got -1"),
    ],
)
def test_names_what_is_wrong_with_a_value(tmp_path, override, words):
    assert words in fault(written(tmp_path, WHOLE), override)


def test_only_a_factory_takes_parameters(folder):
    assert "spring is a finished model" in fault("my_models:spring", "parameters.mass=[1.0]")
    assert "contradicts module:attribute; drop one" in fault("my_models:spring", 'system="oscillator"')


def diagonal(*entries):
    """A model whose metric is diagonal, each entry a function of q."""
    return Lagrangian(lambda q: jnp.diag(jnp.stack([entry(q) for entry in entries])), lambda q: q @ q)


def test_a_metric_may_end_where_its_chart_does():
    check_metric(diagonal(lambda q: 1 / q[0] ** 2), np.array([[0.0], [1.0]]))
    polar = diagonal(lambda q: jnp.ones_like(q[0]), lambda q: q[0] ** 2)
    check_metric(polar, np.array([[0.0, 0.0], [1.0, 0.0]]))
    with pytest.raises(ValueError, match=r"singular or not finite at all 1 points tried, such as q = \(0, 3\)"):
        check_metric(polar, np.array([[0.0, 3.0]]))


def test_a_metric_is_symmetric_and_positive():
    negative = diagonal(lambda q: jnp.ones_like(q[0]), lambda q: q[0] - 0.5)
    with pytest.raises(ValueError, match=r"not symmetric positive definite at q = \(0, 1\): smallest eigenvalue -0.5"):
        check_metric(negative, np.array([[1.0, 1.0], [0.0, 1.0]]))
    skew = Lagrangian(lambda q: jnp.array([[1.0, 0.5], [0.0, 1.0]]), lambda q: q @ q)
    with pytest.raises(ValueError, match=r"not symmetric .* largest asymmetry 0.5; look at"):
        check_metric(skew, np.zeros((1, 2)))


def test_a_recipe_makes_the_model_of_its_system():
    made = models.from_recipe({"system": "pendulum_chain", "parameters": {"mass": [1], "length": [0.5], "gravity": 10}})
    assert made.coordinates == ("q1",)
    assert made.parameters["gravity"].value == 10.0
    made = models.from_recipe({"system": "heavy_top", "parameters": {"inertia": [[2, 0, 0], [0, 3, 0], [0, 0, 4]]}})
    assert made.group.dimension == 3


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"gravity": True}, "parameter gravity of pendulum_chain must be float; got True"),
        ({"actuated": [0.0]}, r"parameter actuated of pendulum_chain must be Sequence\[int\] \| None; got \[0\.0\]"),
        ({"mass": 1.0}, r"parameter mass of pendulum_chain must be Sequence\[float\]"),
        ({"angles": 1}, "parameter angles of pendulum_chain must be str"),
        ({"masses": [1.0]}, "unknown parameter of pendulum_chain 'masses'"),
    ],
)
def test_the_parameters_of_a_recipe_have_the_types_of_the_system(parameters, line):
    with pytest.raises(models.ModelError, match=line):
        models.from_recipe({"system": "pendulum_chain", "parameters": parameters})


def test_a_recipe_imports_nothing_but_what_somebody_gives():
    recipe = {"attribute": "os:system", "parameters": {"command": "exit 1"}}
    with pytest.raises(models.ModelError, match="code that a recipe does not run"):
        models.from_recipe(recipe)
    recipe = {"attribute": "my.module:chain", "parameters": {"mass": [1.0], "length": [0.5]}}
    assert models.from_recipe(recipe, models.pendulum_chain).coordinates == ("q1",)
    assert models.from_recipe(recipe, models.oscillator()).coordinates == ("q",)
    assert models.from_recipe(recipe, "covariant.models:pendulum_chain").coordinates == ("q1",)
    with pytest.raises(models.ModelError, match=r"'mass'|mass"):
        models.from_recipe(recipe, models.oscillator)


def test_what_is_estimated_with_the_motion(tmp_path):
    text = WHOLE.replace("acceleration = 3", 'acceleration = 3\nparameters = {"mass" = 0.3, "length[1]" = 0.1}')
    file = load(written(tmp_path, text.replace("quantum = 0.12", "quantum = 0.12\nbias = [0.0, 0.02]")))
    assert (file.bias, file.bias_drift, file.parameters_drift) == ((0.0, 0.02), 0.0, 0.0)
    assert file.uncertain == {"mass": 0.3, "length[1]": 0.1}
    assert file.family.names == ("mass[0]", "mass[1]", "length[1]")


def test_a_model_file_as_an_object_keeps_its_uncertain_numbers():
    file = load("pendulum_chain", {"parameters.coulomb": [0.03, 0.03], "uncertainty.parameters": {"coulomb": 1.0}})
    again = load(file, {"measurement.std": 1e-3})
    assert again.uncertain == {"coulomb": 1.0}
    assert again.family.names == file.family.names


def test_an_override_of_an_object_replaces_the_number_that_states_the_same():
    ticks = load("oscillator")._replace(measurement_std=0.03, quantum=0.1, external_force=2.0)
    file = load(
        ticks, {"measurement.std": 0.5, "uncertainty.external_force_std": 1.0, "uncertainty.external_force_time": 2.0}
    )
    assert (file.measurement_std, file.quantum) == (0.5, None)
    assert (file.external_force, file.external_force_std, file.external_force_time) == (None, 1.0, 2.0)
    assert load(ticks, {"measurement.quantum": 12.0}).measurement_std == pytest.approx(math.sqrt(12))


def test_on_a_group_each_velocity_has_its_own_force():
    top = ModelFile("top", models.heavy_top(), Columns(quaternion_wxyz=("w", "x", "y", "z")))
    sizes = {"uncertainty.external_force_std": [1.0, 2.0, 3.0], "uncertainty.external_force_time": 0.5}
    assert load(top, sizes).external_force_std == (1.0, 2.0, 3.0)
    with pytest.raises(ModelError, match=r"external_force_std lists 2 numbers; give 3"):
        load(top, {**sizes, "uncertainty.external_force_std": [1.0, 2.0]})


def test_a_model_is_loaded_once_where_its_files_do_not_change(tmp_path):
    path, kept = tmp_path / "spring.toml", {}
    path.write_text('system = "oscillator"\n[measurement]\nstd = 1e-3\n')
    with models.loaded_once(kept):
        first = models.load(path)
        path.write_text('system = "oscillator"\n[measurement]\nstd = 2e-3\n')
        assert models.load(str(path)) is first
        assert models.load(path, ["measurement.std=3e-3"]).measurement_std == 3e-3, "other numbers are another model"
        for k in range(20):
            models.load(path, {"measurement.std": 0.1 + k})
    assert len(kept) < 10, "a caller may try other numbers without end"
    assert models.load(path).measurement_std == 2e-3
