"""Linear algebra keeps to the calling thread while logs are fitted."""

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

import pneuopt as po


def blas_threads() -> set[int]:
    return {int(library["num_threads"]) for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_has_one_thread_during_a_fit_and_its_own_again_after_it() -> None:
    drive, t = po.ForceDrive(po.Coulomb()), np.arange(1000) * 1e-3
    truth = drive.parameters.with_values({"load.mass": 3.0, "friction.coulomb": 30.0, "friction.viscous": 60.0})
    force = po.Trajectory(t, {"force": 50 * np.sin(2 * np.pi * t) + 40 * np.sin(2 * np.pi * 2.3 * t)})
    run, noise = po.simulate(drive.system(), force, truth), np.random.default_rng(0).standard_normal(t.size)
    log = po.Experiment(force.with_columns({"position": run["position"] + 2e-5 * noise}), name="run")
    used = set[int]()
    with threadpool_limits(3, user_api="blas"):
        before = blas_threads()
        po.identify(drive.system(), [log], truth.freed("friction.*"), progress=lambda _: used.update(blas_threads()))
        assert used == {1}
        assert blas_threads() == before
        assert 1 not in before
