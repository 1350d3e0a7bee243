"""[scenarios] of a tuning.toml."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pneuopt.cli.app import app
from pneuopt.evaluation.scenarios import Factor, Scenarios, Spread, corners, samples, tolerances
from pneuopt.files.toml import read_toml
from pneuopt.files.tuning import read_scenarios, read_tuning, read_validation_scenarios
from pneuopt.models.linear import SecondOrder
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet

RIG = ParameterSet({"load.mass": Parameter(5.0, "kg", 1.0, 20.0), "friction.coulomb": Parameter(40.0, "N")})
RIG = RIG | ParameterSet({"pid.Kp": Parameter(2.0, "V*s/m", free=True)})


def read(tmp_path: Path, text: str) -> Scenarios:
    path = tmp_path / "tuning.toml"
    path.write_text(text, encoding="utf-8")
    return read_scenarios(read_toml(path).unwrap()["scenarios"], "tuning.toml", RIG)


def test_corners_samples_and_tolerances_join(tmp_path: Path) -> None:
    found = read(
        tmp_path,
        """
[scenarios.corners]
"load.mass" = "30 %"
"friction.*" = ["30 N", "60 N"]
[scenarios.samples]
count = 3
seed = 7
"load.mass" = 0.1
[scenarios.tolerances]
"pid.*" = "1 %"
""",
    )
    spreads: dict[str, Spread] = {"load.mass": 0.3, "friction.*": (30.0, 60.0)}
    assert found == {
        **corners(RIG, spreads),
        **samples(RIG, {"load.mass": 0.1}, 3, seed=7),
        **tolerances(RIG, {"pid.*": 0.01}),
    }
    assert found["pid.* high"] == {"pid.Kp": Factor(1.01)}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[scenarios.corner]\n"load.mass" = "30 %"', r"tuning\.toml: \[scenarios\].*corner"),
        ('[scenarios]\ncorners = "30 %"', r"\[scenarios\.corners\] must be a section"),
        ('[scenarios.corners]\n"load.mas" = "30 %"', r"\[scenarios\.corners\] .*load\.mas"),
        ('[scenarios.corners]\n"load.mass" = ["3 kg"]', r"\[scenarios\.corners\] load\.mass: write a fraction"),
        ('[scenarios.corners]\n"load.mass" = "3 kg"', r"\[scenarios\.corners\] load\.mass"),
        ('[scenarios.tolerances]\n"pid.Kp" = ["1 V*s/m", "3 V*s/m"]', "a tolerance is a fraction"),
        ('[scenarios.samples]\ncount = "many"\n"load.mass" = "30 %"', "count and seed are whole numbers"),
    ],
)
def test_what_is_wrong_is_named_with_its_section(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        read(tmp_path, text)


def test_a_tuning_gives_the_scenarios_of_a_fit(tmp_path: Path) -> None:
    path = tmp_path / "tuning.toml"
    lines = ['[pid]\nKp = "2 V*s/m"', '[[reference]]\nstep = "0.2 m/s"\nhorizon = "1 s"']
    path.write_text("\n".join(lines), encoding="utf-8")
    plant = SecondOrder().system()
    assert dict(read_tuning(path, plant).scenarios(plant.parameters)) == {}
    path.write_text("\n".join([*lines, '[scenarios.corners]\n"plant.gain" = "20 %"']), encoding="utf-8")
    fitted = plant.parameters.with_values({"plant.gain": 3.0})
    values = [case["plant.gain"] for case in read_tuning(path, plant).scenarios(fitted).values()]
    assert values == pytest.approx([2.4, 3.6])


def test_the_commands_certify_every_scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    drive = '[drive]\nkind = "force"\n[load]\nmass = "5 kg"\n[friction]\nmodel = "viscous"\nviscous = "40 N*s/m"'
    loop = '[pid]\nsample_time = "5 ms"\nKp = "300 N*s/m"\nKi = "5000 N/m"\n[[reference]]\nstep = "0.2 m/s"'
    Path("drive.toml").write_text(drive, encoding="utf-8")
    scenarios = '[scenarios.corners]\n"load.mass" = "30 %"'
    Path("tuning.toml").write_text(f'{loop}\nhorizon = "0.3 s"\n{scenarios}', encoding="utf-8")
    result = CliRunner().invoke(app, ["simulate", "drive.toml", "tuning.toml", "--json", "out.json"])
    assert result.exit_code == 0, result.output
    rows = json.loads(Path("out.json").read_text(encoding="utf-8"))["certified"]
    assert len(rows) == 3
    slow, fast = (rows[k]["RiseTime"] for k in (2, 1))
    assert slow > 1.3 * fast


def test_new_plants_come_from_the_same_boxes_and_differ(tmp_path: Path) -> None:
    path = tmp_path / "tuning.toml"
    text = '[scenarios.samples]\ncount = 3\n"load.mass" = "30 %"\n[scenarios.tolerances]\n"pid.Kp" = "1 %"'
    path.write_text(text, encoding="utf-8")
    said = read_toml(path).unwrap()["scenarios"]
    seen, fresh = (found(said, "tuning.toml", RIG) for found in (read_scenarios, read_validation_scenarios))
    assert len(fresh) == 100
    masses = [v["load.mass"] for v in fresh.values()]
    factors = [v["pid.Kp"] for v in fresh.values()]
    assert all(isinstance(m, float) and 3.5 <= m <= 6.5 for m in masses)
    assert all(isinstance(f, Factor) and 0.99 <= f.share <= 1.01 for f in factors)
    assert not {v["load.mass"] for v in seen.values() if "load.mass" in v} & set(masses)


def test_a_tuning_with_scenarios_is_validated_on_new_plants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    drive = '[drive]\nkind = "force"\n[load]\nmass = "5 kg"\n[friction]\nmodel = "viscous"\nviscous = "40 N*s/m"'
    gain = '{ value = "300 N*s/m", lower = "100 N*s/m", upper = "900 N*s/m", free = true }'
    loop = f'[pid]\nsample_time = "5 ms"\nKp = {gain}\nKi = "2000 N/m"\n[[reference]]\nstep = "0.2 m/s"'
    asked = '[minimise]\nsettling_time = { band = "5 %" }\n[limits]\novershoot = "20 %"'
    scenarios = '[scenarios.corners]\n"load.mass" = "30 %"'
    Path("drive.toml").write_text(drive, encoding="utf-8")
    Path("tuning.toml").write_text(f'{loop}\nhorizon = "0.3 s"\n{asked}\n{scenarios}', encoding="utf-8")
    result = CliRunner().invoke(app, ["tune", "drive.toml", "tuning.toml", "--json", "out.json"])
    assert result.exit_code == 0, result.output
    assert "holds on 100 of 100 plants" in result.output
    assert "as the scenarios have them: load.mass" in result.output
    assert "assumed tolerances: friction.viscous +-10 %" in result.output
    found = json.loads(Path("out.json").read_text(encoding="utf-8"))
    settling, overshoot = found["validation"]
    worst_corner = max(row["SettlingTime"] for row in found["certified"])
    assert settling["violations"] == overshoot["violations"] == 0
    assert 0.5 * worst_corner < settling["median"] <= settling["p95"] <= settling["worst"]
    assert settling["worst"] <= 1.05 * worst_corner, "friction and the gain vary beside the mass: by 10 % and by 1 %"
    assert settling["certified"] == pytest.approx(settling["worst"], rel=1e-2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[scenarios.samples]\ncount = 100000000\n'load.mass' = '30 %'", "count may be 20000 at most"),
        ("[scenarios.samples]\ncount = 3\nseed = -1\n'load.mass' = '30 %'", "seed not below 0"),
        (
            "[scenarios.corners]\n" + "".join(f"'friction.{k}' = '30 %'\n" for k in range(20)),
            "20 parameters have too many corners; take",
        ),
    ],
)
def test_more_plants_than_can_be_computed_are_refused_at_once(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        read(tmp_path, text)
