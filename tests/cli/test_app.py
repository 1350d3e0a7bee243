"""Each command has a line and examples that it would take, within 80 columns; the shell completes."""

import json
import os
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.main import get_command
from typer.testing import CliRunner, Result

from pneuopt.cli import identify as identify_module
from pneuopt.cli import tune as tune_module
from pneuopt.cli.app import COMMAND_HELP, app
from pneuopt.dynamics.simulate import simulate
from pneuopt.files.drive import read_drive, read_status
from pneuopt.files.toml import read_toml
from pneuopt.files.tuning import read_tuning
from pneuopt.logs.read_log import read_log
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.parameters import Intersample
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory
from pneuopt.shooting.least_squares import LeastSquares
from pneuopt.tuning.tune import TuningResult, tune


def run(line: str) -> Result:
    return CliRunner().invoke(app, line.split(), catch_exceptions=False)


def add(name: str, text: str) -> None:
    with Path(name).open("a", encoding="utf-8") as file:
        file.write(text)


def test_identify_recovers_what_made_the_logs_and_says_so(folder: Path, axis_truth: dict[str, float]) -> None:
    result = run("identify drive.toml run_*.csv -o fit.toml --json fit.json --plot fit.png --quiet")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("converged: ")
    assert result.stderr == ""
    assert max(map(len, result.stdout.splitlines())) <= 80
    drive, found = read_drive("fit.toml")
    assert drive == ForceDrive(Coulomb())
    said = json.loads(Path("fit.json").read_text(encoding="utf-8"))
    assert said["status"]["code"] == "converged"
    assert {row["log"] for row in said["fit"]} == {"run_01", "run_02"}
    for row in said["estimates"]:
        assert abs(row["value"] - axis_truth[row["name"]]) < 5 * row["stderr"]
        assert found.value(row["name"]) == pytest.approx(row["value"], rel=1e-8)
        assert row["name"] in result.stdout
    assert "# weighed" in Path("fit.toml").read_text(encoding="utf-8")
    assert Path("fit.png").stat().st_size > 10_000
    for name in ("friction", "residuals", "correlation"):
        assert Path(f"fit_{name}.png").stat().st_size > 10_000
    words = {
        n: said["verdict"][n] for n in ("sentences", "unidentifiable", "unchanged", "indistinguishable", "reasons")
    }
    assert words == {"sentences": [], "unidentifiable": [], "unchanged": [], "indistinguishable": [], "reasons": {}}
    assert said["verdict"]["table"][0]["name"] == "load.mass"


def test_a_fit_that_does_not_predict_its_log_ends_with_1_and_names_what_it_lacks(folder: Path) -> None:
    """The force acts 40 ms after it is logged."""
    t = np.arange(2000) * 2e-3
    force = 120 * np.sign(np.random.default_rng(3).standard_normal(40)).repeat(50)
    drive = ForceDrive(Coulomb())
    late = Trajectory(t, {"force": np.interp(t - 0.04, t, force)})
    speed = simulate(drive.system(), late, drive.parameters, intersample={"force": Intersample.LINEAR})["speed"]
    log = {
        "time [s]": t,
        "force [N]": force,
        "speed [m/s]": speed + 1e-3 * np.random.default_rng(0).normal(size=t.size),
    }
    pd.DataFrame(log).to_csv("late.csv", index=False)
    result = run("identify drive.toml late.csv -o fit.toml --json fit.json -q")
    assert result.exit_code == 1
    words = " ".join(result.stdout.split())
    assert words.startswith(
        "converged, but the model misses the logs: does not predict its own log: the free run misses"
    )
    assert " a dead time of 39." in words or " a dead time of 40" in words
    said = json.loads(Path("fit.json").read_text(encoding="utf-8"))
    assert said["status"]["code"] == "converged, but the model misses the logs"
    assert said["stats"]["free_run_share"] > 0.25
    told = run("simulate fit.toml tuning.toml -q").stderr  # as `pneuopt tune fit.toml tuning.toml`
    assert "does not predict its own log" in " ".join(told.split())


def test_a_refused_log_is_accepted_by_the_name_of_its_check(folder: Path) -> None:
    t = np.arange(1000) * 2e-3
    force = -(30 * np.sign(np.cos(6 * t)) + 20 * np.cos(6 * t))
    log = {"time [s]": t, "position [m]": 0.1 * np.sin(6 * t), "force [N]": force}
    pd.DataFrame(log).to_csv("turned.csv", index=False)
    refused = run("identify drive.toml turned.csv")
    assert refused.exit_code == 2
    assert "change the sign of 'force'" in " ".join(refused.stderr.split())
    assert "--accept work" in refused.stderr
    accepted = run("identify drive.toml turned.csv --accept work --json turned.json")
    assert accepted.exit_code != 2
    assert "accepted as right" in json.loads(Path("turned.json").read_text(encoding="utf-8"))["status"]["message"]
    assert run("identify drive.toml turned.csv --accept werk").exit_code == 2


def test_a_friction_model_is_chosen_and_explained(folder: Path) -> None:
    Path("short.csv").write_text(
        "\n".join(Path("run_01.csv").read_text(encoding="utf-8").splitlines()[:251]) + "\n", encoding="utf-8"
    )
    result = run("identify drive.toml short.csv --select --json chosen.json --report page.html")
    assert result.exit_code == 0, result.stderr
    assert "Choice of a friction model of drive.toml with short.csv" in Path("page.html").read_text("utf-8")
    said = json.loads(Path("chosen.json").read_text(encoding="utf-8"))
    assert said["recommended"] == "coulomb"
    assert result.stdout.startswith(said["reason"])
    assert {row["name"] for row in said["candidates"]} >= {"viscous", "coulomb", "stribeck", "lugre"}
    refused = run("identify drive.toml short.csv --select -o fit.toml")
    assert refused.exit_code == 2
    assert "--select writes neither -o nor --plot" in refused.stderr


def test_an_unidentifiable_parameter_is_named_before_and_after_the_fit(folder: Path) -> None:
    """A drive that moves one way at one speed: no slope, no curve."""
    t = np.arange(0, 1.0, 2e-3)
    position = 50 * t + 0.02 * np.random.default_rng(0).standard_normal(len(t))
    rows = [f"{a:.4f},30,{b:.5f}" for a, b in zip(t, position, strict=True)]
    Path("steady.csv").write_text("\n".join(["time [s],force [N],position [mm]", *rows]) + "\n", encoding="utf-8")
    result = run("identify drive.toml steady.csv --json fit.json")
    assert "warning: before the fit: the logs do not identify" in result.stderr
    assert "before the search" not in result.stderr  # `identify` says it where nothing has been checked
    assert "friction.viscous: nearly all speeds lie between" in result.stderr.replace("\n", " ")
    said = json.loads(Path("fit.json").read_text(encoding="utf-8"))
    assert said["verdict"]["sentences"]
    assert "friction.viscous" in result.stdout


def test_windows_are_fitted_and_predicted_with_free_runs_beside(folder: Path) -> None:
    result = run("identify drive.toml run_01.csv -o fit.toml --json fit.json --window 0.1")
    assert result.exit_code == 0
    assert "windows of 0.1 s are fitted, each with a start of its own, as given" in result.stdout.replace("\n", " ")
    assert json.loads(Path("fit.json").read_text(encoding="utf-8"))["window"]["duration"] == 0.1
    assert run("simulate fit.toml --log run_02.csv --window 0.1 --json p.json -o p.csv").exit_code == 0
    (row,) = json.loads(Path("p.json").read_text(encoding="utf-8"))["fit"]
    assert row["rmse"] < row["free_run_rmse"]
    assert len(read_log("p.csv").trajectory) == len(read_log("run_02.csv").trajectory)
    refused = run("simulate fit.toml tuning.toml --window 0.1")
    assert (refused.exit_code, "--window cuts a log: give it with --log" in refused.stderr) == (2, True)


def test_tune_certifies_and_its_file_simulates_to_the_same_figures(folder: Path) -> None:
    result = run("tune drive.toml tuning.toml -o tuned.toml --json tuned.json --plot tuned.svg")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("converged: ")
    assert "standard form: Kp" in result.stdout
    said = json.loads(Path("tuned.json").read_text(encoding="utf-8"))
    certified = said["certified"][0]
    assert certified["Overshoot"] <= 10.0
    tuned = read_toml("tuned.toml").unwrap()
    assert tuned["status"]["code"] == "converged"
    assert tuned["certified"]["0 to 0.2"]["SettlingTime"] == certified["SettlingTime"]
    assert {"sha256[drive.toml]", "sha256[tuning.toml]"} <= tuned["provenance"].keys()
    assert "# by hand" in Path("tuned.toml").read_text(encoding="utf-8")
    again = run("simulate drive.toml tuned.toml --json again.json -o run.csv --plot run.pdf")
    assert again.exit_code == 0
    assert json.loads(Path("again.json").read_text(encoding="utf-8"))["certified"][0]["SettlingTime"] == pytest.approx(
        certified["SettlingTime"]
    )
    response = read_log("run.csv").trajectory
    assert {"speed_reference", "speed", "force"} <= set(response.names)
    assert response["speed"][-1] == pytest.approx(0.2, rel=0.05)
    assert all(Path(f).exists() for f in ("tuned.svg", "tuned_bode.svg", "run.pdf", "run_bode.pdf"))


def test_a_tuning_that_fails_says_so_first_and_writes_its_best_candidate_beside(folder: Path) -> None:
    add("tuning.toml", 'settling_time = { max = "3 ms", band = "5 %" }\n')
    Path("tuned.toml").write_text("# of an earlier tuning", encoding="utf-8")
    result = run("tune drive.toml tuning.toml -o tuned.toml --json tuned.json")
    assert result.exit_code == 1
    assert result.stdout.startswith("NOT converged (no answer found keeps all limits): ")
    assert "the gains of tuning.toml stand; rejected: pid.Kp" in result.stdout
    assert Path("tuned.toml").read_text("utf-8") == "# of an earlier tuning"
    assert "wrote tuned_best.toml\ntuned.toml stays as it was, for no design is certified" in result.stdout
    status = read_status("tuned_best.toml")
    assert status is not None
    assert status.code is Code.INFEASIBLE
    gains = read_tuning("tuned_best.toml", read_drive("drive.toml")[0].system()).parameters
    best = json.loads(Path("tuned.json").read_text(encoding="utf-8"))["best"]
    assert {n: gains.value(n) for n in best} == pytest.approx(best)
    assert best["pid.Kp"] != 100.0
    assert "certified" not in read_toml("tuned_best.toml")
    again = run("tune drive.toml tuned_best.toml -o tuned.toml -q")
    assert again.exit_code == 1
    assert Path("tuned_best_best.toml").exists(), "an input is not replaced"


def test_a_log_is_predicted_in_open_loop(folder: Path) -> None:
    drive = Path("drive.toml").read_text(encoding="utf-8").replace("5 kg", "6 kg", 1)
    drive = drive.replace("40 N", "25 N").replace("10 N*s/m", "40 N*s/m")
    Path("drive.toml").write_text(drive, encoding="utf-8")
    result = run("simulate drive.toml --log run_02.csv --json p.json -o p.csv --plot p.png")
    assert result.exit_code == 0
    (row,) = json.loads(Path("p.json").read_text(encoding="utf-8"))["fit"]
    assert (row["log"], row["channel"]) == ("run_02", "position")
    assert row["nrmse"] < 0.01
    assert read_log("p.csv").trajectory["position"] == pytest.approx(
        read_log("run_02.csv").trajectory["position"], abs=2e-4
    )


def test_several_references_make_several_files(folder: Path) -> None:
    more = '[[reference]]\nstep = "0.1 m/s"\nhorizon = "0.3 s"\n'
    add("tuning.toml", more)
    assert run("simulate drive.toml tuning.toml -o run.csv").exit_code == 0
    assert Path("run_1.csv").exists()
    assert Path("run_2.csv").exists()
    Path("tuning.toml").rename("run_2.csv")
    taken = run("simulate drive.toml run_2.csv -o run.csv")
    assert (taken.exit_code, "run_2.csv: is an input" in taken.stderr) == (2, True)


def test_an_interrupted_fit_is_written_and_marked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupting(**_: object) -> LeastSquares:
        seen: list[str] = []

        def stop(line: str) -> None:
            seen.append(line)
            if len(seen) == 4:
                raise KeyboardInterrupt

        return LeastSquares(progress=stop)

    monkeypatch.setattr(identify_module, "LeastSquares", interrupting)
    result = run("identify drive.toml run_01.csv -o fit.toml")
    assert result.exit_code == 130
    assert result.stdout.startswith("NOT converged (interrupted): the best iterate so far")
    status = read_status("fit.toml")
    assert status is not None
    assert status.code is Code.INTERRUPTED
    warned = run("simulate fit.toml --log run_02.csv")
    assert warned.stderr.startswith("warning: fit.toml: its fit is NOT converged (interrupted)")


def test_an_interruption_elsewhere_writes_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tune_module, "tune", interrupt)
    before = set(folder.iterdir())
    result = run("tune drive.toml tuning.toml -o tuned.toml")
    assert result.exit_code == 130
    assert result.stderr == "interrupted: no file was left half-written\n"
    assert set(folder.iterdir()) == before


def test_an_interrupted_tuning_writes_the_best_so_far_and_replaces_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*args: Any, **options: Any) -> TuningResult:
        def stop(line: str) -> None:
            if "generation 3" in line:
                raise KeyboardInterrupt

        return tune(*args, **(options | {"progress": stop}))

    monkeypatch.setattr(tune_module, "tune", stopped)
    Path("tuned.toml").write_text("# of an earlier tuning", encoding="utf-8")
    result = run("tune drive.toml tuning.toml -o tuned.toml --json tuned.json --plot tuned.png")
    assert result.exit_code == 130
    assert result.stdout.startswith("NOT converged (interrupted): the best of 160 simulations so far ")
    assert "the gains of tuning.toml stand; best so far: pid.Kp " in result.stdout
    assert "wrote tuned_best.toml\ntuned.toml stays as it was" in result.stdout
    assert Path("tuned.toml").read_text("utf-8") == "# of an earlier tuning"
    assert not Path("tuned.png").exists()
    said = tomllib.loads(Path("tuned_best.toml").read_text("utf-8"))
    assert said["status"]["code"] == "interrupted"
    assert "holds" not in said["status"]["message"]
    gain = read_tuning("tuned_best.toml", read_drive("drive.toml")[0].system()).parameters.value("pid.Kp")
    assert 10 < gain < 600
    assert gain != 100.0


def test_a_tuning_that_is_interrupted_before_its_first_candidate_writes_no_gains(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*args: Any, **options: Any) -> TuningResult:
        def stop(_: object) -> None:
            raise KeyboardInterrupt

        return tune(*args, **(options | {"progress": stop}))

    monkeypatch.setattr(tune_module, "tune", stopped)
    result = run("tune drive.toml tuning.toml -o tuned.toml")
    assert result.exit_code == 130
    assert "the gains of tuning.toml stand; best so far: none was found" in result.stdout
    assert "tuned.toml is not written" in result.stdout
    assert list(folder.glob("tuned*")) == []


def test_a_fit_that_fails_is_written_and_marked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = LeastSquares().stages[:1]
    monkeypatch.setattr(identify_module, "LeastSquares", lambda **_: LeastSquares(stages=few, tolerance=1e-9))
    result = run("identify drive.toml run_01.csv -o fit.toml")
    assert result.exit_code == 1
    assert result.stdout.startswith("NOT converged")
    assert read_status("fit.toml") != Status(Code.CONVERGED)


def test_version_and_info() -> None:
    assert run("--version").stdout.startswith("pneuopt 0.")
    said = run("info").stdout
    for word in ("casadi", "compiler", "cache", sys.version.split()[0]):
        assert word in said


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "sys.argv = ['pneuopt', '--help']\n"
        "from pneuopt.cli.app import main\n"
        "try: main()\n"
        "except SystemExit as stop: assert stop.code == 0, stop.code\n"
        "heavy = {'pandas', 'matplotlib', 'scipy', 'casadi', 'numpy', 'pint'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for command in ("init", "identify", "tune", "simulate", "study", "keys", "info"):
        assert f"\n  {command} " in done.stdout


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C cannot be sent to another process there")
@pytest.mark.parametrize(("name", "status"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_ends_a_real_process_with_its_status(name: str, status: int, folder: Path) -> None:
    code = (
        "import os, signal, sys\n"
        "from pneuopt.cli import tune\n"
        "number = getattr(signal, sys.argv.pop(1))\n"
        "own = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL\n"
        "signal.signal(number, own)\n"  # a job in the background, or under nohup, inherits it as ignored
        "tune.tune = lambda *a, **k: os.kill(os.getpid(), number)\n"
        "from pneuopt.__main__ import main\n"
        "main()\n"
    )
    arguments = [sys.executable, "-c", code, name, "tune", "-q", "drive.toml", "tuning.toml", "-o", "tuned.toml"]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (status, "interrupted: no file was left half-written\n")
    assert not Path("tuned.toml").exists()


CYLINDER = '[drive]\nkind = "pneumatic"\n[cylinder]\nstart = "80 %"\n[friction]\nmodel = "stribeck"\n'
SPEED_LOOP = """[pid]
sample_time = "1 ms"
Kp = "2 V*s/m"
Ki = "20 V/m"
limits = ["-5 V", "5 V"]
[[reference]]
step = "0.2 m/s"
horizon = "0.4 s"
"""


def test_an_end_stop_is_reported_in_one_line(folder: Path) -> None:
    """From 160 of 200 mm at 0.2 m/s for 0.19 s, with an overshoot; the command goes on."""
    (folder / "cylinder.toml").write_text(CYLINDER, encoding="utf-8")
    fast = SPEED_LOOP.replace("[pid]", "[pid]\nb = 4.0").replace("0.4 s", "0.19 s")
    (folder / "speed.toml").write_text(fast, encoding="utf-8")
    result = run("simulate cylinder.toml speed.toml -o steps.csv")
    assert result.exit_code == 0
    (line,) = result.stderr.splitlines()
    assert line.startswith("warning: the piston reached the front end stop (position 199.9 mm) at t = 0.1")
    assert line.endswith("from there the response is the stop's")


def test_a_horizon_longer_than_the_stroke_allows_is_refused(folder: Path) -> None:
    (folder / "cylinder.toml").write_text(CYLINDER, encoding="utf-8")
    (folder / "speed.toml").write_text(SPEED_LOOP, encoding="utf-8")
    result = run("simulate cylinder.toml speed.toml -o steps.csv")
    assert (result.exit_code, list(folder.glob("steps*"))) == (2, [])
    assert "it leads the piston over 80 mm" in result.stderr
    assert "there are 39.9 mm; end it by horizon = 0.199 s" in result.stderr


def test_impossible_hardware_is_refused_with_its_line(folder: Path) -> None:
    (folder / "cylinder.toml").write_text(CYLINDER.replace('"80 %"', '"80 %"\nrod = "40 mm"'), encoding="utf-8")
    (folder / "speed.toml").write_text(SPEED_LOOP, encoding="utf-8")
    result = run("simulate cylinder.toml speed.toml")
    assert result.exit_code == 2
    assert result.stderr.startswith('error: cylinder.toml:5: [cylinder] rod = "40 mm" is impossible; a rod is thinner')


def test_a_valve_for_0_to_10_V_is_simulated_as_one_about_zero_and_written_as_its_wire_carries(folder: Path) -> None:
    (folder / "cylinder.toml").write_text(CYLINDER.replace("80 %", "30 %"), encoding="utf-8")
    add("cylinder.toml", '[valve]\ncentre = "5.5 V"\n')
    (folder / "wire.toml").write_text(SPEED_LOOP.replace('["-5 V", "5 V"]', '["0 V", "10 V"]'), encoding="utf-8")
    assert run("simulate cylinder.toml wire.toml -o wire_run.csv --json wire.json").exit_code == 0
    (folder / "cylinder.toml").write_text(CYLINDER.replace("80 %", "30 %"), encoding="utf-8")
    (folder / "about.toml").write_text(SPEED_LOOP.replace('["-5 V", "5 V"]', '["-5.5 V", "4.5 V"]'), encoding="utf-8")
    assert run("simulate cylinder.toml about.toml -o about_run.csv --json about.json").exit_code == 0
    wire, about = (read_log(f"{name}_run.csv").trajectory for name in ("wire", "about"))
    assert np.ptp(about["valve_voltage"]) > 0.4
    np.testing.assert_allclose(wire["valve_voltage"], 5.5 + about["valve_voltage"], atol=1e-6)
    np.testing.assert_array_equal(wire["position"], about["position"])
    shown = [json.loads(Path(f"{name}.json").read_text(encoding="utf-8"))["certified"] for name in ("wire", "about")]
    assert shown[0] == shown[1]


COMMANDS = get_command(app).commands  # type: ignore[attr-defined]  # of a click.Group


def test_every_command_has_its_line_and_no_other_has() -> None:
    assert set(COMMAND_HELP) == set(COMMANDS)


@pytest.mark.parametrize("name", COMMAND_HELP)
def test_examples_are_shown_whole_and_would_be_taken(name: str) -> None:
    shown = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "80"}).output
    assert all(len(line) <= 80 for line in shown.splitlines())
    for example in COMMAND_HELP[name].examples:
        assert f"    {example}\n" in shown
        program, command, *arguments = shlex.split(example)
        assert (program, command) == ("pneuopt", name)
        COMMANDS[name].make_context(name, arguments)  # raises where an option or an argument is not there


def test_the_list_of_commands_cuts_no_line() -> None:
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).output
    assert all(said.line in shown for said in COMMAND_HELP.values())


def test_a_shell_completes_commands_and_options() -> None:
    code = "import sys; sys.argv = ['pneuopt']; from pneuopt.__main__ import main; main()"

    def complete(words: str) -> list[str]:
        asked = {"_PNEUOPT_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=os.environ | asked, capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert complete("pneuopt id") == ["identify"]
    assert "--report" in complete("pneuopt tune --re")
