"""A status is a code and sentences: the verdict first, the remedy last."""

import pickle

from pneuopt.quantities.status import Code, Progress, ProgressReporter, Status

FAILED = Status(Code.NOT_CONVERGED, ("the gaps carry 12% of the cost", "check the model's terms"))


def test_the_verdict_is_on_the_first_line_and_details_below_it() -> None:
    assert str(FAILED) == "NOT converged (not converged): the gaps carry 12% of the cost\n  check the model's terms"
    assert str(Status(Code.CONVERGED)) == "converged"
    assert FAILED.verdict == "the gaps carry 12% of the cost"
    assert Status(Code.INTERRUPTED).verdict == "interrupted"


def test_details_stand_before_the_remedy_and_empty_ones_nowhere() -> None:
    full = FAILED.with_details("", "the worst is at 0.3 s").with_remedies("", "or log again")
    assert full.message == (
        "the gaps carry 12% of the cost; the worst is at 0.3 s; check the model's terms; or log again"
    )
    assert full.code is Code.NOT_CONVERGED
    assert Status(Code.CONVERGED).with_details().sentences == ()


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
