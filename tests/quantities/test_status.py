"""A status is a code and sentences: the verdict first, the remedy last."""

from pneuopt.quantities.status import Code, Status

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
