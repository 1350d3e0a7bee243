"""The positioning benchmark P32: the drive, its moves, the plants, what is asked for, and what a controller may use.

A 32/12 mm cylinder with a stroke of 300 mm moves 5 kg. The proportional valve has a dead zone of 3 % and a spool of
80 Hz. Friction sticks: 60 N at rest, 40 N of Coulomb friction, between them a fall over 10 mm/s. The controller runs
every millisecond, and what it computes acts one sample later. It sees the position in counts of 10 um, and both
chambers' pressures with white noise of 1 kPa.

Moves: 10, 50 and 200 mm, forwards and, after a dwell of 1 s, back to where they began, at three places of the stroke:
beside its beginning, in its middle and beside its end, 20 mm from the end stops. Before the first move the piston
stands with 3.5 bar(a) in chamber b, the forces being balanced; before the move back with whatever the first one has
left in the chambers. The shape of the reference is the controller's own affair: time counts from the instant at which
the distance is asked for.

Plants: the nominal one and eight corners, mass and friction (all of its forces) +-30 %, supply pressure +-10 %. The
controller is the same for all: it knows the nominal plant alone. Fresh plants are drawn uniformly from the same box.

Asked for, in this order, of each move on each plant:

* the piston comes within .1 mm of the end and stays there; the time to that is what counts, the worst over all;
* it passes the end by .1 mm at most;
* 10 s after its last move it stands, and has not broken away in the second half of these 10 s: no hunting;
* Ms <= 2 of the loop cut at the valve's command, the plant linearised in steady motion of 50 and 200 mm/s both ways at
  the three places, where the valve is open and friction has its slope of sliding. A piston that sticks has no such
  loop: its position does not answer the command, and the loop of its pressures alone is held to Ms <= 2 in its place.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import pneuopt as po

STROKE, RESERVE = 0.3, 0.02  # [m], [m] from the end stops
DISTANCES = (0.01, 0.05, 0.2)  # [m]
DWELL, STANDING = 1.0, 10.0  # [s] between two moves, and for which the piston is watched after the last one
TOLERANCE, MAX_OVERSHOOT, MAX_SENSITIVITY = 1e-4, 1e-4, 2.0  # [m], [m], [1]
SAMPLE_TIME, COUNT, PRESSURE_NOISE = 1e-3, 1e-5, 1e3  # [s], [m], [Pa]
SPEEDS = (0.05, 0.2)  # [m/s] of the steady motions at which the loop is linearised
LIMIT = 5.0  # [V] of the command, either side
DEAD_ZONE = 0.15  # [V] that the valve's overlap takes, either side
HARDWARE = {
    "cylinder.stroke": STROKE,
    "load.mass": 5.0,
    "friction.coulomb": 40.0,
    "friction.static": 60.0,
    "friction.stribeck_velocity": 0.01,
    "friction.viscous": 80.0,
    "valve.bandwidth": 80.0,
    "valve.dead_zone": 0.03,
}
FRICTION = ("friction.coulomb", "friction.static", "friction.viscous")
SPREADS: dict[str | tuple[str, ...], float] = {"load.mass": 0.3, FRICTION: 0.3, "supply.pressure": 0.1}
START_PRESSURE = 3.5e5  # [Pa(a)] in chamber b


@dataclass(frozen=True)
class Trip:
    """A distance forwards from a place and back again.

    Parameters
    ----------
    begin, distance : float
        Where it begins, and how far it goes [m].
    """

    begin: float
    distance: float

    @property
    def label(self) -> str:
        """Where it goes [mm]."""
        return f"{1e3 * self.begin:.0f} to {1e3 * (self.begin + self.distance):.0f} mm and back"


def trips() -> Iterator[Trip]:
    """Each distance at each place."""
    for distance in DISTANCES:
        for begin in (RESERVE, (STROKE - distance) / 2, STROKE - RESERVE - distance):
            yield Trip(begin, distance)


def drive() -> tuple[po.PneumaticDrive, po.ParameterSet]:
    """The drive, which sticks, and its hardware."""
    base, given = po.catalog.t32()
    sticking = po.PneumaticDrive(base.valve, po.Karnopp(po.Stribeck()), base.load, base.chamber, base.cylinder)
    own = sticking.parameters
    known = own | given.select(n for n in given if n in own)
    return sticking, known.with_values(HARDWARE)


def plants(given: po.ParameterSet) -> dict[str, dict[str, float]]:
    """The nominal plant and the eight corners, by what differs from it."""
    return {"nominal": {}, **po.corners(given, SPREADS)}


def fresh_plants(given: po.ParameterSet, count: int, seed: int = 2027) -> Mapping[str, Mapping[str, float]]:
    """Plants drawn from the box of the corners."""
    return po.samples(given, SPREADS, count, seed=seed)
