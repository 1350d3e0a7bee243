"""The package's face: lazy names, their stub, the tables of scripts and the data's sums."""

import ast
import hashlib
import inspect
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

import pneuopt

ROOT = Path(__file__).parents[1]
PUBLIC_NAMES = [
    "AOptimal",
    "AccelerationFeedback",
    "DOptimal",
    "ExperimentDesign",
    "GainSchedule",
    "PositionLoop",
    "PressureFeedback",
    "next_experiment",
    "Precision",
    "Actuator",
    "AirUse",
    "AntiWindup",
    "add_dead_time",
    "apply_scenario",
    "Asymmetric",
    "Assumption",
    "Checkup",
    "check",
    "Severity",
    "plot_logs",
    "average_dither",
    "BandCentre",
    "BatchEvaluation",
    "Bootstrap",
    "bootstrap",
    "bumpless_transfer",
    "catalog",
    "Certificate",
    "certificate",
    "certify",
    "ChosenWindow",
    "ClosedLoop",
    "coarse_delay",
    "Code",
    "compare_logs",
    "contacts",
    "ControlRate",
    "CompensatorVerdict",
    "ConvergenceError",
    "corners",
    "Coulomb",
    "Cylinder",
    "Defect",
    "define",
    "DesignValidation",
    "differentiate",
    "DeadZoneInverse",
    "Direction",
    "DiscreteSystem",
    "discretise",
    "Dither",
    "dither_effect",
    "DitherVerdict",
    "draws",
    "Encoder",
    "EnergyUse",
    "evaluate",
    "evaluate_batch",
    "EventKind",
    "expected_plants",
    "ExpectedPlants",
    "Experiment",
    "Factor",
    "Feedforward",
    "find_limit_cycle",
    "Finding",
    "FirstOrder",
    "ForceDrive",
    "Form",
    "frequency_response",
    "friction_ladder",
    "from_control",
    "to_control",
    "FrictionFeedforward",
    "FullSpace",
    "GainMargin",
    "grid",
    "Huber",
    "IAE",
    "examine_logs",
    "identifiability",
    "IdentificationResult",
    "identify",
    "ImpulsiveControl",
    "InputError",
    "Integrator",
    "Intersample",
    "ISE",
    "IsentropicNozzle",
    "Iso6358",
    "ITAE",
    "judge_compensators",
    "judge_dither",
    "Journal",
    "Karnopp",
    "Knocker",
    "Language",
    "MotionFeedforward",
    "export_controller",
    "export_fmu",
    "export_settings",
    "Block",
    "LeastSquares",
    "LimitCycle",
    "linear_plant",
    "load_result",
    "local_sensitivity",
    "Linearisation",
    "Load",
    "LoadDependent",
    "LocalSensitivity",
    "LogComparison",
    "LogFinding",
    "LogNormal",
    "LogUniform",
    "LuGre",
    "Margins",
    "margins",
    "monte_carlo",
    "Mark",
    "MaxComplementarySensitivity",
    "MaxSensitivity",
    "mean_start",
    "ModelSelection",
    "MotionDrive",
    "NoHunting",
    "NoiseGain",
    "Normal",
    "open_loop",
    "open_executor",
    "Overshoot",
    "ParallelForm",
    "Parameter",
    "ParameterSet",
    "pareto_front",
    "PeakControl",
    "PhaseMargin",
    "PhysicsWarning",
    "PID",
    "plot_bode",
    "plot_correlation",
    "plot_distribution",
    "plot_fit",
    "plot_friction",
    "plot_front",
    "plot_loop",
    "plot_map",
    "plot_sensitivity",
    "Sensitivity",
    "stick_slip_drive",
    "sensitivity",
    "plot_prediction",
    "plot_residuals",
    "plot_steps",
    "plotting",
    "PneumaticDrive",
    "PneuoptError",
    "Polytropic",
    "predict",
    "Presliding",
    "Processes",
    "PressureDependent",
    "Profile",
    "profile",
    "propagate_error",
    "Progress",
    "PropagatedValue",
    "proportional_band",
    "proportional_gain",
    "ProportionalValve",
    "Quantity",
    "read_drive",
    "read_log",
    "read_tuning",
    "record",
    "Racing",
    "read_cases",
    "Move",
    "MoveProfile",
    "Tolerance",
    "Compliance",
    "FollowingError",
    "FollowingErrorRMS",
    "OvershootDistance",
    "check_move",
    "ExcitationRun",
    "excitation_run",
    "shortest_move",
    "MoveSequence",
    "MotionPath",
    "read_path",
    "Recording",
    "Reference",
    "Report",
    "resample",
    "respond",
    "Rig",
    "Ripple",
    "ripple",
    "RiseTime",
    "RotaryDrive",
    "RowFile",
    "samples",
    "Sampling",
    "save_figure",
    "SecondOrder",
    "search_again",
    "select_model",
    "Sensor",
    "SensorLag",
    "SeriesForm",
    "SettlingTime",
    "SettlingTimeRaw",
    "simulate",
    "simulate_stick_slip",
    "SoftL1",
    "split",
    "Spool",
    "StandardForm",
    "Status",
    "SteadyStateError",
    "Step",
    "step_metrics",
    "StepEnvelope",
    "StickSlipResult",
    "Stribeck",
    "sweep",
    "sweep_from_neighbours",
    "System",
    "Thermal",
    "to_parallel",
    "to_series",
    "to_standard",
    "tolerances",
    "Trajectory",
    "Tracking",
    "DesignOutlook",
    "predict_loss",
    "track",
    "plot_tracking",
    "tune",
    "tune_without_dither",
    "TuningResult",
    "TwoPhase",
    "Uniform",
    "Usefulness",
    "validate",
    "validate_design",
    "Verdict",
    "Viscous",
    "WantedPrecision",
    "Waveform",
    "with_sensors",
    "write_fit",
    "write_report",
    "write_tuned",
    "RestCase",
    "RestCheck",
    "RestKind",
    "check_rest",
]
PUBLIC_MODULES = ("catalog", "plotting")


def test_the_public_names_are_these() -> None:
    assert sorted(pneuopt.__all__) == sorted(PUBLIC_NAMES)
    assert dir(pneuopt) == sorted(PUBLIC_NAMES)


@pytest.mark.parametrize("name", PUBLIC_NAMES)
def test_every_name_loads_and_is_what_it_says(name: str) -> None:
    value = getattr(pneuopt, name)
    assert inspect.ismodule(value) if name in PUBLIC_MODULES else callable(value)


def test_the_import_of_a_module_does_not_hide_the_verb_of_its_name() -> None:
    code = "import pneuopt.identification.identify; print(pneuopt.identify)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.startswith("<function identify")


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="idenfity"):
        pneuopt.idenfity  # type: ignore[attr-defined]  # noqa: B018 - the access is what is tested


def test_importing_the_package_loads_nothing_heavy() -> None:
    heavy = "numpy scipy pandas casadi matplotlib pint typer"
    code = f"import sys, pneuopt; print([m for m in {heavy.split()} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_the_version_is_that_of_the_newest_changes() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"^## ([\d.]+)( \(unreleased\))?$", text, re.MULTILINE)
    assert newest is not None
    assert pneuopt.__version__ == newest[1] + (".dev0" if newest[2] else "")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.+)$", citation, re.MULTILINE) == [pneuopt.__version__]


def test_the_data_are_those_that_the_readme_lists() -> None:
    text = (ROOT / "data" / "README.md").read_text(encoding="utf-8")
    listed = {path: digest for digest, path in re.findall(r"^([0-9a-f]{64})  (\S+)$", text, re.MULTILINE)}
    logs = sorted(p.relative_to(ROOT / "data").as_posix() for p in (ROOT / "data").glob("*/*.csv"))
    assert sorted(listed) == logs
    for path, digest in listed.items():
        assert hashlib.sha256((ROOT / "data" / path).read_bytes()).hexdigest() == digest


def test_the_table_of_claims_names_scripts_that_exist() -> None:
    text = (ROOT / "problems" / "README.md").read_text(encoding="utf-8")
    named = set(re.findall(r"problems/\w+/\w+\.py", text))
    scripts = (p for p in (ROOT / "problems").rglob("*.py") if "__main__" in p.read_text(encoding="utf-8"))
    assert named == {p.relative_to(ROOT).as_posix() for p in scripts}


def imports_of(path: Path) -> set[str]:
    """The modules of pneuopt that a file imports when it runs, wherever in the file; not those for type checking."""
    found: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            for other in node.orelse:
                visit(other)
            return
        if isinstance(node, ast.ImportFrom) and node.module:
            found.update({node.module, *(f"{node.module}.{a.name}" for a in node.names)})
        if isinstance(node, ast.Import):
            found.update(a.name for a in node.names)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(path.read_text(encoding="utf-8")))
    return found


def import_circle(imports: Mapping[str, Iterable[str]]) -> list[str]:
    """Modules each of which imports the next, and the last the first; empty where there is no circle."""
    done: set[str] = set()

    def search(module: str, path: list[str]) -> list[str]:
        if module in path:
            return [*path[path.index(module) :], module]
        if module in done:
            return []
        for other in sorted(imports[module]):
            if circle := search(other, [*path, module]):
                return circle
        done.add(module)
        return []

    return next((circle for module in sorted(imports) if (circle := search(module, []))), [])


def test_no_module_imports_itself_round_a_circle() -> None:
    files = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in (ROOT / "pneuopt").rglob("*.py")}
    modules = {name.removesuffix(".__init__"): path for name, path in files.items()}
    circle = import_circle({n: (imports_of(p) & modules.keys()) - {n, "pneuopt"} for n, p in modules.items()})
    assert not circle, " -> ".join(circle)


def test_a_circle_is_found_and_named() -> None:
    assert import_circle({"a": ["b"], "b": ["c"], "c": ["b"]}) == ["b", "c", "b"]
    assert import_circle({"a": ["b", "c"], "b": ["c"], "c": []}) == []


def test_an_import_for_type_checking_only_is_no_arrow(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text("if TYPE_CHECKING:\n    import a\nelse:\n    import b\n\ndef f():\n    from c import d\n")
    assert imports_of(path) == {"b", "c", "c.d"}
