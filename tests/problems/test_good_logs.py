from problems.identify.good_logs import SPOILERS, draw_log, faults


def test_drawn_logs_are_right_and_spoilt_ones_are_refused() -> None:
    """The first seeds that are short, of every kind of motion; the script draws a hundred of any length."""
    logs = [log for log in map(draw_log, range(36)) if len(log.experiment.trajectory) < 20_000]
    assert {log.kind for log in logs} == {"one way", "sine", "sines", "strokes", "rests", "hunting"}
    assert [faults(log.experiment) for log in logs] == [[]] * len(logs)
    spoil = SPOILERS["thousandfold"]
    spoilt = [bad for log in logs if log.kind != "one way" and (bad := spoil(log)) is not None]
    assert spoilt
    assert all(any(f.check == "speed" for f in faults(bad)) for bad in spoilt)
