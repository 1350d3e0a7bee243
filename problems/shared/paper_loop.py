"""The loop of Ye, Wang, Chen, IJRES 3(7), 2015 as a line of its tables: eq. (16), a controller, a "chatter".

The chatters are 1#, 0.001 sin 1000t, and 2#, 0.001 sin 1000t - 0.15, on half the loop gain (see paper_tables.py).
"""

from dataclasses import dataclass, replace
from functools import cache
from math import pi

import pneuopt as po
from problems.shared.paper2015 import paper_plant

CHATTER = 1000.0  # [rad/s]
UNIT_FEEDBACK = po.ParallelForm(Kp=1.0, Tf=0.01)
PAPERS_PID = po.ParallelForm(Kp=0.225, Ki=1.23, Kd=0.01, Tf=1 / 100)  # Table 2, row 1#
PAPERS_PID_2 = po.ParallelForm(Kp=0.235, Ki=1.64, Kd=0.0, Tf=1 / 100)  # Table 2, row 2#


@dataclass(frozen=True)
class Case:
    """A row of the paper's tables: factor on the loop gain, controller, chatter's amplitude and offset [V]."""

    gain: float
    pid: po.ParallelForm = UNIT_FEEDBACK
    amplitude: float = 0.0
    offset: float = 0.0


PLAIN, CHATTER_1, CHATTER_2 = Case(1.0), Case(0.5, amplitude=1e-3), Case(0.5, amplitude=1e-3, offset=-0.15)
PID_1, PID_2 = replace(CHATTER_1, pid=PAPERS_PID), replace(CHATTER_2, pid=PAPERS_PID_2)


@cache
def closed_loop(case: Case) -> tuple[po.ClosedLoop, po.ParameterSet]:
    system, printed = paper_plant(case.gain)
    loop = po.ClosedLoop(system, po.PID(limits=False), po.Dither(CHATTER / (2 * pi)))
    gains = {f"pid.{n}": getattr(case.pid, n) for n in ("Kp", "Ki", "Kd", "Tf")}
    chatter = {"dither.amplitude": case.amplitude, "dither.offset": case.offset}
    return loop, (loop.parameters | printed).with_values(gains | chatter)
