"""A settling band below what an encoder's counts show is noted beside the certificate's figures."""

import pytest

from pneuopt.control.dither import Dither
from pneuopt.control.loop import ClosedLoop
from pneuopt.control.pid import PID
from pneuopt.control.reference import Step
from pneuopt.control.sensor import Encoder, SensorLag
from pneuopt.evaluation.band import Tolerance
from pneuopt.evaluation.certificate import certificate
from pneuopt.evaluation.counts import describe_counts
from pneuopt.models.drive import ForceDrive
from pneuopt.models.friction import Viscous

STEP = Step(0.02, horizon=0.05)


def counted(measured: str = "position", resolution: float = 1e-3, dither: Dither | None = None) -> ClosedLoop:
    sensor = Encoder(resolution)
    return ClosedLoop(ForceDrive(Viscous()).system(), PID(1e-3), dither, measured=measured, sensor=sensor)


def test_a_certificate_notes_a_band_below_half_a_count() -> None:
    loop = counted()
    given = loop.parameters.with_values({"pid.Kp": 100.0, "pid.Kd": 20.0, "pid.Tf": 0.01})
    (note,) = [n for n in certificate(loop, STEP, given).notes if "narrower" in n]
    assert note == (
        "at 0 to 0.02 the settling band of +-0.4 mm is narrower than half the encoder's count of 1 mm, the controller "
        "cannot tell inside from outside; take band = 0.025 or more, a larger step or a finer encoder"
    )


def test_a_reading_within_half_a_count_is_blind() -> None:
    """Within half a count of the reference, outside the band too, the controller sees the reference."""
    loop = counted()
    given = loop.parameters.with_values({"pid.Kp": 100.0, "pid.Ki": 50.0})
    assert describe_counts(loop, given, STEP, 0.024) is not None
    starts = [loop.initial(given, [0.02 + off, 0.0], reference=0.02) for off in (-0.49e-3, 0.0, 0.49e-3)]
    reading = [q.name for q in loop.states].index("sensor.reading")
    assert [x[reading] for x in starts] == pytest.approx([0.02] * 3, abs=1e-15)


@pytest.mark.parametrize(("band", "resolution"), [(0.025, 1e-3), (0.02, 8e-4), (1e-6, 0.0)])
def test_a_band_of_half_a_count_is_seen(band: float, resolution: float) -> None:
    loop = counted(resolution=resolution)
    assert describe_counts(loop, loop.parameters, STEP, band) is None


def test_a_tolerance_below_half_a_count_is_named_in_its_unit() -> None:
    loop = ClosedLoop(
        ForceDrive(Viscous()).system(), PID(sample_time=1e-3), measured="position", sensor=Encoder(resolution=1e-3)
    )
    told = describe_counts(loop, loop.parameters, Step(0.1), Tolerance(1e-4))
    assert told is not None
    assert told.startswith("the settling band of +-0.1 mm is narrower than half the encoder's count of 1 mm")
    assert "take band = 0.5 mm or more" in told
    assert describe_counts(loop, loop.parameters, Step(0.1), Tolerance(5e-4)) is None


def test_a_sensor_without_counts_shows_every_band() -> None:
    for sensor in (None, SensorLag(5e-3)):
        loop = ClosedLoop(ForceDrive(Viscous()).system(), PID(1e-3), measured="position", sensor=sensor)
        assert describe_counts(loop, loop.parameters, STEP, 1e-6) is None


def test_a_dither_may_show_what_lies_between_counts() -> None:
    loop = counted(dither=Dither(20.0))
    for amplitude, ripple in ((0.0, False), (1.0, True)):
        told = describe_counts(loop, loop.parameters.with_values({"dither.amplitude": amplitude}), STEP, 0.02)
        assert told is not None
        assert ("only by its dither's ripple" in told) == ripple


def test_a_count_of_a_speed_is_that_of_its_filter() -> None:
    """A count of 1 mm is 1/6 m/s behind a filter of 5 ms at 1 ms."""
    loop, step = counted("speed"), Step(1.0, horizon=0.2)
    assert loop.sensor_resolution(loop.parameters) == pytest.approx(1 / 6, rel=1e-12)
    told = describe_counts(loop, loop.parameters, step, 0.02)
    assert told == (
        "the settling band of +-20 mm/s is narrower than half the 0.167 m/s by which one count changes the reading; "
        "take band = 0.0834 or more, a finer encoder or a longer filter of the sensor"
    )
    assert describe_counts(loop, loop.parameters, step, 0.0834) is None
