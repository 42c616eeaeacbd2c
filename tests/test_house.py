"""The house rules: who may import whom, what loads with the package, and which names are public."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "covariant"

PLAN = (
    "_typing _files _guests _numbers signals scoring _linalg _integrate lowering "
    "logs geometry models riccati observers control simulation interop scale certificates design report papers cli"
)
"""A room may import from itself and from any room to its left, never to its right."""

OPTIONAL = (
    "pyarrow",
    "matplotlib",
    "plotly",
    "mujoco",
    "typer",
    "rich",
    "scipy",
    "sympy",
    "xarray",
    "zarr",
    "dask",
    "distributed",
    "flint",
    "clarabel",
    "control",
)

PUBLIC = {
    "certificates": "ASSUMED Audit Box CascadeCertificate Certificate Claim Constants ContractionCertificate Decay "
    "Form Growth Law MetricDesign Observability Proof StateMetric Subject audit bending blocks box cascade certify "
    "common_metric conditioning contraction contraction_matrix contraction_rate crossed_metric decay "
    "detectability_rate error_bounds error_matrix falsify feedthrough force_bounds generalised_jacobian "
    "in_coordinates in_frame log_norm lower_distance lyapunov noise_disturbance observability "
    "observer_gain optimal_lyapunov prove prove_at_corners rate_of rates_along steady_distance subject "
    "tangent_metric tracking upper_distance virtual",
    "control": "Backstepping Reference follow lissajous set_point",
    "design": "ESTIMATORS DataSheet Gains MetricSummary bias contracting_gain estimators filter_bandwidth gains "
    "line_up load_metric metric metric_summary observer_gains predict_errors window_length with_gains",
    "geometry": "AbstractManifold AbstractMetric AbstractSpace Budget ConstantCurvature Coordinates Euclidean "
    "FlatTorus Interpolated KineticEnergy Metric Product ProductManifold Pullback Shot Transported "
    "as_space christoffel connection curvature derivative differential distance exp gradient hyperbolic "
    "inner log norm shoot sphere transport transport_along wrap",
    "geometry.lie": "SE2 SE3 SO2 SO3 SU AbstractGroup AbstractInertia Inertia LeftInvariant MatrixGroup Product "
    "quaternion_from_rotation rotation_from_quaternion",
    "interop": "closed_loop observer_system plant",
    "lowering": "FOLD INTERVALS NUMBERS STUMPFF Condition Conditions Derivative Domain Enclosure Graph Interval "
    "Lowered LoweringError Node Truth enclose evaluate expand fulfilled graft lower numbers pairs stumpff substitute",
    "logs": "ATTITUDES Body Columns Log LogError bodies coordinates matrices read to_columns write",
    "models": "GroupSystem Lagrangian MechanicalSystem ModelError ModelFile MomentumChart Motion Parameter "
    "StateSpace acceleration advance applied_force ball_and_beam bioreactor body_velocity check_metric "
    "check_model duffing energy free_body friction from_recipe heavy_top hovercraft induction_motor load "
    "lorenz oscillator pendulum_chain recipe satellite satellite_arm source spatial_momentum state_space "
    "underwater_vehicle unknown_frequency van_der_pol",
    "models.marine": "Craft Station Waves coriolis_matrix cybership euler_rates euler_rotation euler_transform "
    "manoeuvring_ship odin odin_on_group supply_vessel surface_ship yaw_rotation",
    "observers": "EKF REGISTRY AbstractFlowObserver AbstractMechanicalObserver AbstractObserver Contracting "
    "ContractingState Copy EKFInfo EKFState Entry Estimate FilterInfo FilteredDerivative FilteredState Geodesic "
    "GeodesicInfo GeodesicState HeldState Info InformationEKF InformationState Intrinsic MechanicalState PassiveGains "
    "PassiveShip Riccati Salcudean SalcudeanState SavitzkyGolay WindowState continuous craft_observer "
    "lyapunov_gains lyapunov_rate notch_gains printed_rate run second_order",
    "report": "PALETTE EstimateReport draw_audit draw_certificate new_figure save_figure table write_article "
    "write_audit write_html write_png",
    "riccati": "Box Equation Metric Passage Solution Window gramian gramians high_gain lie_derivative metric_at "
    "metric_through rate_from_gramian reconstructibility right_side spd_distance window_at",
    "scale": "Grid Variable map_grid open_grid",
    "simulation": "Sensor hold no_input observe sense simulate stamps",
}


def room_of(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imported_rooms(path: Path) -> set[str]:
    """Rooms that a file imports anywhere, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        found |= {name.split(".")[1] for name in names if name.startswith("covariant.")}
    return found


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda p: str(p.relative_to(SOURCE)))
def test_rooms_import_only_from_their_left(path):
    plan, room = PLAN.split(), room_of(path)
    if room == "__init__":
        assert not imported_rooms(path) - set(plan)
        return
    assert room in plan, f"{room} is not in the import plan; give it a place"
    wrong = {other for other in imported_rooms(path) if plan.index(other) > plan.index(room)}
    assert not wrong, f"{path.relative_to(SOURCE)} imports {sorted(wrong)}, which the plan puts to the right of {room}"


@pytest.mark.parametrize(
    "module",
    [
        "covariant",
        *(
            f"covariant.{room}"
            for room in ("geometry", "models", "riccati", "observers", "simulation", "scale", "certificates", "design")
        ),
    ],
)
def test_import_brings_in_no_optional_package(module):
    script = f"import {module}, sys; print(*(m for m in {OPTIONAL} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("room", PUBLIC)
def test_public_names_are_the_agreed_ones_and_documented(room):
    module = importlib.import_module(f"covariant.{room}")
    assert module.__all__ == PUBLIC[room].split()
    assert module.__all__ == sorted(module.__all__, key=kind_and_name)
    assert module.__doc__
    for name in module.__all__:
        value = getattr(module, name)
        documented = value.__doc__ and not value.__doc__.startswith(
            f"{name}("
        )  # which Python and dataclasses put there
        assert not callable(value) or documented, f"covariant.{room}.{name} has no docstring"


def test_every_room_has_a_list_of_its_public_names():
    rooms = {".".join(path.parent.relative_to(SOURCE).parts) for path in SOURCE.glob("*/**/__init__.py")}
    assert rooms == {*PUBLIC, "cli", "papers"}, "a new room needs its list of public names here"


def kind_and_name(name: str) -> tuple[bool, bool, str]:
    """Constants, then classes, then functions, each by name."""
    return not name.isupper(), not name[0].isupper(), name


def tracked_texts():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split(
        "\n"
    )
    paths = [ROOT / name for name in listed if name] or list(SOURCE.rglob("*"))
    for path in paths:
        if (
            path.is_file()
            and path.suffix in (".py", ".toml", ".md", ".txt", ".yml", ".css", ".js", "")
            and path != Path(__file__)
        ):
            yield path, path.read_text(encoding="utf-8", errors="ignore")


def test_no_file_names_a_package_host_or_a_path_of_one_machine():
    hosts = re.compile(
        r"pypi\.(org|python)|files\.pythonhosted|index-url|find-links[ =]|/root/|(?<![\w.])/(home|work|Users|mnt)/\w",
        re.IGNORECASE,
    )
    allowed = {"Makefile"}  # it switches such lines off
    found = {str(p.relative_to(ROOT)): hosts.search(text) for p, text in tracked_texts() if p.name not in allowed}
    assert not {name: hit.group() for name, hit in found.items() if hit}
    assert "://" not in (ROOT / "constraints.txt").read_text(encoding="utf-8")


def test_what_make_quick_runs_is_there():
    text = (ROOT / "Makefile").read_text(encoding="utf-8").replace("\\\n", " ")
    chosen = re.findall(r"^QUICK := (.*)$", text, re.MULTILINE)[0].split()
    assert "tests/laws/test_every_observer.py" in chosen
    assert [path for path in chosen if not (ROOT / path).is_file()] == []
