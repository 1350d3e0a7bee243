from pneuopt.logs.doctor import examine
from problems.identify.good_logs import SPOILERS, draw_log, is_caught


def test_drawn_logs_are_right_and_spoilt_ones_are_refused() -> None:
    """The first seeds that are short, of every kind of motion; the script draws a hundred of any length."""
    logs = [log for log in map(draw_log, range(36)) if len(log.experiment.trajectory) < 20_000]
    assert {log.kind for log in logs} == {"one way", "sine", "sines", "strokes", "rests", "hunting"}
    found = [(f.check, log.kind) for log in logs for f in examine(log.experiment, log.axis) if f.check != "sampling"]
    assert set(found) <= {("dwells", "rests")}  # a note, and true
    slow = [
        log for log in logs if log.kind != "one way" and log.frequency < 2 and len(log.experiment.trajectory) < 5000
    ]
    for name in ("offset", "stops", "jumps"):
        spoilt = [bad for log in slow if (bad := SPOILERS[name](log)) is not None]
        assert sum(is_caught(name, bad) for bad in spoilt) > 0.7 * len(spoilt) > 0, name
