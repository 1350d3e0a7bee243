"""A run of a drive, a result that holds what figures show of a fit to it, and what is read from the figures."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pneuopt.dynamics.simulate import simulate
from pneuopt.identification.result import IdentificationResult
from pneuopt.logs.experiment import Experiment
from pneuopt.models.drives import ForceDrive
from pneuopt.models.friction import Coulomb
from pneuopt.quantities.parameters import Intersample, ParameterSet
from pneuopt.quantities.status import Code, Status
from pneuopt.quantities.trajectories import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DRIVE = ForceDrive(Coulomb())
TRUTH = DRIVE.parameters.with_values(
    {"load.mass": 6.0, "load.force": 4.0, "friction.coulomb": 25.0, "friction.viscous": 40.0}
)


def table(covariance: Mapping[str, float]) -> pd.DataFrame:
    """Uncorrelated estimates of these variances."""
    return pd.DataFrame(np.diag(list(covariance.values())), index=list(covariance), columns=list(covariance))


def fit_of(
    parameters: ParameterSet, trajectories: Mapping[str, Trajectory], covariance: pd.DataFrame | None = None
) -> IdentificationResult:
    """A result with nothing but what a figure shows of it."""
    covariance = table({}) if covariance is None else covariance
    values = [parameters.value(n) if n in parameters else np.nan for n in covariance.index]
    estimates = pd.DataFrame({"value": values, "dof": np.inf}, index=covariance.index, dtype=float)
    status = Status(Code.CONVERGED)
    return IdentificationResult(parameters, estimates, covariance, pd.DataFrame(), trajectories, status, {}, {})


def fitted(seed: int = 0) -> tuple[Experiment, Trajectory]:
    t = np.arange(0, 1.0, 2e-3)
    force = 80 * np.sin(2 * np.pi * 1.5 * t + seed)
    run = simulate(
        DRIVE.system(), Trajectory(t, {"force": force}), TRUTH, rtol=1e-6, intersample={"force": Intersample.LINEAR}
    )
    return Experiment(Trajectory(t, {"force": force, "position": run["position"]}), name=f"run_{seed}"), run


def texts(axes: "Axes") -> str:
    return f"{axes.get_xlabel()}|{axes.get_ylabel()}|{axes.get_title()}"


def line(axes: "Axes", label: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    (found,) = [q for q in axes.lines if q.get_label() == label]
    return np.asarray(found.get_xdata(), dtype=float), np.asarray(found.get_ydata(), dtype=float)
