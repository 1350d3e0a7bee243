"""rig.toml: the hardware around a loop that its model does not have, on which `tune` certifies a design once more.

All sections are optional: without any, the plant sticks and slips, and no more.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from pneuopt.control.loop import ClosedLoop
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.evaluation.rig import Actuator, Rig, Sensor
from pneuopt.files.toml import construct_at, read_toml
from pneuopt.models.declaration import Drive
from pneuopt.models.drive_kinds import stick_slip_drive
from pneuopt.quantities.errors import check_names, require
from pneuopt.quantities.keys import Key, check_sections, read_table, table
from pneuopt.quantities.units import difference_unit

Part = TypeVar("Part", Actuator, Sensor, Encoder)
_SENSOR = table(
    "the sensor of an output",
    {
        "lag": Key("lag of first order", unit="s", usual=Sensor.lag),
        "noise": Key("standard deviation of its noise", unit="{signal}", usual=Sensor.noise),
        "resolution": Key("step of the digital value; 0: none", unit="{signal}", usual=Sensor.resolution),
    },
)
RIG_KEYS: Mapping[str, Key] = {
    "actuator": table(
        "an imperfect valve or amplifier",
        {
            "hysteresis": Key("width of the loop, as catalogues give it", unit="{signal}", usual=Actuator.hysteresis),
            "dead_zone": Key("command around zero that does nothing", unit="{signal}", usual=Actuator.dead_zone),
        },
    ),
    "sensors": table("what the sensors show", {}, others=_SENSOR, named="output"),
    "encoder": table(
        "by which the controller gets a speed out of the measured position",
        {
            "filter": Key("time constant of its low-pass", unit="s", usual=Encoder.filter),
            "resolution": Key("one count; 0: none", unit="{signal}", usual=Encoder.resolution),
        },
    ),
}
"""The sections of a rig.toml and their keys; {signal} stands for the unit of the signal."""


def read_rig(path: str | Path, drive: Drive, loop: ClosedLoop) -> Rig:
    """Read the rig around a loop; its dry friction sticks and slips, its sensors stand in for the loop's own."""
    sections = read_toml(path).unwrap()
    check_sections(RIG_KEYS, sections, path)
    own = construct_at(lambda: replace(loop, plant=stick_slip_drive(drive).system(), sensor=None), str(path))
    actuator = _read_numbers(
        sections.get("actuator", {}), RIG_KEYS["actuator"], Actuator(), loop.command.unit, f"{path}: [actuator]"
    )
    units, usual = {q.name: q.unit for q in loop.plant.outputs}, Encoder()
    entries = sections.get("sensors", {})
    check_names("output", entries, units, f"{path}: [sensors]")
    for name, entry in entries.items():
        require(isinstance(entry, dict), f"{path}: [sensors] must hold sections, [sensors.{name}]")
    sensors = {
        n: _read_numbers(entry, _SENSOR, Sensor(), units[n], f"{path}: [sensors.{n}]") for n, entry in entries.items()
    }
    if isinstance(loop.sensor, Encoder):
        usual, sensors = loop.sensor, sensors or {loop.sensor.position: Sensor()}
    elif isinstance(loop.sensor, SensorLag):
        sensors = sensors or {loop.feedback.name: Sensor(lag=loop.sensor.lag)}
    if loop.plant.axis is not None:
        usual = replace(usual, position=loop.plant.axis.position)
    unit, where = units.get(usual.position, "m"), f"{path}: [encoder]"
    encoder = _read_numbers(sections.get("encoder", {}), RIG_KEYS["encoder"], usual, unit, where)
    sensors = sensors or {loop.feedback.name: Sensor()}
    return construct_at(lambda: Rig(own, sensors, actuator, encoder), str(path))


def _read_numbers(entries: Mapping[str, Any], section: Key, usual: Part, unit: str, where: str) -> Part:
    """A copy of a part with the numbers that a section holds, in the unit of its signal, or in seconds."""
    read = read_table(section.keys, entries, where, units={"signal": difference_unit(unit)})
    return construct_at(lambda: replace(usual, **{n: read[n] for n in entries}), where)
