"""Transfer-function plants with named signals: first order, second order, integrator; dead time."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import casadi as ca

from pneuopt.dynamics.system import Symbols, System, define, names
from pneuopt.logs.columns import CHANNELS
from pneuopt.models.declaration import DriveKind, DriveSections, FirstFiles
from pneuopt.models.drives import FORCE, POSITION, SPEED
from pneuopt.models.friction import FrictionModel
from pneuopt.models.friction_laws import FRICTION_KEYS, read_friction
from pneuopt.models.starts.linear import LinearStarts, Polynomials, ResponseShape, delay_line, pade_delay
from pneuopt.quantities.errors import ModelError, check_names, require
from pneuopt.quantities.keys import Key, Takes, choice
from pneuopt.quantities.parameters import Parameter, ParameterSet, Quantity, without_prefix
from pneuopt.quantities.units import difference_unit, read_si

VALVE_VOLTAGE = Quantity("valve_voltage", "V", nominal=5.0)
USUAL_PADE_ORDER = 3  # of a dead time in a file: it follows the delay up to 4.6 rad of phase, with three states
Dynamics = Callable[[ca.SX, Symbols, Symbols], dict[str, ca.SX]]


@dataclass(frozen=True)
class FirstOrder:
    """``time_constant dy/dt + y = gain u(t - dead_time)``.

    Parameters
    ----------
    pade_order : int
        Order of the dead time's approximant; 0: no dead time.
    input, output : Quantity
        The signals u and y; the parameters' units follow from theirs.

    Examples
    --------
    >>> plant = FirstOrder().system()
    >>> plant.linearise([0.0], {}, plant.parameters.with_values({"plant.time_constant": 0.5})).A.item()
    -2.0
    """

    kind: ClassVar[str] = "linear"
    pade_order: int = 0
    input: Quantity = VALVE_VOLTAGE
    output: Quantity = SPEED

    def system(self) -> System:
        """The plant as an ODE."""
        y = self.output.name

        def dynamics(u: ca.SX, x: Symbols, p: Symbols) -> dict[str, ca.SX]:
            return {y: (p["plant.gain"] * u - x[y]) / p["plant.time_constant"]}

        shaping = {"plant.time_constant": Parameter(0.1, "s", 1e-5, 1e4, log=True, meaning="time constant")}
        shape = ResponseShape(("plant.time_constant",), _first_order_polynomials)
        return _assemble_plant(
            self, (self.output,), _gain_parameter(self.input, self.output, ""), ParameterSet(shaping), dynamics, shape
        )


@dataclass(frozen=True)
class SecondOrder:
    r"""``y'' + 2 damping w y' + w² y = gain w² u(t - dead_time)``, w the natural frequency; friction is optional.

    Friction is an equivalent input: in steady motion the speed y needs the voltage ``y / gain + F(y)``. It acts where
    the force does, after the drive's lag, so that the drive can stick. With d, the acceleration without friction::

        y' = d - gain w F(y) / (2 damping)        d' = w² (gain u(t - dead_time) - y) - 2 damping w d

    Without friction, d is y' and the two equations are the transfer function above. All damping counts as the drive's
    (of a motor's winding or a valve's leakage). F is smooth and in the input's unit. Its viscous part is zero by
    default, because the gain includes it.

    Parameters
    ----------
    pade_order : int
        Order of the dead time's approximant; 0: no dead time.
    friction : FrictionModel, optional
        Its forces are in the unit of the input; its speed is the output.
    input, output : Quantity
        The signals u and y; the parameters' units follow from theirs.

    Examples
    --------
    >>> plant = SecondOrder().system()
    >>> rest = plant.equilibrium({"valve_voltage": 2.0}, plant.parameters.with_values({"plant.gain": 0.5}))
    >>> round(float(rest[0]), 9)
    1.0
    """

    kind: ClassVar[str] = "linear"
    pade_order: int = 0
    friction: FrictionModel | None = None
    input: Quantity = VALVE_VOLTAGE
    output: Quantity = SPEED

    def __post_init__(self) -> None:
        require(
            self.friction is None or not self.friction.inputs,
            f"{type(self.friction).__name__} needs pressures or a force, which this plant lacks; choose another law",
            ModelError,
        )

    def system(self) -> System:
        """Build the equations; the states are the output, "drive" (d above), then those of friction and dead time."""
        y, friction = self.output.name, self.friction

        def dynamics(u: ca.SX, x: Symbols, p: Symbols) -> dict[str, ca.SX]:
            gain, w, zeta = (p[f"plant.{n}"] for n in ("gain", "natural_frequency", "damping"))
            rates = {y: x["drive"], "drive": w**2 * (gain * u - x[y]) - 2 * zeta * w * x["drive"]}
            if friction is None:
                return rates
            force = friction.force(x[y], without_prefix(x, "friction"), {}, without_prefix(p, "friction"))
            rates[y] -= gain * w / (2 * zeta) * force.value
            return rates | {f"friction.{n}": rate for n, rate in force.rates.items()}

        shaping = ParameterSet(
            {
                "plant.natural_frequency": Parameter(
                    10.0, "rad/s", 1e-3, 1e5, log=True, meaning="natural frequency without damping"
                ),
                "plant.damping": Parameter(0.7, "1", 1e-3, 1e3, log=True, meaning="damping ratio"),
            }
        )
        if friction is not None:
            shaping = shaping | _in_input_unit(friction.parameters, self.input).with_prefix("friction")
        inner = friction.states if friction is not None else ()
        drive = Quantity("drive", _quotient_unit(self.output, "s"), 10 * self.output.nominal)
        states = (self.output, drive, *(replace(s, name=f"friction.{s.name}") for s in inner))
        shape = ResponseShape(
            tuple(shaping)[:2], _second_order_polynomials, None if friction is None else _friction_polynomials
        )
        plant = _assemble_plant(self, states, _gain_parameter(self.input, self.output, ""), shaping, dynamics, shape)
        if friction is None:
            return plant
        return replace(plant, identification_hints=friction.identification_hints.with_prefix("friction"))


@dataclass(frozen=True)
class Integrator:
    """``dy/dt = gain u(t - dead_time)``: from a valve's opening to a position, for example.

    Parameters
    ----------
    pade_order : int
        Order of the dead time's approximant; 0: no dead time.
    input, output : Quantity
        The signals u and y; the gain's unit follows from theirs.

    Examples
    --------
    >>> Integrator(output=Quantity("position", "m")).system().parameters["plant.gain"].unit
    'm/(V*s)'
    """

    kind: ClassVar[str] = "linear"
    pade_order: int = 0
    input: Quantity = VALVE_VOLTAGE
    output: Quantity = SPEED

    def system(self) -> System:
        """The plant as an ODE."""
        y = self.output.name

        def dynamics(u: ca.SX, _: Symbols, p: Symbols) -> dict[str, ca.SX]:
            return {y: p["plant.gain"] * u}

        shape = ResponseShape((), _integrator_polynomials)
        return _assemble_plant(
            self, (self.output,), _gain_parameter(self.input, self.output, "*s"), ParameterSet(), dynamics, shape
        )


Plant = FirstOrder | SecondOrder | Integrator


def _build_plant(sections: DriveSections) -> Plant:
    options = sections.options("plant")
    signals = [options["input"], options["output"]]
    check_names("channel", signals, CHANNELS, f"{sections.location('plant', '')}: [plant]")
    u, y = (_signal(sections, options, key) for key in ("input", "output"))
    order = options["pade_order"]
    if order is None:
        order = USUAL_PADE_ORDER if sections.has("plant", "dead_time") else 0
    if options["model"] is SecondOrder:
        return SecondOrder(order, read_friction(sections) if sections.has("friction") else None, u, y)
    plant: Plant = options["model"](order, u, y)
    return plant


def _signal(sections: DriveSections, options: Mapping[str, Any], key: str) -> Quantity:
    """The input or the output, in the channel's unit or in another one: that of a transducer, say."""
    name, unit = options[key], options[f"{key}_unit"]
    if unit is None:
        known = {q.name: q for q in (VALVE_VOLTAGE, SPEED, POSITION, FORCE)}
        return known.get(name, Quantity(name, CHANNELS[name]))
    where = sections.place("plant", f"{key}_unit")
    require(read_si(f"1 {unit}", where=where) == 1.0, f'{where}: {unit!r} is no SI unit without a prefix, such as "V"')
    return Quantity(name, unit)


_OWN_UNIT = "parameters then count in it"
LINEAR_KIND = DriveKind(
    FirstOrder.kind,
    {
        "plant": {
            "model": choice(
                "transfer function",
                {"first_order": FirstOrder, "second_order": SecondOrder, "integrator": Integrator},
            ),
            "input": Key("channel that drives the plant", Takes.TEXT, usual=VALVE_VOLTAGE.name),
            "output": Key("channel that answers", Takes.TEXT, usual=SPEED.name),
            "input_unit": Key(
                "unit of the input, of a transducer, say", Takes.TEXT, example='"V"', condition=_OWN_UNIT
            ),
            "output_unit": Key(
                "unit of the output, of a transducer, say", Takes.TEXT, example='"V"', condition=_OWN_UNIT
            ),
            "pade_order": Key(
                "order of the dead time's approximant, 0 to 5; 3 with a dead time",
                Takes.COUNT,
                example="3",
                least=0,
                most=5,
            ),
        },
        "friction": FRICTION_KEYS,
    },
    _build_plant,
    any_friction=False,
    first=FirstFiles(
        options={"plant": {"model": "second_order"}},
        unknowns=("plant.gain", "plant.natural_frequency", "plant.damping"),
        gains={"Kp": (1, 0.1, 20), "Ki": (5, 0.5, 200), "Kd": (0, 0, 2), "Tf": (0.01, 5e-3, 0.1)},
        limit=5.0,
        dither=None,
        steps=(0.1, 0.25),
        horizon=1.5,
        swept="plant.gain",
    ),
)


def _assemble_plant(
    plant: Plant,
    states: tuple[Quantity, ...],
    gain: Parameter,
    shaping: ParameterSet,
    dynamics: Dynamics,
    shape: ResponseShape,
) -> System:
    """Assemble a plant from its dynamics, its gain and its dead time."""
    order, source = plant.pade_order, plant.input
    line = delay_line(source, order)
    parameters = ParameterSet({"plant.gain": gain}) | shaping
    if order:
        parameters = parameters | ParameterSet(
            {
                "plant.dead_time": Parameter(
                    0.01,
                    "s",
                    1e-3,
                    10.0,
                    log=True,
                    meaning="delay from the input to its effect; none where it is left out",
                )
            }
        )

    def rhs(_: ca.SX, x: Symbols, u: Symbols, p: Symbols) -> tuple[Symbols, Symbols]:
        late, rates = pade_delay(u[source.name], [x[q.name] for q in line], p.get("plant.dead_time", ca.SX(0)))
        moving = dynamics(late, x, p) | {q.name: r for q, r in zip(line, rates, strict=True)}
        return moving, {plant.output.name: x[plant.output.name]}

    others = tuple(n for n in names(states) if n not in {plant.output.name, "drive"})
    find = LinearStarts(shape, source.name, plant.output.name, names(line), others)
    return define(states + line, (source,), (plant.output,), parameters, rhs, find)


# A plant's polynomials are functions of the module, not lambdas: a system goes to other processes (pickle).
def _first_order_polynomials(time_constant: float) -> Polynomials:
    return [1.0], [time_constant, 1.0]


def _second_order_polynomials(w: float, damping: float) -> Polynomials:
    return [w**2], [1.0, 2 * damping * w, w**2]


def _friction_polynomials(w: float, damping: float) -> Polynomials:
    """Response to friction at unit gain: ``w² (s / (2 damping w) + 1)`` over the plant's denominator."""
    return [w / (2 * damping), w**2], [1.0, 2 * damping * w, w**2]


def _integrator_polynomials() -> Polynomials:
    return [1.0], [1.0, 0.0]


def _gain_parameter(source: Quantity, output: Quantity, per: str) -> Parameter:
    unit = _quotient_unit(output, f"({difference_unit(source.unit)}{per})" if per else difference_unit(source.unit))
    return Parameter(1.0, unit, meaning="steady output, or of an integrator its rate, per input")


def _quotient_unit(output: Quantity, unit: str) -> str:
    return f"{difference_unit(output.unit)}/{unit if unit.isalnum() or unit.startswith('(') else f'({unit})'}"


def _in_input_unit(parameters: ParameterSet, source: Quantity) -> ParameterSet:
    """Parameters of friction in the unit of the input instead of newtons, with values and bounds over 100."""
    shrunk = {n: _convert_force_unit(q, difference_unit(source.unit)) for n, q in parameters.items()}
    return ParameterSet({n: replace(q, value=0.0) if n == "viscous" else q for n, q in shrunk.items()})


def _convert_force_unit(parameter: Parameter, unit: str) -> Parameter:
    is_force = re.search(r"\bN\b", parameter.unit) is not None
    if not is_force:
        return parameter
    low, value, high = (0.01 * number for number in (parameter.lower, parameter.value, parameter.upper))
    return replace(parameter, value=value, lower=low, upper=high, unit=re.sub(r"\bN\b", unit, parameter.unit))
