"""The scripts of claims: each holds what it claims. Those that take measured logs skip where the folder is missing."""

from pathlib import Path

import pandas as pd
import pytest

from problems.demo import forged_certificates, other_rigs, rig_demo
from problems.friction import stick_slip
from problems.identify import (
    b32,
    b32_partial,
    bootstrap_bias,
    buck,
    cascaded_tanks,
    emps,
    forecast_band,
    foreign_rig,
    next_experiment,
    real_logs,
    seal_friction,
    step_response,
    windows,
)
from problems.speed import batched_monte_carlo, simulation_speed
from problems.tune import pareto, supply_and_load, tune_drive

DATASETS = Path(__file__).parents[3] / "shared" / "datasets"
measured = pytest.mark.skipif(not DATASETS.is_dir(), reason=f"no measured logs in {DATASETS}")


def failed(rows: pd.DataFrame) -> list[str]:
    return [str(r) for r in rows.loc[~rows["holds"].astype(bool), "name"]]


@measured
@pytest.mark.slow
def test_cascaded_tanks() -> None:
    assert failed(cascaded_tanks.main(DATASETS / "cascaded_tanks" / "dataBenchmark.csv")) == []


@measured
@pytest.mark.slow
def test_buck() -> None:
    assert failed(buck.main(DATASETS / "buck")) == []


@measured
@pytest.mark.slow
def test_emps() -> None:
    rows = emps.main(DATASETS / "emps" / "emps_identification_1khz.csv")
    assert failed(rows) == []


@measured
def test_seal_friction() -> None:
    rows = seal_friction.main(DATASETS / "zillen_seal_friction")
    assert failed(rows) == []
    assert len(rows) == 17


@pytest.mark.slow
def test_step_response() -> None:
    assert failed(step_response.main(step_response.GENERATED)) == []


@pytest.mark.slow
def test_windows() -> None:
    assert failed(windows.main()) == []


@pytest.mark.slow
def test_bootstrap_bias() -> None:
    assert failed(bootstrap_bias.main(bootstrap_bias.run(count=3, rigs=[2]))) == []


@pytest.mark.slow
def test_foreign_rig() -> None:
    assert failed(foreign_rig.main(1)) == []


@pytest.mark.slow
def test_forecast_band() -> None:
    assert failed(forecast_band.main()) == []


@pytest.mark.slow
def test_rig_demo(tmp_path: Path) -> None:
    demo = rig_demo.run()
    assert failed(rig_demo.main(demo)) == []
    figures = rig_demo.figures(demo)
    assert set(figures) == {"rig_demo", "rig_demo_before_after"}
    titles = [ax.get_title() for ax in figures["rig_demo_before_after"].axes]
    assert titles[0] == "before: hand-tuned PID, never settles"
    assert titles[1].startswith("after: PID and dither, mean settles in 0.2")
    for name, figure in figures.items():
        figure.savefig(tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


@pytest.mark.slow
def test_forged_certificates() -> None:
    assert failed(forged_certificates.main()) == []


@pytest.mark.slow
def test_other_rigs() -> None:
    rows = other_rigs.main([2]).set_index("name")
    assert failed(rows.reset_index()) == []
    assert rows["value"]["certified"] == 1
    assert rows["value"]["promises.kept"] == rows["reference"]["promises.kept"] == 3


@pytest.mark.slow
def test_supply_and_load(tmp_path: Path) -> None:
    job = supply_and_load.run()
    assert failed(supply_and_load.main(job)) == []
    supply_and_load.figure(job).savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 10_000


@pytest.mark.slow
def test_simulation_speed() -> None:
    assert failed(simulation_speed.main()) == []


@pytest.mark.slow
def test_b32() -> None:
    assert failed(b32.main()) == []


@pytest.mark.slow
def test_b32_partial() -> None:
    assert failed(b32_partial.main()) == []


@pytest.mark.slow
def test_real_logs() -> None:
    assert failed(real_logs.main()) == []


@pytest.mark.slow
def test_stick_slip(tmp_path: Path) -> None:
    job = stick_slip.run()
    assert failed(stick_slip.main(job)) == []
    stick_slip.figure(job).savefig(tmp_path / "runs.png")
    assert (tmp_path / "runs.png").stat().st_size > 10_000


@pytest.mark.slow
def test_tune_drive(tmp_path: Path) -> None:
    job = tune_drive.run()
    assert failed(tune_drive.main(job)) == ["tuned.rig.overshoot"]  # the break-away of a stuck piston: missed, and said
    tune_drive.figure(job).savefig(tmp_path / "steps.png")
    assert (tmp_path / "steps.png").stat().st_size > 10_000


@pytest.mark.slow
def test_pareto(tmp_path: Path) -> None:
    job = pareto.run()
    assert failed(pareto.main(job)) == []
    for name, picture in pareto.figures(job).items():
        picture.savefig(tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_next_experiment_plans_within_limits_and_compares_fits() -> None:
    rows = next_experiment.main(duration=2.0, cpu_seconds=2.0).set_index("name")
    assert rows["holds"][["b32.limits", "emps.limits"]].all()
    assert rows["value"][[n for n in rows.index if ".narrower." in n]].notna().all()


def test_batched_monte_carlo_agrees_with_the_certificate() -> None:
    rows = batched_monte_carlo.main(plants=50, recertify=0.02).set_index("name")["value"].to_dict()
    assert rows["failed"] == 0
    assert rows["apart"] == 0
    assert rows["certified"] >= 2
