"""The parameters of a loop's parts as keys of a tuning.toml: gains, dither, feedforward, compensators."""

from collections.abc import Mapping
from dataclasses import replace

from pneuopt.control.compensators import COMPENSATORS
from pneuopt.control.controller import Feedforward, PositionLoop
from pneuopt.control.dither import Dither
from pneuopt.control.gain_schedule import SCHEDULED_GAINS, GainSchedule
from pneuopt.control.pid import PID, Form
from pneuopt.control.sensor import SensedSignal
from pneuopt.files.tuning_keys import TUNING_KEYS
from pneuopt.quantities.keys import Key, Takes, parameter_key
from pneuopt.quantities.parameters import ParameterSet, Quantity

SAMPLE_TIME = 1e-3
"""Of a first controller, and of usual values that count in samples [s]: a common one; longer ones slow a loop down."""
_CONDITIONS = {"Tt": "with limits, for back-calculation", "reset_band": "with reset_ratio"}
_SECTION_CONDITIONS = {
    "position_loop": "where a position is controlled",
    GainSchedule.section: "with low, high and a coefficient",
    "pressure_feedback": "where the plant shows both pressures",
}
_SAMPLED = "with sample_time; never free"
_LIMITS = ("lower", "upper")  # parameters that a file states as a pair, limits


def tuning_keys(command: str = "command", measured: str = "measured") -> Mapping[str, Key]:
    """All sections of a tuning.toml with all their keys.

    Parameters
    ----------
    command, measured : str
        Units of the loop's signals; by default these words stand for them.

    Returns
    -------
    mapping of str to Key
    """
    signal = SensedSignal(Quantity("measured", measured), {}, SAMPLE_TIME)
    parts = {
        "pid": _pid_keys(command, measured),
        PositionLoop.section: _parameter_keys(PositionLoop().parameters(measured, f"{measured}/s"), "Kp"),
        "dither": _parameter_keys(Dither().parameters(command), "frequency"),
        "feedforward": _parameter_keys(Feedforward().parameters(measured, command), "gain"),
        **{name: _parameter_keys(part().parameters(signal, command), part.size) for name, part in COMPENSATORS.items()},
        GainSchedule.section: _parameter_keys(
            GainSchedule(SCHEDULED_GAINS, 0.0, 1.0, 1.0).parameters("m", "kg"), "low"
        ),
    }
    for section, condition in _SECTION_CONDITIONS.items():
        parts[section] = {n: replace(key, condition=condition) for n, key in parts[section].items()}
    return {n: replace(key, keys={**key.keys, **parts.get(n, {})}) for n, key in TUNING_KEYS.items()}


def _pid_keys(command: str, measured: str) -> dict[str, Key]:
    """The gains of every form, and what is shared; those of some forms say which."""
    found: dict[str, Key] = {}
    for form in Form:
        pid = PID(SAMPLE_TIME, form=form, dead_band=True, reset=True).parameters(measured, command)
        for name in (n for n in pid if n not in _LIMITS and n not in found):
            forms = [f'"{f.value}"' for f in Form if name in f.gains]
            own = f"form = {' or '.join(forms)}" if 0 < len(forms) < len(Form) else ""
            found[name] = parameter_key(pid[name], own or _CONDITIONS.get(name, ""))
    fixed = {n: replace(found[n], takes=Takes.NUMBER, condition=_SAMPLED) for n in ("fault_samples", "fault_output")}
    centre = "safe output after that many, on the wire as limits are; default: where the valve is closed, its centre"
    fixed["fault_output"] = replace(fixed["fault_output"], meaning=centre, usual=None, example='"0 V"')
    return found | fixed


def _parameter_keys(parameters: ParameterSet, required: str) -> dict[str, Key]:
    """The parameters of a part, one of which a file must state."""
    return {n: replace(parameter_key(p), required=n == required) for n, p in parameters.items()}
