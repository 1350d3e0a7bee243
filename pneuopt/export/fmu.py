"""`export_fmu`: a plant as a source-code FMU for model exchange (FMI 3.0), by CasADi's DaeBuilder."""

import contextlib
import hashlib
import io
import re
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import casadi as ca

from pneuopt.dynamics.system import FRICTION_DIRECTION, System, names, parameter_vector
from pneuopt.export.writer import check_name
from pneuopt.quantities.arrays import Array
from pneuopt.quantities.errors import ModelError, require
from pneuopt.quantities.parameters import ParameterSet

_MADE_AT, _TOKEN = re.compile(r' generationDateAndTime="[^"]*"'), re.compile(r'instantiationToken="([^"]*)"')
_DESCRIPTION = "modelDescription.xml"


def export_fmu(system: System, parameters: ParameterSet, x: Array | None = None, *, name: str = "plant") -> bytes:
    """Write a plant as an FMU with C sources, for any tool that imports FMI 3.0 and has a compiler.

    Inputs, states, outputs and tunable parameters have their names here ("load.mass"), an output that is called as a
    state is called ``out.speed``; all numbers are in SI units. Derivatives are with it.

    Parameters
    ----------
    system : System
        Of a drive: ``drive.system()``. A friction that sticks (`Karnopp`) has no ODE and is simulated here only.
    parameters : ParameterSet
        A missing one has the system's default.
    x : ndarray, shape (n_states,), optional
        The state at the start; by default the plant's rest.
    name : str
        Of the model: letters, digits and single underscores.

    Returns
    -------
    bytes
        Of the file ``NAME.fmu``.

    Raises
    ------
    InputError
        If the name is no identifier, or the state has another shape; `ModelError` for a friction that sticks.
    """
    check_name(name)
    sticks = "a friction that sticks (Karnopp) has no ODE: export the drive with the smooth friction that it wraps"
    require(FRICTION_DIRECTION not in system.parameters, sticks, ModelError)
    start = system.rest_state(parameters, {}) if x is None else x
    require(len(start) == len(system.states), f"x has {len(start)} entries, the plant {len(system.states)} states")
    builder = _build(system, parameters, start, name)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # CasADi writes into the current folder
        files = builder.export_fmu({"no_warning": True, "with_serialization": False})
        texts = {str(Path(place)): Path(local).read_text("utf-8") for local, place in files.items()}
    # CasADi's names are flat ones; date and token change from call to call
    texts[_DESCRIPTION] = _MADE_AT.sub(
        "", texts[_DESCRIPTION].replace('variableNamingConvention="structured"', 'variableNamingConvention="flat"')
    )
    found = _TOKEN.search(texts[_DESCRIPTION])
    old = found[1] if found else ""
    token = hashlib.sha256("".join(text.replace(old, "") for text in texts.values()).encode()).hexdigest()[:32]
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as target:
        for place, text in texts.items():  # of one date, so that a model makes the same bytes each time
            target.writestr(zipfile.ZipInfo(place, (1980, 1, 1, 0, 0, 0)), text.replace(old, token))
    return archive.getvalue()


def _build(system: System, parameters: ParameterSet, start: Array, name: str) -> ca.DaeBuilder:
    """The equations of a system under its own names."""
    dae, states = ca.DaeBuilder(name, "", {}), names(system.states)
    x = {n: dae.add(n) for n in states}
    u = {n: dae.add(n, "input") for n in names(system.inputs)}
    p = {n: dae.add(n, "parameter", "tunable") for n in system.parameters}
    t = dae.add("time", "independent")
    vectors = (ca.vertcat(*own.values()) for own in (x, u, p))
    rates, outputs = system.ode(t, *vectors)
    for k, n in enumerate(states):
        dae.eq(dae.der(x[n]), rates[k])
        dae.set_initial(n, "exact")
        dae.set_start(n, float(start[k]))
    for k, n in enumerate(names(system.outputs)):
        own = f"out.{n}" if n in states else n
        dae.eq(dae.add(own, "output"), outputs[k])
    values: Mapping[str, float] = dict(
        zip(system.parameters, parameter_vector(system.parameters, parameters), strict=True)
    )
    for n, value in values.items():
        dae.set_start(n, float(value))
    return dae
