"""`Knocker`: short pulses on the command, in the direction in which the controller's output moves."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import casadi as ca

from pneuopt.control.compensation import LEAST_SMOOTHING, Instant
from pneuopt.control.sensor import SensedSignal
from pneuopt.control.sensor import Signals
from pneuopt.dynamics.hooks import Axis
from pneuopt.dynamics.system import Symbols
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

PULSE_SAMPLES, PERIOD_SAMPLES = 2, 10  # [samples] defaults: shorter or rarer pulses move nothing, longer push through
CHANGE_SMOOTHING = 0.01  # [command's unit] default: a small one knocks on noise, a large one knocks too weakly


@dataclass(frozen=True)
class Knocker:
    """Pulses of one amplitude and width, a period apart, each in the direction in which the PID's command moves.

    At the onset t_k of a pulse ``s = tanh((u_c(t_k) - u_c(t_(k-1)))/smoothing)``, u_c the command of the PID and of
    the compensators before; for the width from there on ``amplitude s`` is added, then nothing until the next onset.
    So it knocks while the integral winds up against stiction, and is quiet once the command rests. Its signal u_c is
    the controller's, without the pulses. Onsets are whole periods from time zero; width and period are rounded to
    samples, at least one; a width of a period or more joins the pulses.

    T. Hägglund, A friction compensator for pneumatic control valves, J. Process Control 12 (2002) 897-904 (and US
    patent 6285913), with the sign in place of the smooth one. It is computed by a sampled controller, which therefore
    it needs. Its pulses are left out of the loop's rest and of its margins, as a dither is; nothing averages over them.
    """

    section: ClassVar[str] = "knocker"
    size: ClassVar[str] = "amplitude"
    acts_always: ClassVar[bool] = False
    without_gradient: ClassVar[tuple[str, ...]] = ("width", "period")

    def check(self, on: SensedSignal, _axis: Axis | None) -> None:
        """Refuse a continuous controller."""
        told = "a Knocker is computed once a sample: give the PID a sample_time, such as PID(sample_time=1e-3)"
        require(on.sample_time is not None, told, ModelError)

    def parameters(self, on: SensedSignal, unit: str) -> ParameterSet:
        """Amplitude, zero by default, and the change of the command that decides a direction [unit]; times [s].

        Examples
        --------
        >>> found = Knocker().parameters(SensedSignal(Quantity("speed", "m/s"), {}, 1e-3), "V")
        >>> [(n, p.value, p.unit) for n, p in found.items()]
        [('amplitude', 0.0, 'V'), ('width', 0.002, 's'), ('period', 0.01, 's'), ('smoothing', 0.01, 'V')]
        """
        return ParameterSet(
            {
                "amplitude": Parameter(0.0, unit, lower=0.0, meaning="height of the pulses"),
                "width": Parameter(PULSE_SAMPLES * on.h, "s", lower=on.h, meaning="length of a pulse"),
                "period": Parameter(PERIOD_SAMPLES * on.h, "s", lower=on.h, meaning="time from pulse to pulse"),
                "smoothing": Parameter(
                    CHANGE_SMOOTHING,
                    unit,
                    lower=LEAST_SMOOTHING,
                    meaning="change of the command that decides a pulse's direction",
                ),
            }
        )

    def reads(self, _on: SensedSignal) -> tuple[str, ...]:
        """Nothing."""
        return ()

    def motion_inputs(self, _on: SensedSignal) -> tuple[str, ...]:
        """None."""
        return ()

    def states(self, _on: SensedSignal, command: Quantity) -> tuple[Quantity, ...]:
        """The command and the direction at the last onset."""
        return replace(command, name="command"), Quantity("direction", "1")

    def start(self, _on: SensedSignal, seen: Instant) -> list[Any]:
        """The command so far, and no direction."""
        return [seen.command, 0.0]

    def act(self, seen: Instant, x: Symbols, p: Symbols) -> tuple[Signals, ca.SX]:
        """The states after a sample, and the pulse [the command's unit]."""
        h = seen.sample_time or 1.0
        sample = ca.floor(seen.t / h + 0.5)
        width, period = (ca.fmax(1.0, ca.floor(p[n] / h + 0.5)) for n in ("width", "period"))
        phase = sample - period * ca.floor(sample / period)
        direction = ca.tanh((seen.command - x["command"]) / p["smoothing"])
        begins = phase < 1
        now = {
            "command": ca.if_else(begins, seen.command, x["command"]),
            "direction": ca.if_else(begins, direction, x["direction"]),
        }
        return now, p["amplitude"] * now["direction"] * (phase < width)
