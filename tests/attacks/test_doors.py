"""What files of a stranger ask for: each is refused in one line that names the file, before any work is done."""

import os
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pyarrow.parquet
import pytest

from covariant import InputError, StepCode, cli, logs, many, metrics, models, observers
from covariant._cases import CaseTable
from covariant._door import BINARY_LOG, MODEL, STORE, TEXT_LOG
from covariant.engine import Stream
from covariant.logs import _columns
from covariant.models.files import _source
from scalargraph.compiler import compiler


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    return tmp_path


def put(name: str, content: str | bytes | int | Path) -> str:
    """A file with a content, of a size without one, or a link to another file."""
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, Path):
        path.symlink_to(content.absolute())
    elif isinstance(content, int):
        with path.open("wb") as file:
            file.truncate(content)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return name


def refused(call, line: str) -> None:
    with pytest.raises(InputError, match=line) as error:
        call()
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


NO_FILE = {"a pipe": Path("pipe"), "a device": Path("/dev/zero"), "nothing": Path("/dev/null")}
PENDULUM = 'system = "pendulum_chain"\n[parameters]\n'


def urdf(links: int, kind: str = "fixed") -> str:
    names = range(links)
    joints = "".join(
        f'<joint name="j{k}" type="{kind}"><parent link="l{k - 1}"/><child link="l{k}"/></joint>' for k in names[1:]
    )
    return "<robot>" + "".join(f'<link name="l{k}"/>' for k in names) + joints + "</robot>"


def mjcf(body: str = "", before: str = "") -> str:
    return f"<mujoco>{before}<worldbody>{body}</worldbody></mujoco>"


BODY = '<body><joint name="j"/><geom size=".1"/></body>'
MODELS: dict[str, tuple[str, str | bytes | int | Path, str]] = {
    **{f"{name} as {suffix}": (suffix, NO_FILE[name], "is no file") for suffix in ("toml", "xml") for name in NO_FILE},
    "a large file": ("toml", MODEL.most_bytes + 1, "larger than a model file may be, 1 MiB"),
    "a terabyte": ("urdf", 2**40, "larger than a URDF or MJCF file may be"),
    "brackets": ("toml", "a = " + "[" * 100_000, "nested more than 16 deep"),
    "braces": ("toml", "a = " + "{a = " * 100_000, "nested more than 16 deep"),
    "dots": ("toml", "a" + ".a" * 100_000 + " = 1", "nested more than 16 deep"),
    "dots of a table": ("toml", "[" + "a . " * 100_000 + "a]", "nested more than 16 deep"),
    "dots between quotes": ("toml", "'a b'" + ' . "c d"' * 50_000 + " = 1", "nested more than 16 deep"),
    "dots of long names": ("toml", ("a" * 300 + ".") * 3000 + "a = 1", "nested more than 16 deep"),
    "17 levels": ("toml", "a = " + "[" * 17 + "]" * 17, "nested more than 16 deep"),
    "a number of many digits": ("toml", PENDULUM + "mass = [1" + "0" * 5000 + "]", "not a TOML document"),
    "no text": ("toml", b"\xff\xfe", "no text in UTF-8"),
    "a long chain": ("toml", PENDULUM + f"mass = {[1.0] * 3000}", "mass of pendulum_chain lists 3000 numbers; 80"),
    "81 pendulums": ("toml", PENDULUM + f"mass = {[1.0] * 81}", "mass of pendulum_chain lists 81 numbers; 80"),
    "3 000 links": ("urdf", urdf(3000), "has 3000 links, more than 400"),
    "100 moving links": ("urdf", urdf(101, "continuous"), "has 100 joints that move, more than 80"),
    "many tags": ("urdf", f"<robot>{'<a/>' * 30_000}</robot>", "has 30001 entries, more than 20000"),
    "deep tags": ("urdf", "<robot>" + "<a>" * 10_000, "not readable XML"),
    "copies": ("xml", mjcf(f'<replicate count="1000000">{BODY}</replicate>'), "or more, with copies"),
    "copies of copies": (
        "xml",
        mjcf(f'<replicate count="30"><replicate count="30">{BODY}</replicate></replicate>'),
        "has 900 bodies or more",
    ),
    "copies of shapes": ("xml", mjcf('<replicate count="1e9"><geom size=".1"/></replicate>'), "entries or more"),
    "a large field": ("xml", mjcf(BODY, '<asset><hfield nrow="30000" ncol="30000"/></asset>'), "an array of 9e"),
    "a large picture": ("xml", mjcf(BODY, '<asset><texture width="1e5" height="1e5"/></asset>'), "an array of 1e"),
    "a pipe as a mesh": ("xml", mjcf(BODY, '<asset><mesh file="pipe"/></asset>'), "pipe: is no file"),
    "a device as a mesh": ("xml", mjcf(BODY, '<asset><mesh file="/dev/zero"/></asset>'), "/dev/zero: is no file"),
    "a pipe in a folder": (
        "xml",
        mjcf(BODY, '<compiler meshdir="."/><asset><mesh file="x/pipe"/></asset>'),
        "is no file",
    ),
    "an included pipe": ("xml", mjcf(BODY, '<include file="pipe"/>'), "pipe: is no file"),
    "a file in itself": ("xml", mjcf(BODY, '<include file="model.xml"/>'), "or more, with copies"),
}


@pytest.mark.parametrize("name", MODELS)
def test_models_that_ask_for_too_much_are_refused(name):
    suffix, content, line = MODELS[name]
    refused(lambda: models.load(put(f"model.{suffix}", content)), rf"^model\.{suffix}: .*{line}")


ARM = 'system = "robot"\nparameters = {path = "double_pendulum"}\n'
NUMBERS = {
    "parameters.stiffness": 'system = "oscillator"\n[parameters]\nstiffness = inf',
    r"parameters.mass\[1\]": PENDULUM + "mass = [1.0, nan]\nlength = [1.0, 1.0]",
    r"parameters.length\[0\]": PENDULUM + "mass = [1.0]\nlength = [-inf]",
    r"parameters.viscous\[0\]": PENDULUM + f"mass = [1.0]\nlength = [1.0]\nviscous = [{10**400}]",
    r"parameters.inertia\[0\]\[2\]": 'system = "heavy_top"\n[parameters]\ninertia = [[1.0, 1.0, nan]]',
    "parameters.lock.elbow": ARM.replace("}", ", lock = {elbow = inf}}"),
    "servo.elbow.stiffness": ARM + "[servo.elbow]\nstiffness = inf",
    "servo.elbow.limit": ARM + "[servo.elbow]\nstiffness = 1.0\nlimit = inf",
    r"loop.a.points\[0\]\[1\]": ARM + "[loop.a]\npoints = [[0.0, nan, 0.0]]",
    "wrench.tip.force_std": ARM + '[wrench.tip]\nlink = "lower"\nforce_std = inf\ntime = 1.0',
    "sensors.gyro.std": ARM + '[sensors.gyro]\nkind = "gyro"\nstd = nan',
    "design.damping": 'system = "oscillator"\n[design]\ndamping = inf',
    "uncertainty.acceleration": 'system = "oscillator"\n[uncertainty]\nacceleration = nan',
    "measurement.delay": f'system = "oscillator"\n[measurement]\ndelay = {10**400}',
}


@pytest.mark.parametrize("key", NUMBERS)
def test_numbers_of_a_model_file_are_finite(key):
    refused(lambda: models.load(put("model.toml", NUMBERS[key])), rf"^model\.toml: {key} must be a .*(finite|number)")


def test_numbers_of_an_mjcf_file_are_finite():
    body = BODY.replace("/>", ' damping="nan"/>', 1)
    refused(lambda: models.load(put("model.xml", mjcf(body))), "dof damping is not finite")


LOGS: dict[str, tuple[str, str | bytes | int | Path, str]] = {
    **{
        f"{name} as {end}": (f"log.{end}", NO_FILE[name], "is no file")
        for end in ("csv", "parquet")
        for name in NO_FILE
    },
    "large text": ("log.csv", TEXT_LOG.most_bytes + 1, "larger than a log of text may be"),
    "a large table": ("log.parquet", BINARY_LOG.most_bytes + 1, "larger than a log may be"),
    "large messages": ("log.mcap", BINARY_LOG.most_bytes + 1, "larger than a log may be"),
    "a pipe in a bag": ("log.mcap/metadata.yaml", Path("pipe"), "is no file"),
    "a large description": ("log.mcap/metadata.yaml", STORE.most_bytes + 1, "larger than a part of a store may be"),
    "many columns": ("log.csv", "t" + ",q" * 20_000 + "\n", "20001 columns, more than 10000"),
    "a long line": ("log.csv", "t,q\n" + "1," * 2**20, "line is longer than 1 MiB"),
}


@pytest.mark.parametrize("name", LOGS)
def test_logs_that_ask_for_too_much_are_refused(name):
    path, content, line = LOGS[name]
    log = put(path, content).partition("/")[0]
    refused(lambda: logs.record(log, q="q"), line)


def test_rows_are_counted_before_they_are_read(monkeypatch):
    monkeypatch.setattr(_columns, "MOST_ROWS", 10)
    table = pyarrow.table({"t": np.arange(11.0), "q": np.zeros(11)})
    pyarrow.parquet.write_table(table, "log.parquet")
    refused(lambda: logs.record("log.parquet", q="q"), "has 11 rows, more than 10")


@pytest.mark.parametrize("content", [*NO_FILE.values(), STORE.most_bytes + 1, "[" * 100_000, "{", ""])
def test_stores_that_are_none_are_refused(content):
    put("map.zarr/zarr.json", content)
    refused(lambda: metrics.open_grid("map.zarr"), r"^map\.zarr")


@pytest.mark.parametrize("content", [*NO_FILE.values(), 2**30, "a = " + "[" * 100_000, "a" + ".a" * 100_000 + " = 1"])
def test_studies_that_are_none_are_refused(content):
    refused(lambda: many.sweep(put("study.toml", content), "new.zarr"), r"^study\.toml: ")


INSTALLED = (
    *("subprocess:getoutput", "os:system", "builtins:exec", "posix:system", "numpy:array", "jax.numpy:sin", "this:c"),
    *("os.path:join", ".os:system", "../os:system", "scalargraph.compiler:built", "importlib:import_module"),
    *("folder:x", "code:x", "missing:x", ":x"),
)


@pytest.mark.parametrize("spec", INSTALLED)
def test_a_file_does_not_choose_installed_code(spec, monkeypatch):
    (Path("folder")).mkdir()
    put("subprocess/x", "")
    put("code.py", "raise SystemExit")  # the name of a module of Python, which stays what it is
    loaded = {*sys.modules}
    refused(lambda: models.load(put("model.toml", f'system = "{spec}"')), "is not in the folder of the file")
    assert not {"this", "code", "antigravity"} & ({*sys.modules} - loaded)


@pytest.mark.parametrize("value", ["installed_arms", "installed_arms:make"])
def test_an_installed_package_declares_its_models(value, monkeypatch):
    put("elsewhere/installed_arms.py", "from covariant.models import oscillator as make, duffing as other")
    monkeypatch.syspath_prepend("elsewhere")
    point = EntryPoint("arms", value, "covariant.models")
    monkeypatch.setattr(_source, "entry_points", lambda group: [point] if group == point.group else [])
    assert models.load(put("model.toml", 'system = "installed_arms:make"')).model.coordinates == ("q",)
    other = put("model.toml", 'system = "installed_arms:other"')
    if ":" in value:
        refused(lambda: models.load(other), "is not in the folder")
    else:
        models.load(other)


DAMAGES = {
    "empty": lambda content: b"",
    "cut": lambda content: content[: len(content) // 2],
    "cut by one": lambda content: content[:-1],
    "without its seal": lambda content: content[32:],
    "edited": lambda content: content.replace(b"0.25", b"0.75"),
    "a bit": lambda content: bytes([content[0] ^ 1]) + content[1:],
    "longer": lambda content: content + b" ",
    "text": lambda content: b'{"b": {"nis": 0.75}}',
    "null": lambda content: b"null",
    "nested": lambda content: b"[" * 100_000,
}


@pytest.mark.parametrize("name", [*DAMAGES, "another name", "a pipe", "a folder", "a broken link"])
def test_rows_that_were_damaged_count_as_absent(name):
    table = CaseTable(Path("cases"))
    table.write({"a": {"nis": 0.5}})
    (good,) = Path("cases").iterdir()
    table.write({"b": {"nis": 0.25}})
    (bad,) = {*Path("cases").iterdir()} - {good}
    if name in DAMAGES:
        bad.write_bytes(DAMAGES[name](bad.read_bytes()))
    elif name == "another name":
        bad.rename(bad.with_name(f"{'0' * 32}.rows"))
    else:
        bad.unlink()
        {"a pipe": os.mkfifo, "a folder": os.mkdir}.get(name, lambda path: path.symlink_to("nowhere"))(bad)
    assert table.rows() == {"a": {"nis": 0.5}}


def test_a_map_whose_chunk_is_empty_names_it_and_is_mended():
    def build():
        grid = metrics.Grid(("x",), ("1",), low=(0.0,), high=(3.0,), counts=(4,))
        area = {"area": metrics.Variable((), "1", "a square")}
        metrics.map_grid(lambda x: {"area": x[0] ** 2}, grid, "map.zarr", variables=area, provenance={})

    build()
    Path("map.zarr/area/c/0").write_bytes(b"")
    refused(lambda: metrics.open_grid("map.zarr"), r"map\.zarr/area/c/0 is empty")
    build()
    assert metrics.open_grid("map.zarr").area.values.tolist() == [0.0, 1.0, 4.0, 9.0]


LOG, OTHER = "t,q,u1\n0,0,0\n1,0,0\n", "a,b\n1,2\n"
OUTPUTS = {
    "estimate oscillator log.csv -o out.csv": OTHER,
    "smooth oscillator log.csv -o out.csv": LOG,
    "simulate oscillator --duration 1 -o out.csv": OTHER,
    "fit oscillator log.csv --parameters stiffness -o out.toml": "",
    "tune oscillator log.csv -o out.toml": "",
    "init log.csv -o out.toml": "",
    "design excitation oscillator --parameters stiffness --duration 1 -o out.csv": OTHER,
    "export oscillator --rate 100 -o out.fmu": "",
    "export oscillator --rate 100 -o out": "",
    "export double_pendulum --rate 100 -o out.urdf": "",
    "sweep study.toml -o out.zarr": "",
    "design metric lorenz --grid 9 --rate 8 -o out.zarr": "",
}


@pytest.mark.parametrize("line", OUTPUTS)
def test_a_file_that_exists_is_refused_before_the_work(line, monkeypatch, capsys):
    put("log.csv", LOG)
    put("study.toml", "")
    arguments = line.split()
    out = arguments[arguments.index("-o") + 1]
    put(out, OUTPUTS[line])
    monkeypatch.setattr(sys, "argv", ["covariant", *arguments])
    for module in ("covariant.models.load", "covariant.logs.read", "covariant.many._study.read_study"):
        monkeypatch.setattr(module, lambda *_, **__: pytest.fail("the work has begun"))
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert f"covariant: {out}: " in capsys.readouterr().err
    assert Path(out).read_text() == OUTPUTS[line]


INPUTS = [1e200, -1e200, 1e308, -1e308, 1e155, 1e120, 1e100, 1e60, 1e40, -1e30]


@pytest.mark.parametrize(("observer", "engine"), [("intrinsic", "c"), ("user's own", "c"), ("user's own", "jax")])
def test_an_input_that_leads_beyond_the_finite_numbers_is_survived(observer, engine):
    """Each restarts the estimate, at a measurement if there is one; the last is what it would be without them."""
    if engine == "c" and compiler() is None:
        pytest.skip("there is no compiler")
    model = models.oscillator()
    own = Doubling() if observer == "user's own" else observers.Intrinsic(model, 20.0, 200.0, substeps=1)
    stream = Stream(own, np.zeros(1), 100.0, inputs=1, engine=engine)
    x = np.zeros(2)
    for k in range(120):
        fault = k < 40 and k % 4 == 2
        x = stream.step(0.01 * k, [np.nan if fault and k % 8 == 2 else 0.3], [INPUTS[k // 4] if fault else 0.0])
        assert np.isfinite(x).all()
        assert (stream.result == StepCode.NOT_FINITE) == fault
    np.testing.assert_allclose(x[0], 0.3, atol=0.01)
    assert stream.health.restarts == len(INPUTS)


class Position(NamedTuple):
    q: jnp.ndarray


class Doubling(observers.AbstractObserver):
    """An observer of somebody that reports nothing of numbers that are not finite."""

    def init(self, y, t=0.0):
        return Position(jnp.asarray(y))

    def predict(self, state, u, dt):
        return Position(state.q + dt * u * 1e300)

    def correct(self, state, u, y):
        innovation = jnp.nan_to_num(y - state.q)
        return Position(state.q + innovation / 2), observers.Info(innovation, innovation[0], jnp.asarray(0))

    def estimate(self, state):
        return jnp.concatenate([state.q, jnp.zeros_like(state.q)])
