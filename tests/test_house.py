"""The house rules: who may import whom, what loads with the package, and which names are public."""

import ast
import functools
import graphlib
import importlib
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import get_origin

from style import docstrings

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "covariant"

PLAN = (
    "_programs _compile _typing _gauss_markov _functional _files _templates _optional _numbers signals scoring _linalg "
    "_integrate _adaptive lowering logs geometry models metrics observers simulation "
    "proofs certificates calibration codegen engine report papers workflow cli"
)
"""A room may import from itself and from any room to its left, never to its right."""

OPTIONAL = (
    "pyarrow",
    "rosbags",
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
    "cffi",
)

PUBLIC = {
    "calibration": "ESTIMATORS FITTED STATE_ESTIMATORS Beside Candidate Combinations DataSheet Diagnosis Draft "
    "Excitation ExcitationPlan ExpectedErrors Finding Fit FourierMotion Gains HeldOut JointLimits NoiseLevels "
    "PredictionErrors RobotFit Sensing Suggestion Trial Tuning Windows bias contracting_gain design_excitation "
    "diagnose draft errors_ahead estimators filter_bandwidth fit fit_robot gains gated given_noise growth "
    "held_out_logs horizon jerk_bound joint_noise losses mended_clock misfit motor_inputs observer_gains outliers "
    "predict_errors predict_sampled_errors prediction_errors relations robot_misfit rows_ahead split stored_observer "
    "suggest_noise tune tuned_estimators tuned_state_estimators usual_speeds window_length windows with_gains",
    "certificates": "ASSUMED CHECKERS CascadeCertificate Checked CheckerName Claim Constants ContractionCertificate "
    "Corners Decay Document Evidence Followed Growth Hypothesis MetricDesign Observability Projection Sampled "
    "StateMetric Statement ErrorSystem ReducedOrderDesign TradeOff Trajectories Verdict at_corners bending "
    "cascade certify check check_sample common_metric conditioning contraction contraction_matrix "
    "contraction_rate crossed_metric decay detectability_rate error_bounds error_matrix falsify feedthrough "
    "follow_estimates force_bounds generalised_jacobian in_coordinates in_frame log_norm lower_distance lyapunov "
    "noise_disturbance observability observer_gain optimal_lyapunov parse projection rate_of rates_along "
    "reduced_order steady_distance error_system Sampling correction sampled_system "
    "Attempt BoundInfo BoundState DistanceCertificate Largest Premise SampledBound Start certify_distance largest "
    "tangent_metric tracking trade_off trajectories upper_distance virtual",
    "certificates.audit": "LAWS Audit Law audit",
    "codegen": "ROWS Facts Leaf Program Recipe Signals Source TracedProgram Unit Vectors closed_loop export_texts fmu "
    "observer_system of_family plant program python_files trace_program vectors wasm_files with_open_numbers write_fmu "
    "write_folder write_source",
    "engine": "FEWEST_ROWS Engine EngineName Health KernelForm Stream choose compiled run_log run_logs",
    "geometry": "AbstractManifold AbstractMetric AbstractSpace Budget ConstantCurvature Coordinates Euclidean "
    "FlatTorus Interpolated KineticEnergy Metric Product ProductManifold Pullback Shot Transported as_space "
    "christoffel connection curvature derivative differential distance exp gradient hyperbolic inner log norm "
    "sectional_curvature shoot sphere transport transport_along wrap",
    "geometry.lie": "SE2 SE3 SO2 SO3 SU AbstractGroup AbstractInertia Inertia LeftInvariant MatrixGroup Product "
    "quaternion_from_rotation rotation_from_quaternion",
    "logs": "ATTITUDES MEANT MESSAGES OPTIONAL WRITTEN Body ClockError Columns Log LogError bodies check_unit "
    "coordinates matrices read readings record source_name survey to_columns unit_factor unit_in_name unknown_unit "
    "unknown_unit_fault without_unit words_of write",
    "lowering": "C_KEYWORDS FOLD INTERVALS LARGEST NUMBERS STUMPFF TRUTHS Branch CText Call ClosedJaxpr Condition "
    "Conditions Derivative Domain Enclosure Graph Interval JaxprEquation Lowered LoweringError Node Scan Signature "
    "TracedFunction Truth While c_function c_helpers c_number c_rows enclose equations evaluate evaluate_batch expand "
    "fingerprint fulfilled graft in_c lower lower_traced needed numbers on_batches operations pairs perturbed "
    "simplified split stumpff substitute to_c trace",
    "metrics": "Characteristic Equation Grid MetricSummary RiccatiMetric Solution Variable Window gramian gramians "
    "high_gain lie_derivative load_metric map_grid metric_at metric_on_grid metric_summary metric_through open_grid "
    "open_metric rate_from_gramian reconstructibility right_side spd_distance window_at",
    "models": "Family GroupSystem Lagrangian MechanicalSystem ModelError ModelFile MomentumChart Motion Overrides "
    "Parameter Parametric RobotFamily StateSpace Survey acceleration advance applied_force ball_and_beam bioreactor "
    "body_velocity chart_jacobian chart_velocity check_metric check_model check_spec document duffing energy family "
    "free_body friction from_recipe heavy_top hovercraft in_chart induction_motor input_count is_robot_number load "
    "lorenz oscillator pendulum_chain recipe recipe_text resistance rewrite robot_family satellite satellite_arm "
    "source spatial_momentum spec_name state_space survey underwater_vehicle unknown_frequency van_der_pol",
    "models.marine": "Craft Station Waves coriolis_matrix cybership euler_rates euler_rotation euler_transform "
    "manoeuvring_ship odin odin_on_group positive_definite supply_vessel surface_ship yaw_rotation",
    "models.robots": "OF_INERTIA ROBOTS BodyInertia Description Follows FrictionLaw Joint KinematicTree Links Motor "
    "RobotSpace assemble changed inertia_of load located numbers_of read urdf_with_inertias",
    "observers": "EKF OBSERVER_NAMES PLL REGISTRY SMOOTHED STATE_OBSERVER_NAMES Smoothed UKF AbstractFlowObserver "
    "AbstractLinearFilter AbstractMechanicalObserver AbstractObserver Contracting ContractingState Copy Delayed "
    "DelayedState EKFInfo EKFState Entry Estimate FilterInfo FilteredDerivative FilteredState FixedLag FixedLagState "
    "FixedLagWindow Gate Gated GatedState NoiseStep "
    "GateMemory Geodesic GeodesicInfo GeodesicState SampledState HighGain Info InformationEKF InformationState "
    "Intrinsic IntrinsicKalman JointInfo JointKalman JointState KalmanInfo KalmanState Levant LoopState "
    "MechanicalState Noise PassiveGains PassiveShip Riccati Salcudean SalcudeanState SavitzkyGolay Slow StateEKF "
    "StateEKFInfo Judged Sample StateEKFState UKFState Velocity WindowState checked chooses_substeps continuous "
    "craft_observer external_force noise_step AbstractForceObserver ForceState InverseDynamics MomentumObserver "
    "observed_forces AbstractWrapper Instant Sensor SensorInfo accelerometer encoder gyro point_sensor pose_sensor "
    "tachometer Damped DampedInfo DampedState ReducedOrder ReducedOrderState damping_margin ImplicitGeodesic "
    "CurvedErrors DistanceBounds DistanceDecay ImplicitGains PartLimits distance_decay implicit_gains "
    "longest_interval part_limits proved_decay ProvedDecay ContinuousGains least_gain "
    "lyapunov_gains lyapunov_rate needed_substeps notch_gains printed_rate run second_order sensor_bias smooth "
    "uncertain_parameters with_fixed_substeps wrench",
    "papers.jouffroy_fossen": "COMPASS COUNTEREXAMPLES CROSS DURATION GAPS GNSS K1 K2 KD KP LAMBDA PRINTED_K2 RATE "
    "SETTLED STAGES STEP Loop Scalar Sea draw draw_odin draw_sea odin_box odin_cascade odin_certificate "
    "odin_controller odin_eigenvalues odin_loop odin_observer odin_path odin_sampled_rate passive_observer reproduce "
    "sea sea_cost sea_errors sea_filter sea_rows sea_table ship_decay ship_eigenvalues somersault summary tail_rate "
    "write_page",
    "proofs": "BITS LETTERS MOST_BOXES MOST_DERIVED MOST_LETTERS OPEN PROVED BallMatrix Box Field Form Proof as_form "
    "blocks box check_box derivative_form digest from_letters graph_rows leaves parse_file prove prove_at_corners "
    "read_file saved_graph saved_levels show_conditions to_letters",
    "proofs.checker": "ROUND TaylorEnclosure halves leaves plain series show_definite",
    "report": "PALETTE EstimateReport audit_figure certificate_figure draw_audit draw_certificate figure new_figure "
    "save_figure table write_article write_audit write_html write_png write_report",
    "simulation": "Backstepping PiecewiseInputs Reference PositionSensor follow hold lissajous logged_inputs no_input "
    "observe sense set_point simulate simulate_piecewise stamps",
    "workflow": "AbstractResult AbstractTable AuditResult CertificateCheckResult CertifyResult CheckResult CiteResult "
    "CompareForceResult CompareResult Determinacy DoctorResult EstimateResult ExcitationResult ExportResult FitResult "
    "InitResult MetricResult MisfitError ModelResult Progress Pushes ReducedOrderResult ReproduceResult SimulateResult "
    "SmoothResult TuneResult audit_observer certify check check_certificate check_model_output check_output cite "
    "compare compare_force describe_model design_excitation design_metric design_reduced_order doctor estimate "
    "export fit init reproduce_paper simulate smooth tune",
}


FILES = sorted(path for path in SOURCE.rglob("*.py") if path.parent.name != "templates")
"""The modules of the library; a template is one of another program."""


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def place(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


def room_of(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imported(path: Path) -> Iterator[tuple[str, str]]:
    """What a file imports anywhere, inside functions too: the full name, and the name that it has in the file."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, alias.asname or alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((f"{node.module}.{alias.name}", alias.asname or alias.name) for alias in node.names)


def imported_rooms(path: Path) -> set[str]:
    return {name.split(".")[1] for name, _ in imported(path) if name.startswith("covariant.")}


OF_TUPLES = ("_asdict", "_fields", "_make", "_replace")
"""What Python calls the public methods of a named tuple, so that they are none of its fields."""


def private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name not in OF_TUPLES


def right_of(path: Path) -> list[str]:
    """The rooms that a file imports although the plan puts them to the right of its own."""
    plan, room = PLAN.split(), room_of(path)
    if room == "__init__":  # the front door loads every room
        return sorted(imported_rooms(path) - set(plan))
    assert room in plan, f"{room} is not in the import plan; give it a place"
    return sorted(other for other in imported_rooms(path) if plan.index(other) > plan.index(room))


def test_rooms_import_only_from_their_left():
    wrong = {place(path): right_of(path) for path in FILES}
    assert not {file: rooms for file, rooms in wrong.items() if rooms}, "these imports go to the right of the plan"


def test_proofs_know_functions_and_boxes_and_no_model():
    rooms = set().union(*(imported_rooms(path) for path in (SOURCE / "proofs").rglob("*.py")))
    assert rooms == {"_compile", "_templates", "_typing", "lowering", "proofs"}


def uses_private(path: Path) -> set[str]:
    """The private names of other rooms that a file imports or reads."""
    room, others, wrong = room_of(path), set(), set()
    for name, here in imported(path):
        package, *parts = name.split(".")
        if package == "covariant" and parts[0] != room:
            others.add(here)
            wrong |= {name} if any(map(private, parts[1:])) else set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Attribute) and private(node.attr) and ast.unparse(node.value) in others:
            wrong.add(ast.unparse(node))
    return wrong


def test_no_room_uses_what_is_private_to_another():
    wrong = {place(path): uses_private(path) for path in FILES}
    assert not {file: names for file, names in wrong.items() if names}, "let those rooms offer them as public names"


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(SOURCE.parent).with_suffix("").parts).removesuffix(".__init__")


def test_modules_import_each_other_in_no_circle():
    """Imports inside functions count like those at the top of a file, and those for types alone do too."""
    modules = {module_of(path): path for path in FILES}
    needs: dict[str, set[str]] = {}
    for module, path in modules.items():
        names = {name for name, _ in imported(path) if name.startswith("covariant")}
        found = {name if name in modules else name.rpartition(".")[0] for name in names}
        needs[module] = (found & set(modules)) - {module}
    graphlib.TopologicalSorter(needs).prepare()  # raises CycleError, which names the circle


MOST_LINES, MOST_LINES_OF = 400, {"certificates/_check.py": 280}
"""Of the check, which has to be believed, less than of others."""


def test_no_file_is_too_long_to_be_read_in_one_sitting():
    """Docstrings, which are read one at a time, do not count."""

    def length(path: Path) -> int:
        return path.read_text(encoding="utf-8").count("\n") - sum(lines for _, lines in docstrings(tree(path)))

    assert not {place(path) for path in FILES if length(path) > MOST_LINES_OF.get(place(path), MOST_LINES)}


def test_kinds_of_models_are_told_apart_by_what_they_offer():
    """At most so many lines ask for the kind of a model: each is a place that a third kind would have to know."""
    kinds = re.compile(r"isinstance\(.*(StateSpace|MechanicalSystem|Lagrangian|GroupSystem|Craft)\b")
    lines = [line for path in FILES for line in path.read_text(encoding="utf-8").split("\n")]
    asked = [line for line in lines if kinds.search(line)]
    assert len(asked) <= 5, "\n".join(asked)


def test_every_module_opens_with_what_it_is():
    assert not [place(path) for path in FILES if not ast.get_docstring(tree(path))]


SHARED = {"Product"}
"""A product of spaces is a space, and one of groups a group."""


def test_a_class_is_public_in_one_room_and_defined_once():
    """There is one `Box` and one `Metric`."""
    public = Counter(name for names in PUBLIC.values() for name in names.split() if name[0].isupper())
    assert {name for name, count in public.items() if count > 1} == SHARED
    defined = Counter(name for path in FILES for name in classes(path))
    assert {name: count for name, count in defined.items() if count > 1 and name in public} == dict.fromkeys(SHARED, 2)
    others = [name for path in FILES for name in aliases(path)]
    assert not {"Box", "Metric"} & set(others)


def classes(path: Path) -> list[str]:
    return [node.name for node in tree(path).body if isinstance(node, ast.ClassDef)]


def aliases(path: Path) -> Iterator[str]:
    """Names that a file gives to anything at its top level."""
    for node in tree(path).body:
        if isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))


EAGER = "geometry models metrics observers simulation proofs certificates calibration codegen engine"
"""Rooms all of whose public names load without an optional package."""

LOAD = """
import importlib, json, sys

brought, known = {}, set()
for module in %s:
    loaded = importlib.import_module(module)
    for name in loaded.__all__ if module != "covariant" else ():
        getattr(loaded, name)
    present = {name for name in %s if name in sys.modules}
    brought[module] = sorted(present - known)
    known |= present
print(json.dumps(brought))
"""


def test_imports_bring_in_no_optional_package():
    """In one process, the front door first and then one room after another, each to the right of the one before."""
    modules = ["covariant", *(f"covariant.{room}" for room in PLAN.split() if room in EAGER.split())]
    done = subprocess.run(
        [sys.executable, "-c", LOAD % (modules, OPTIONAL)], capture_output=True, text=True, check=True
    )
    brought = json.loads(done.stdout)
    assert list(brought) == modules
    assert not {module: names for module, names in brought.items() if names}


def disagreements(room: str) -> Iterator[str]:
    """Public names that were not agreed on, agreed ones that are missing, and those without a docstring."""
    module = importlib.import_module(f"covariant.{room}")
    inner = {name.removeprefix(f"{room}.") for name in PUBLIC if name.startswith(f"{room}.")}
    files = {path.stem for path in (SOURCE / room.replace(".", "/")).glob("[!_]*.py")}
    agreed = {*PUBLIC[room].split(), *inner, *files}
    yield from (f"{room}.{name} is public in one of PUBLIC and __all__ only" for name in agreed ^ {*module.__all__})
    if len(module.__all__) != len(set(module.__all__)) or len(PUBLIC[room].split()) != len(set(PUBLIC[room].split())):
        yield f"{room} has a name twice"
    if not module.__doc__:
        yield f"{room} has no docstring"
    for name in {*PUBLIC[room].split()} & {*module.__all__}:
        value = getattr(module, name)
        alias = get_origin(value) is not None  # which cannot have a docstring
        # Python writes a docstring that opens with the call where a dataclass has none.
        if callable(value) and not alias and (not value.__doc__ or value.__doc__.startswith(f"{name}(")):
            yield f"{room}.{name} has no docstring"


def test_public_names_are_the_agreed_ones_and_documented():
    assert not [what for room in PUBLIC for what in disagreements(room)]


def test_every_room_has_a_list_of_its_public_names():
    rooms = {".".join(path.parent.relative_to(SOURCE).parts) for path in SOURCE.glob("*/**/__init__.py")}
    assert rooms == {*PUBLIC, "cli", "papers"}, "a new room needs its list of public names here"


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
