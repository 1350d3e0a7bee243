"""The positioning benchmark P32: its statement, its references, its fast simulation, and its rivals."""

from typing import Any

import numpy as np
import pytest

import pneuopt as po
from pneuopt.control.compensators import ControllerSnapshot
from problems.shared.exact_linearisation import ExactLinearisation
from problems.shared.p32 import SAMPLE_TIME, drive, fresh_plants, plants, trips
from problems.shared.p32_margins import Margins
from problems.shared.p32_moves import Outing, Profile
from problems.shared.p32_rules import OMEGA, OUTER, RULED_GAINS, RULES, cascade_by_rule, ultimate_cycle
from problems.shared.p32_search import Task, searched_plants
from problems.shared.p32_simulator import FastSimulator, Lane, read
from problems.shared.p32_structures import STRUCTURES, gains
from problems.tune import p32

PROFILE = Profile(0.4, 4.0, 0.05, 1e-3, 0.3)
GAINS = {"position_loop.Kp": 20.0, "pid.Kp": 2.0, "pressure_feedback.gain": 1e-5, "dead_zone_inverse.width": 0.14}


def test_the_trips_and_plants_are_those_of_the_statement() -> None:
    known = list(trips())
    assert sorted({t.distance for t in known}) == [0.01, 0.05, 0.2]
    assert len(known) == 9
    assert min(t.begin for t in known) == pytest.approx(0.02)
    assert max(t.begin + t.distance for t in known) == pytest.approx(0.28)
    given = drive()[1]
    corners = plants(given)
    assert len(corners) == 9
    assert {v["load.mass"] for n, v in corners.items() if n != "nominal"} == {3.5, 6.5}
    drawn = fresh_plants(given, 20)
    assert all(28.0 <= v["friction.coulomb"] <= 52.0 and 42.0 <= v["friction.static"] <= 78.0 for v in drawn.values())
    assert all(v["friction.static"] == pytest.approx(1.5 * v["friction.coulomb"]) for v in drawn.values())
    assert len(searched_plants()) == 5


@pytest.mark.parametrize("distance", [0.01, -0.05, 0.2])
def test_a_profile_ends_where_it_shall_within_its_limits(distance: float) -> None:
    end = PROFILE.corners(abs(distance))[0][-1]
    t = np.linspace(-0.01, end + 0.01, 20001)
    way, speed, acceleration = PROFILE.motion(distance, t)
    assert (way[0], speed[0], way[-1], speed[-1]) == (0.0, 0.0, pytest.approx(distance, abs=1e-12), 0.0)
    np.testing.assert_allclose(np.gradient(way, t), speed, atol=4 * (t[1] - t[0]) * 4.0)
    assert np.abs(speed).max() <= 0.4 + 1e-12
    assert np.abs(acceleration).max() == pytest.approx(4.0 * (abs(distance) / 0.2) ** 0.3)
    late = np.abs(distance - way) < 0.9e-3
    assert np.abs(speed[late]).max() <= 0.05 + 1e-12


def test_an_outing_comes_back() -> None:
    outing = Outing(next(trips()), PROFILE, 0.3, last=0.1)
    path = outing.trajectory()
    (first, middle, far, _), (_, last, begin, _) = outing.moves
    assert (first, len(path)) == (0, last + 1)
    assert path["reference"][[0, middle, last]] == pytest.approx([begin, far, begin])
    step = Outing(next(trips()), None, 0.3).trajectory()
    assert step["reference"][:2] == pytest.approx([0.03, 0.03])


@pytest.mark.slow
def test_the_fast_simulation_sticks_and_slips_as_the_event_accurate_one() -> None:
    structure = STRUCTURES["state_feedback"]
    loop = structure.loop()
    p = structure.parameters().with_values({**GAINS, "motion_feedforward.speed": 1.8})
    outing = Outing(list(trips())[4], PROFILE, 0.3)
    position, speed = FastSimulator(loop, p, noise=0.0).run([Lane(outing, {})])
    start = loop.initial(p, reference=outing.trip.begin, start=outing.start)
    found = po.simulate_stick_slip(loop, outing.trajectory(), p, initial=start)
    assert len(found.events) >= 4
    np.testing.assert_allclose(position[0], found.trajectory["position"], atol=5e-6)
    stuck = found.trajectory["stuck"] == 1
    np.testing.assert_array_equal(speed[0][stuck & np.roll(stuck, 1) & np.roll(stuck, -1)], 0.0)


def test_a_move_is_settled_where_it_stays_within_the_tolerance() -> None:
    outing = Outing(next(trips()), PROFILE, 0.1)
    position = outing.trajectory()["reference"].copy()
    there = outing.moves[1][0]
    position[there - 5] += 2e-4
    found = read(position[None], [outing])
    assert found.settling[0, 0] == pytest.approx((there - 4) * SAMPLE_TIME, abs=1e-9)
    assert found.settling[0, 1] < outing.duration
    assert found.overshoot[0] == pytest.approx([2e-4, 0.0], abs=1e-12)
    position[there - 1 : there + 1] += 2e-4
    assert np.isinf(read(position[None], [outing]).settling[0, 0])


@pytest.mark.parametrize("name", STRUCTURES)
def test_a_point_stands_for_its_values(name: str) -> None:
    structure = STRUCTURES[name]
    point = np.linspace(0.1, 0.9, len(structure.ranges))
    values = structure.values(point)
    assert all(low <= values[n] <= high for n, (low, high) in structure.ranges.items())
    np.testing.assert_allclose(structure.point(values), point)
    assert set(gains(values)) <= set(structure.parameters())


def test_the_linearisation_gives_the_force_the_rate_that_it_asks_for() -> None:
    """At an opening of the valve beyond its dead zone, which another part adds, for both directions of the flow."""
    drive_, given = drive()
    law = ExactLinearisation(given)
    for wanted, speed in ((0.5, 0.3), (-0.4, 0.1), (0.2, -0.3)):
        state = {"position": 0.1, "speed": speed, "pressure_a": 4.6e5, "pressure_b": 4.9e5}
        p: Any = {"speed_gain": 30.0, "force_gain": 80.0, "friction": 20.0, "smoothing": 1e-3, "rise": 0.5}
        rates = {"reference_speed": 0.2, "reference_acceleration": 1.0}
        voltage = float(law.act(ControllerSnapshot(0.0, wanted, speed, 0.0, SAMPLE_TIME, rates, state), {}, p)[1])
        opening = voltage / given.value("valve.span")
        spool = opening + np.sign(opening) * given.value("valve.dead_zone")
        x = [{**state, "valve.spool": spool}.get(q.name, 0.0) for q in drive_.states]
        ode = drive_.system().ode
        moved = ode(0.0, x, [0.0], [given.value(n) for n in drive_.parameters])[0].full().ravel()
        area_a, area_b = np.pi / 4 * 0.032**2, np.pi / 4 * (0.032**2 - 0.012**2)
        force = area_a * (4.6e5 - 1e5) - area_b * (4.9e5 - 1e5)
        asked = 5.0 * (1.0 + 30.0 * (wanted - speed)) + 80.0 * 0.2 + 20.0
        assert area_a * moved[2] - area_b * moved[3] == pytest.approx(80.0 * (asked - force), rel=0.02)


@pytest.mark.slow
def test_the_largest_ms_of_a_plant_is_among_all() -> None:
    structure, known = STRUCTURES["state_feedback"], [{}, {"load.mass": 3.5}]
    margins = Margins(structure.loop(), structure.parameters(), known, points=8)
    each, values = margins.plant_peaks(GAINS), margins.peaks(GAINS)
    assert each.shape == (2, 2)
    assert tuple(each.max(axis=0)) == values
    alone = Margins(structure.loop(), structure.parameters(), known[1:], points=8)
    assert tuple(each[1]) == pytest.approx(alone.peaks(GAINS))


@pytest.mark.slow
def test_a_design_is_read_certified_and_drawn() -> None:
    structure = STRUCTURES[p32.WINNER]
    values = p32.designs()[p32.WINNER]
    found = p32.evaluate(structure, values, {"nominal": {}}, 2.0)
    rows = {claim.name: claim.value for claim in p32.rows("x", found)}
    assert rows["x.standing"] == rows["x.kept"] == 100.0
    assert rows["x.within"] <= 0.1
    assert found.sound.tolist() == [True]
    bare = p32.evaluate(structure, {**values, **p32.WITHOUT["pulses"][1]}, {"nominal": {}}, 2.0)
    assert not bare.kept.all()
    job = p32.Job(
        {p32.WINNER: found, "linearisation": found}, {"linearisation": found}, {"pulses": bare}, {"more": bare}
    )
    claims = p32.main(job).set_index("name")["value"]
    assert claims["linearisation.slower"] == 1.0
    assert claims["fresh.linearisation.plants"] == 100.0
    assert claims["without.pulses.kept"] == claims["with.more.kept"] < 100.0
    assert p32.figure(job).axes
    task = Task(structure, {"nominal": {}})
    assert max(task.margins.peaks(gains(values))) <= 2.0
    assert task.read(values).error.shape == (9, 2)


def test_an_ultimate_cycle_is_that_of_a_triple_lag() -> None:
    """Of K/(T s + 1)^3: the gain 8/K at the frequency sqrt(3)/T; of several loops the one that oscillates first."""
    loops = [K / (1 + 1j * T * OMEGA) ** 3 for K, T in ((2.0, 0.1), (0.5, 0.01))]
    assert ultimate_cycle(np.array(loops)) == pytest.approx((4.0, np.sqrt(3) / 0.1), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("rule", RULES)
def test_the_gains_of_a_rule_are_its_shares_of_those_that_are_barely_stable(rule: str) -> None:
    """Stability by the closed loop's poles, of which the rule knows nothing."""
    structure, share = STRUCTURES["cascade"], RULES[rule][0]
    found = gains(cascade_by_rule(rule, p32.designs()["cascade"]))
    margins = Margins(structure.loop(), structure.parameters(), [{}], points=8)

    def is_stable(speed: float, integral: float, position: float) -> bool:
        own = {"pid.Kp": speed, "pid.Ki": integral, "position_loop.Kp": position}
        return bool(np.isfinite(margins.peaks(found | own)[0]))

    Kp, Ki, K = (found[n] for n in RULED_GAINS)
    assert [is_stable(k * Kp / share, 0.0, 0.0) for k in (0.99, 1.01)] == [True, False]
    assert [is_stable(Kp, Ki, k * K / OUTER) for k in (0.99, 1.01)] == [True, False]
