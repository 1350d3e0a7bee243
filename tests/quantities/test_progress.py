import pickle

from pneuopt.quantities.progress import Progress, ProgressReporter


def test_a_report_is_its_text_and_knows_what_it_belongs_to() -> None:
    heard: list[Progress] = []
    report = ProgressReporter(heard.append, "sweep")
    report("1 of 3 cases", 1, 3)
    report("searching")
    assert heard == ["1 of 3 cases", "searching"]
    assert [(r.job, r.done, r.total) for r in heard] == [("sweep", 1, 3), ("sweep", None, None)]
    assert 0 <= heard[0].seconds <= heard[1].seconds
    copy = pickle.loads(pickle.dumps(heard[0]))
    assert (copy, copy.job, copy.done, copy.total) == (*heard[:1], "sweep", 1, 3)


def test_nobody_need_listen() -> None:
    ProgressReporter(None, "tune")("text")
