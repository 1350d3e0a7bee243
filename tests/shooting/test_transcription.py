from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from pneuopt.dynamics.system import discretise
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.errors import ModelError, UnknownNameError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.shooting.transcription import Cost, Phase, Residuals, Transcription, Where, phases_of, regular_nodes

DRIVE = ForceDrive(Coulomb()).system()


def phase(name: str = "run", n: int = 10) -> Phase:
    return Phase(
        name, np.linspace(0, 0.1 * n, n, endpoint=False), np.full(n, 0.1), np.zeros((n, 1)), regular_nodes(n, 4)
    )


def problem(*phases: Phase, parameters: ParameterSet = DRIVE.parameters, **fields: object) -> Transcription:
    return Transcription(discretise(DRIVE), parameters, phases or (phase(),), **fields)  # type: ignore[arg-type]


def test_nodes_at_every_so_many_samples() -> None:
    assert regular_nodes(10, 3).tolist() == [0, 3, 6, 9]
    assert regular_nodes(10, 100).tolist() == [0]
    assert regular_nodes(3, 0).tolist() == [0, 1, 2]
    assert phase().n == 10


@pytest.mark.parametrize(
    ("changed", "place"),
    [
        ({"h": np.ones(9)}, "run: t, h"),
        ({"inputs": np.zeros((9, 1))}, "run: .*inputs"),
        ({"nodes": np.array([1, 4])}, "run: nodes"),
        ({"nodes": np.array([0, 4, 4])}, "run: nodes"),
        ({"nodes": np.array([0, 10])}, "run: nodes"),
        ({"nodes": np.array([], dtype=int)}, "run: nodes"),
        ({"breaks": np.array([5])}, "run: a break"),
        ({"follows": True, "start": np.zeros(2)}, "run: .*start"),
    ],
)
def test_a_bad_phase_is_refused_by_name(changed: dict[str, object], place: str) -> None:
    with pytest.raises(ModelError, match=place):
        replace(phase(), **changed)  # type: ignore[arg-type]


def test_a_bad_problem_is_refused() -> None:
    with pytest.raises(ModelError, match="phase"):
        Transcription(discretise(DRIVE), DRIVE.parameters, ())
    with pytest.raises(ModelError, match="first phase"):
        problem(replace(phase(), follows=True))
    with pytest.raises(UnknownNameError, match=r"load\.mass"):
        problem(parameters=ParameterSet({n: p for n, p in DRIVE.parameters.items() if n != "load.mass"}))
    with pytest.raises(UnknownNameError, match=r"run: .*Ts"):
        problem(replace(phase(), duration="Ts"))
    residuals = Residuals(0, ("positon",), np.zeros((10, 1)), np.ones(1))
    with pytest.raises(UnknownNameError, match=r"run: .*positon"):
        problem(residuals=(residuals,))


def test_a_phase_takes_its_own_value_where_there_is_one() -> None:
    own = {"load.mass[b]": Parameter(7.0, "kg", free=True)}
    posed = problem(phase("a"), phase("b"), parameters=DRIVE.parameters | ParameterSet(own))
    values = np.array([p.value for p in posed.parameters.values()])
    mass = list(DRIVE.parameters).index("load.mass")
    assert values[posed.parameter_positions(posed.phases[0])][mass] == DRIVE.parameters.value("load.mass")
    assert values[posed.parameter_positions(posed.phases[1])][mass] == 7.0
    assert posed.free.tolist() == [len(DRIVE.parameters)]


def test_a_term_without_phases_holds_in_all() -> None:
    posed = problem(phase("a"), phase("b"))
    cost = Cost("nothing", ca.Function("f", [ca.SX.sym("q")], [0]), Where.PARAMETERS)
    assert list(phases_of(cost, posed)) == [0, 1]
    assert list(phases_of(replace(cost, phases=(1,)), posed)) == [1]
