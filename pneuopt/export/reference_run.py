"""`ReferenceRun`: inputs and the outputs that the library computes of them, with which an export is compared."""

from dataclasses import dataclass

import numpy as np

from pneuopt.export.program import CENTRE, ControllerProgram
from pneuopt.quantities.arrays import Array

RUN_SAMPLES = 200
"""Of a test's run: fewer than some 50 pass no limit and no pulse, many more make a long file."""
RUN_TOLERANCE = 1e-12
"""Of the largest output: what sums in another order may differ by, after a run of `RUN_SAMPLES`."""
_DROPOUT, _GAP, _LONGEST_GAP = 60, 100, 30  # samples: while the measured signal rises, and after
_RISE = 25.0  # samples in which the measured signal follows: fewer hide the integral, more hide the approach


@dataclass(frozen=True)
class ReferenceRun:
    """A run of a controller.

    Attributes
    ----------
    inputs : ndarray, shape (n_samples, n_inputs)
    outputs : ndarray, shape (n_samples,)
        The first output, with the parameters of the program.
    """

    inputs: Array
    outputs: Array


def make_reference_run(program: ControllerProgram) -> ReferenceRun:
    """A step of the reference, half of which drives the output to its limits, with a measured signal that swings in.

    What else the controller gets, rates of the reference and further readings, are waves. One sample of the measured
    signal is no number, and then so many in a row that the controller begins anew.
    """
    k = np.arange(RUN_SAMPLES)
    size = _step_size(program)
    reference = np.where((k >= 5) & (k < 150), size, -0.3 * size)
    measured = size * (1 - np.exp(-np.maximum(k - 5, 0) / _RISE)) + 0.02 * size * np.sin(0.9 * k)
    others = [size * np.sin(0.1 * (n + 1) * k) for n in range(len(program.inputs) - 2)]
    count = {v.name: v.value for v in program.parameters}["fault_samples"]
    measured[_DROPOUT] = measured[_GAP : _GAP + int(min(count, _LONGEST_GAP)) + 1] = np.nan
    inputs = np.column_stack([reference, measured, *others])
    return ReferenceRun(inputs, run_program(program, inputs)[:, 0])


def run_program(program: ControllerProgram, inputs: Array) -> Array:
    """The outputs of a program as CasADi computes them, started with the first sample.

    Parameters
    ----------
    program : ControllerProgram
    inputs : ndarray, shape (n_samples, n_inputs)

    Returns
    -------
    ndarray, shape (n_samples, n_outputs)
    """
    p, count, found = program.values, len(program.outputs), []
    centre = program.originals[CENTRE].value if CENTRE in program.originals else 0.0
    x = program.start([*inputs[0], centre], p)
    for row in inputs:
        results = program.step(row, x, p)[0].full().ravel()
        found.append(results[:count])
        x = results[count:]
    return np.array(found)


def _step_size(program: ControllerProgram) -> float:
    """A step that drives the output beyond its limits for a while; 1 where it has none."""
    value = {n: v.value for n, v in program.originals.items()}
    gain, upper = abs(value.get("pid.Kp", value.get("pid.K", 1.0))), value.get("pid.upper", np.inf)
    return float(1.5 * upper / gain) if np.isfinite(upper) and upper > 0 and gain > 0 else 1.0
