"""Linear models from python-control and to it: `from_control`, `to_control`. Nothing else imports that package."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from pneuopt.dynamics.system import Linearisation, Symbols, System, define
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import InputError, require
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity

if TYPE_CHECKING:
    import control

GAIN = "plant.gain"
"""The parameter by which the outputs of a model from python-control are multiplied, for studies and tolerances."""


def to_control(linear: Linearisation) -> "control.StateSpace":
    """A linearised system as python-control has it, with the names of its signals.

    Its transfer function is ``control.tf(to_control(...))``, of a sampled loop one of z. Margins of an `open_loop` are
    the same by either tool, but for a dead time, which python-control gets as its Padé approximant.

    Parameters
    ----------
    linear : Linearisation
        Of `open_loop`, `linear_plant` or `System.linearise`.

    Returns
    -------
    control.StateSpace
        Names have "_" for ".", which python-control keeps for itself.

    Raises
    ------
    InputError
        If python-control is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> one = np.eye(1)
    >>> lag = Linearisation(-2 * one, one, 2 * one, 0 * one, ("x",), ("u",), ("y",))
    >>> to_control(lag).dcgain().item()
    1.0
    """
    require(isinstance(linear, Linearisation), f"to_control takes a Linearisation, got {type(linear).__name__}")
    names = {
        kind: [n.replace(".", "_") for n in given]
        for kind, given in (("states", linear.states), ("inputs", linear.inputs), ("outputs", linear.outputs))
    }
    A, B, C, D, h = linear.A, linear.B, linear.C, linear.D, linear.sample_time
    if h is None:
        return _import_control().ss(A, B, C, D, **names)
    one, root = np.eye(len(A)), np.sqrt(h)
    inverse = np.linalg.inv(one - h / 2 * A)  # z = (1 + s h/2)/(1 - s h/2), undone
    C, D = root * C @ inverse, D + h / 2 * C @ inverse @ B
    return _import_control().ss((one + h / 2 * A) @ inverse, root * inverse @ B, C, D, h, **names)


def from_control(
    model: "control.TransferFunction | control.StateSpace",
    inputs: Sequence[Quantity] = (Quantity("input", "1"),),
    outputs: Sequence[Quantity] = (Quantity("output", "1"),),
) -> System:
    """A plant from a continuous model of python-control, to be tuned and simulated as any other.

    Its one parameter, "plant.gain", multiplies the outputs; its states have no unit.

    Parameters
    ----------
    model : control.TransferFunction or control.StateSpace
        Continuous and proper.
    inputs, outputs : sequence of Quantity
        What its signals are: ``[Quantity("valve_voltage", "V")]``, ``[Quantity("speed", "m/s")]``.

    Raises
    ------
    InputError
        If python-control is not installed, the model is of another kind, sampled or improper, or has other numbers of
        signals than are named.

    Examples
    --------
    >>> import control
    >>> plant = from_control(control.tf([3.0], [0.5, 1.0]), [Quantity("voltage", "V")], [Quantity("speed", "m/s")])
    >>> found = plant.linearise(np.zeros(1), {"voltage": 0.0}, plant.parameters)
    >>> round(to_control(found).dcgain().item(), 9)
    3.0
    """
    control, remedy = _import_control(), "give the continuous model, and let PID(sample_time=...) sample the controller"
    kinds = (control.TransferFunction, control.StateSpace)
    require(isinstance(model, kinds), f"a TransferFunction or StateSpace is wanted, got {type(model).__name__}")
    require(model.isctime(), f"the model is sampled every {model.dt} s; {remedy}")
    try:
        found = control.ss(model)
    except (ValueError, control.ControlMIMONotImplemented) as error:
        raise InputError(f"the model has no state-space form ({error}); give a proper one") from None
    A, B, C, D = (np.atleast_2d(np.asarray(M, dtype=float)) for M in (found.A, found.B, found.C, found.D))
    require(all(np.isfinite(M).all() for M in (A, B, C, D)), "the model has coefficients that are not finite")
    for kind, named, count in (("inputs", inputs, B.shape[1]), ("outputs", outputs, C.shape[0])):
        require(len(named) == count, f"the model has {count} {kind}, {len(named)} are named")
    states = [Quantity(f"plant.x{k + 1}", "1") for k in range(len(A))]

    def rhs(_: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[dict[str, ca.SX], dict[str, ca.SX]]:
        z, w = (ca.vertcat(*(part[q.name] for q in named)) for part, named in ((x, states), (u, inputs)))
        rates, measured = _multiply(A, z) + _multiply(B, w), p[GAIN] * (_multiply(C, z) + _multiply(D, w))
        return {q.name: rates[k] for k, q in enumerate(states)}, {q.name: measured[k] for k, q in enumerate(outputs)}

    return define(states, inputs, outputs, ParameterSet({GAIN: Parameter(1.0, "1")}), rhs)


def _multiply(matrix: Array, x: ca.SX) -> ca.SX:
    """The product without the terms that are zero, so that the model is as sparse as the matrix."""
    return ca.mtimes(ca.sparsify(ca.DM(matrix)), x) if x.numel() else ca.SX.zeros(matrix.shape[0])


def _import_control() -> Any:
    try:
        import control
    except ImportError:
        raise InputError("python-control is not installed; pip install pneuopt[control]") from None
    return control
