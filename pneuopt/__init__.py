"""Identify and optimally tune pneumatic drives, and any servo axis with friction.

The concept map, in the order in which data flow:

    read_log(path)                    -> Experiment: a measured Trajectory, its noise and conditions
    read_drive(path)                  -> a drive and its ParameterSet; or build one: ForceDrive(Stribeck())
    identify(drive, logs, freed)      -> IdentificationResult: estimates with confidence intervals
    select_model(drives, logs, ...)   -> which of several models the logs support, and why
    identifiability(drive, logs, freed) -> Verdict: what the logs can identify, in words, before a fit
    profile, propagate_error(...)     -> an interval where a linear one lies; one of a figure made of estimates
    validate(drive, logs, fitted)     -> how well a held-out log is predicted, and what is left in the residuals
    ClosedLoop(drive, PID, Dither)    -> the loop to be tuned, continuous or sampled
    tune(loop, steps, freed, ...)     -> TuningResult: gains and dither, claimed and certified
    certify(loop, steps, gains, ...)  -> the same for gains as they stand, edited by hand perhaps; nothing is sought
    validate_design(loop, ...)        -> a design on new plants: worst, 95th percentile, violations
    judge_dither(loop, steps, tuned)  -> whether the dither is useful, useless or harmful, and why, in numbers
    find_limit_cycle(t, speed)        -> hunting or crawl in a response or a log: amplitude, frequency, stick share
    evaluate, simulate                -> certified metrics; any trajectory, independently of the optimiser
    bumpless_transfer(loop, x, ...)   -> the state from which a running loop goes on with new gains, without a bump
    export_controller(loop, tuned, C) -> the sampled controller as C99, structured text or Python, the same to rounding
    record(Rig(loop, sensors), ...)   -> the log of a rig with stick-slip, hysteresis, sensors; and the truth
    pareto_front(loop, steps, ...)    -> what one requirement costs in terms of another: a row a certified design
    grid, sweep(fn, parameters, cases)-> a study: any function over named cases, in processes, as a table

Wherever a drive stands, its system may; where logs or steps stand, one may. Names are loaded when first used, as
`__init__.pyi` says where they are; importing the package costs nothing. Modules are private but for `pneuopt.catalog`
(numbers of real hardware, cited) and `pneuopt.plotting` (figures).
"""

import lazy_loader

__version__ = "0.2.0.dev0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
