"""`write_report`: a page of each result, with the figures for which there is something to draw.

The page that moves: its responses are those of `simulate`, its verdicts those of the certificate, its names text.
"""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pneuopt as po
from pneuopt.control.controller import Feedforward
from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop, add_disturbances
from pneuopt.control.pid import PID, Form
from pneuopt.control.reference import Step
from pneuopt.control.sensor import SensorLag
from pneuopt.dynamics.simulate import simulate
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.response import loop_inputs, sample_spacing
from pneuopt.export.languages import write_loop_javascript
from pneuopt.files.drive import read_drive
from pneuopt.files.tuning import read_tuning
from pneuopt.identification.identify import identify
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.logs.read_log import read_log
from pneuopt.models.catalog import t32
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb, Karnopp, Stribeck
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import ParameterSet
from pneuopt.quantities.report import Line, Report
from pneuopt.quantities.results import Shown
from pneuopt.report.fit_page import PageHead
from pneuopt.report.page import render_page, report_forms
from pneuopt.report.tuning_page import LoopView, RestFinder, live_script, simulation_page, to_script
from problems.demo.moving_page import t32_loop
from problems.shared.live_page import compare_settings, live_data, random_settings
from tests.report.reading import HOSTILE, Read, read_page


@pytest.fixture(scope="module")
def fit(axis_logs: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> tuple[IdentificationResult, Experiment]:
    """A fit and its log."""
    from tests.conftest import DRIVE

    folder = tmp_path_factory.mktemp("fit")
    (folder / "run_01.csv").write_text(axis_logs["run_01"], "utf-8")
    (folder / "drive.toml").write_text(DRIVE, "utf-8")
    drive, parameters = read_drive(folder / "drive.toml")
    log = read_log(folder / "run_01.csv")
    return identify(drive.system(), log, parameters), log


@pytest.fixture
def loop() -> tuple[ClosedLoop, ParameterSet]:
    made = ClosedLoop(SecondOrder().system(), PID(limits=False))
    return made, made.parameters.with_values({"pid.Kp": 0.02, "pid.Ki": 0.1, "pid.Kd": 5e-4, "pid.Tf": 1e-3})


def headings(read: Read) -> list[str]:
    return [words for tag, words in read.words if tag == "h2"]


def test_a_fit_alone_has_tables_and_no_figure_of_its_logs(
    fit: tuple[IdentificationResult, Experiment], tmp_path: Path
) -> None:
    po.write_report(fit[0], tmp_path / "fit.html")
    read = read_page(tmp_path / "fit.html")
    assert headings(read) == ["Estimates", "Agreement with the logs", "Known values", "Provenance"]
    assert "load.force 0 N" in read.text, "what was given"
    assert "load.mass 5 kg" not in read.text, "a start is not"
    assert len(read.named("figure")) == 1, "the correlation"


def test_a_held_out_log_is_predicted(fit: tuple[IdentificationResult, Experiment], tmp_path: Path) -> None:
    result, log = fit
    drive = ForceDrive(Coulomb())
    po.write_report(result, tmp_path / "a.html", title="A & B", model=drive, experiments=log, held_out=[log])
    read = read_page(tmp_path / "a.html")
    assert ("h1", "A & B") in read.words
    wanted = ["Estimates", "Agreement with the logs", "Held-out runs", "Friction", "Residuals", "Known values"]
    wanted += ["Data", "Provenance"]
    assert headings(read) == wanted
    with pytest.raises(InputError, match="held-out logs are predicted with the model"):
        po.write_report(result, tmp_path / "b.html", held_out=log)
    assert not (tmp_path / "b.html").exists()


def test_a_certificate_has_steps_margins_and_forms(loop: tuple[ClosedLoop, ParameterSet], tmp_path: Path) -> None:
    made, parameters = loop
    found = certificate(made, Step(1.0), parameters)
    place = tmp_path / "a.html"
    po.write_report(found, place, model=made, references=Step(1.0), parameters=parameters)
    read = read_page(place)
    assert headings(read) == ["Metrics", "Gains in every form", "Margins", "The loop", "Try it"]
    assert len(read.named("figure")) == 3
    with pytest.raises(InputError, match="give parameters with the loop"):
        po.write_report(found, place, model=made, references=Step(1.0))
    with pytest.raises(InputError, match="with its references"):
        po.write_report(found, place, model=made, parameters=parameters)


def test_forms_are_those_of_the_conversions_and_a_form_that_does_not_exist_says_so(
    loop: tuple[ClosedLoop, ParameterSet],
) -> None:
    made, parameters = loop
    text = report_forms(made.controller, parameters).to_text(200)
    for words in ("Ki 0.1 V/m", "Ti 200 ms", "Td 25 ms", "N 25", "K 0.0170502"):
        assert words in text, text
    text = report_forms(made.controller, parameters.with_values({"pid.Ki": 1.0})).to_text(200)
    assert "no series form has these gains" in text


def test_any_other_result_has_its_summary(tmp_path: Path) -> None:
    class Found(Shown):
        def summary(self) -> Report:
            return Report((Line("nothing is wrong"), Line("at all")))

    po.write_report(Found(), tmp_path / "a.html")
    read = read_page(tmp_path / "a.html")
    assert ("h1", "Found") in read.words
    assert read.words.index(("p", "nothing is wrong")) < read.words.index(("h2", "Result"))
    with pytest.raises(InputError, match="a report is written of a result, got dict"):
        po.write_report({}, tmp_path / "b.html")  # type: ignore[arg-type]


NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="node runs the script")
POINTS = 300
AGREEMENT = 1e-6  # of each signal's largest value
STEP = Step(0.2, horizon=0.4)
HELD = Step(0.0, initial=0.2, at=0.05, horizon=0.3, disturbance={"load.force": 30.0})
AXIS = {"load.mass": 6.0, "friction.coulomb": 25.0, "friction.static": 35.0, "friction.viscous": 40.0}


def run_script(script: str, tmp_path: Path) -> Any:
    """What the script logs, as JSON, where there is no page."""
    place = tmp_path / "script.js"
    place.write_text(script, encoding="utf-8")
    done = subprocess.run([NODE or "node", str(place)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def largest_difference(loop: ClosedLoop, cases: list[ParameterSet], reference: Step, tmp_path: Path) -> float:
    """Between a page's responses and `simulate`, over states and outputs, each as a share of its largest value."""
    starts = [loop.initial(p, reference=reference.initial).tolist() for p in cases]
    jobs = [[loop.parameter_vector(p).tolist(), x0] for p, x0 in zip(cases, starts, strict=True)]
    ends = {"at": reference.at, "initial": reference.initial, "final": reference.final}
    call = f"simulateLoop(p, x0, {json.dumps(ends)}, {reference.horizon}, {POINTS})"
    told = f"console.log(JSON.stringify({to_script(jobs)}.map(([p, x0]) => {{ const r = {call};"
    told += " return [...r.states, ...r.outputs].map((a) => Array.from(a)); })));"
    found = run_script(write_loop_javascript(loop) + told, tmp_path)
    worst, t = 0.0, np.linspace(0, reference.horizon, POINTS + 1)
    for p, x0, signals in zip(cases, starts, found, strict=True):
        inputs = loop_inputs(loop, reference, sample_spacing(loop, reference, p))
        run = simulate(loop, inputs, p, initial=np.array(x0), t_out=t, max_steps=np.inf)
        names = [q.name for q in (*loop.states, *loop.outputs)]
        for name, signal in zip(names, signals, strict=True):
            size = max(float(np.abs(run[name]).max()), 1e-9)
            worst = max(worst, float(np.abs(run[name] - np.array(signal)).max()) / size)
    return worst


def axis_loop(**options: Any) -> tuple[ClosedLoop, ParameterSet]:
    pid = options.pop("pid", PID(sample_time=1e-3))
    loop = ClosedLoop(ForceDrive(Stribeck()).system(), pid, **options)
    gains = {"pid.Kp": 300.0, "pid.Ki": 5000.0} if pid.form is Form.PARALLEL else {"pid.Kp": 300.0, "pid.Ti": 0.06}
    return loop, loop.complete(loop.parameters.with_values(AXIS | gains | {"pid.lower": -150.0, "pid.upper": 150.0}))


@needs_node
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"pid": PID()},
        {"pid": PID(sample_time=2e-3, form=Form.STANDARD, delay=1)},
        {"dither": Dither(100.0), "sensor": SensorLag(2e-3)},
        {"feedforward": Feedforward(), "pid": PID(sample_time=1e-3, dead_band=True)},
    ],
    ids=["sampled", "continuous", "delayed", "dither", "feedforward"],
)
def test_responses_are_those_of_simulate(options: dict[str, Any], tmp_path: Path) -> None:
    loop, p = axis_loop(**options)
    p = p.with_values({"dither.amplitude": 8.0} if loop.dither else {})
    assert largest_difference(loop, [p], replace(STEP, at=0.05), tmp_path) < AGREEMENT


@needs_node
@pytest.mark.parametrize("reference", [STEP, replace(STEP, size=0.1, initial=0.1), HELD], ids=lambda r: r.label)
@pytest.mark.parametrize("pid", [PID(), PID(sample_time=1e-3)], ids=["continuous", "sampled"])
def test_each_setting_begins_at_its_own_rest(reference: Step, pid: PID, tmp_path: Path) -> None:
    loop, p = axis_loop(pid=pid)

    def run(script: str) -> Any:
        return run_script(f"{script}console.log(JSON.stringify(told));", tmp_path)

    assert compare_settings(loop, p, [reference], 4, run) < AGREEMENT


@needs_node
def test_a_drive_s_rest_moves_with_supply_and_load(tmp_path: Path) -> None:
    loop, p = t32_loop()
    starts = [Step(0.2), Step(0.2, start={"position": 0.05, "pressure_b": 3.5e5}), replace(HELD, horizon=1.0)]
    script = live_script(loop, starts, p)
    data, disturbed = live_data(script), add_disturbances(loop, starts)
    assert {"supply.pressure", "load.force", "friction.coulomb"} <= {s["name"] for s in data["sliders"]}
    cases = random_settings(data, p, 20)
    jobs = to_script([disturbed.parameter_vector(q).tolist() for q in cases])
    call = f"{jobs}.map((p) => DATA.references.map((r) => Array.from(findRest(Float64Array.from(p), r))))"
    found = run_script(f"{script}console.log(JSON.stringify({call}));", tmp_path)
    nominal = np.array([q.nominal for q in disturbed.states])
    for p_case, rests in zip(cases, found, strict=True):
        for r, x0 in zip(starts, rests, strict=True):
            expected = disturbed.initial(p_case, reference=r.initial, start=r.start)
            assert np.abs((np.array(x0) - expected) / nominal).max() < 1e-8


@needs_node
def test_a_setting_that_no_command_holds_has_no_rest(tmp_path: Path) -> None:
    loop, p = axis_loop()
    script = live_script(loop, [STEP], p)
    heavy = to_script(loop.parameter_vector(p.with_values({"load.force": 200.0})).tolist())
    told = f"console.log(JSON.stringify(findRest(Float64Array.from({heavy}), DATA.references[0])));"
    assert run_script(script + told, tmp_path) is None


@needs_node
@pytest.mark.slow
def test_fifty_settings_of_t32_are_those_of_simulate(tmp_path: Path) -> None:
    drive, hardware = t32()
    loop = ClosedLoop(drive.system(), PID(sample_time=1e-3), Dither(160.0))
    rng = np.random.default_rng(0)
    base = loop.complete(hardware).with_values({"pid.lower": -5.0, "pid.upper": 5.0})
    cases = []
    for _ in range(50):
        factors = {
            n: base.value(n) * rng.uniform(0.7, 1.4) for n in ("load.mass", "friction.coulomb", "friction.viscous")
        }
        gains = {"pid.Kp": rng.uniform(1, 6), "pid.Ki": rng.uniform(5, 50), "dither.amplitude": rng.uniform(0, 0.6)}
        cases.append(base.with_values(factors | gains))
    assert largest_difference(loop, cases, Step(0.2, horizon=1.0), tmp_path) < AGREEMENT


@needs_node
def test_the_figures_of_the_design_are_the_certificates(tmp_path: Path) -> None:
    loop, p = axis_loop(dither=Dither(100.0))
    p = p.with_values({"dither.amplitude": 6.0})
    found = certificate(loop, STEP, p)
    script = live_script(loop, [STEP], p, limits={"Overshoot": 5.0}, certified=found.metrics)
    script += "const reference = DATA.references[0]; const run = simulateLoop(DATA.values, reference.x0, reference, "
    script += "reference.horizon, POINTS); console.log(JSON.stringify(readMetrics(run, DATA.values, reference)));"
    told, certified = run_script(script, tmp_path), found.metrics.iloc[:, 0]
    assert told["Overshoot"] == pytest.approx(certified["Overshoot"], abs=0.1)
    assert told["SettlingTime"] == pytest.approx(certified["SettlingTime"], abs=2e-3)
    assert told["PeakControl"] == pytest.approx(certified["PeakControl"], rel=1e-2)


@needs_node
def test_what_is_copied_is_read_back(folder: Path) -> None:
    loop, p = axis_loop()
    text = run_script(live_script(loop, [STEP], p) + "console.log(JSON.stringify(tuningText(DATA.values)));", folder)
    assert 'Kp = "300 N*s/m"' in text
    rest = '[[reference]]\nstep = "0.2 m/s"\nhorizon = "0.3 s"\n'
    (folder / "copied.toml").write_text(f'{text}\nsample_time = "1 ms"\n{rest}', "utf-8")
    assert read_tuning(folder / "copied.toml", loop.plant).parameters.value("pid.Ki") == 5000.0


@needs_node
def test_a_pressure_is_shown_in_bar(tmp_path: Path) -> None:
    loop, p = t32_loop()
    script = live_script(loop, [Step(0.2)], p)
    (supply,) = (s for s in live_data(script)["sliders"] if s["name"] == "supply.pressure")
    assert supply["low"] < p.value("supply.pressure") < supply["high"], "its ends stay in SI units"
    shown = f"quantity({to_script(supply)}, 7.013e5)"
    assert run_script(f"{script}console.log(JSON.stringify({shown}));", tmp_path) == "7.013 bar(a)"


def test_a_load_force_has_a_slider_and_hardware_has_none() -> None:
    loop, p = axis_loop()
    data = live_data(live_script(loop, [STEP], p))
    names = {s["name"] for s in data["sliders"]}
    assert {"pid.Kp", "pid.Ki", "load.mass", "load.force", "friction.coulomb", "friction.viscous"} <= names
    assert not {"pid.lower", "pid.upper", "friction.smoothing"} & names
    assert all(s["low"] <= p.value(s["name"]) <= s["high"] for s in data["sliders"])
    hung = p.with_values({"load.force": 148.0})
    (force,) = (s for s in live_data(live_script(loop, [STEP], hung))["sliders"] if s["name"] == "load.force")
    assert force["high"] < 150.0, "beyond the controller's limit the loop has no rest"


def test_a_loop_without_a_start_has_no_script() -> None:
    loop, p = axis_loop()
    assert live_script(loop, [replace(STEP, initial=10.0)], p) == "", "its limit of 150 N holds no such speed"


def test_a_friction_that_sticks_has_no_script() -> None:
    """It is simulated from event to event; its equations alone slide on."""
    loop = ClosedLoop(ForceDrive(Karnopp(Stribeck())).system(), PID(sample_time=1e-3))
    p = loop.complete(loop.parameters.with_values({"pid.Kp": 300.0, "pid.Ki": 5000.0}))
    assert live_script(loop, [STEP], p) == ""


def test_what_a_rest_leaves_undetermined_has_no_slider() -> None:
    loop, p = axis_loop()
    finder = RestFinder(loop, STEP, p)
    order = [q.name for q in loop.states]
    assert not finder.is_singular([order.index("pid.integral"), order.index("pid.command")])
    assert finder.is_singular([order.index("position")]), "an axis under speed control rests anywhere"


def test_a_page_runs_our_script_and_no_other() -> None:
    loop, p = axis_loop()
    found = certificate(loop, STEP, p)
    page = simulation_page(PageHead(HOSTILE), found, LoopView(loop, [STEP], p))
    text = render_page(replace(page, sections=()))
    read = read_page(text)
    assert text.count("<script>") == text.count("</script>") == 1
    (live,) = (attrs for attrs in read.named("section") if attrs["id"] == "live")
    assert "hidden" in live, "without scripts nothing is missing that stands there"
    whole = read_page(render_page(page))
    (link,) = (attrs for attrs in whole.named("li") if attrs.get("id") == "live-link")
    assert ("hidden" in link, "#live" in [a["href"] for a in whole.named("a")]) == (True, True), "the script shows it"
    assert "<script>" not in render_page(page, draws=False), "an interrupted command makes none"
    assert "<" not in to_script({HOSTILE: float("inf")})
