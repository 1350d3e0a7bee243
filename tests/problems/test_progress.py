"""Scripts that take long say so."""

import pytest

import pneuopt as po
from problems.demo import rig_demo
from problems.shared.progress import PAUSE, ProgressLines


def test_a_line_comes_every_few_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    say = ProgressLines("identify")
    for seconds in (0.0, 0.1, PAUSE - 0.1, PAUSE + 0.1, PAUSE + 0.2, 3 * PAUSE):
        say(po.Progress(f"at {seconds:g}", "identify", seconds))
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.splitlines() == [
        "identify, 0 s: at 0",
        f"identify, {PAUSE:.0f} s: at {PAUSE + 0.1:g}",
        f"identify, {3 * PAUSE:.0f} s: at {3 * PAUSE:g}",
    ]


def test_each_step_of_the_demo_shows_its_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    heard = []

    def refuse(*_: object, progress: object, **__: object) -> None:
        heard.append(progress)
        raise StopIteration

    for name in ("identify", "tune"):
        monkeypatch.setattr(po, name, refuse)
    with pytest.raises(StopIteration):
        rig_demo.run()
    with pytest.raises(StopIteration):
        rig_demo.tune(None, None, progress=ProgressLines("tune"))  # type: ignore[arg-type]
    assert list(map(type, heard)) == [ProgressLines, ProgressLines]
