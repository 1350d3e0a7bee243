"""The declaration of what --json writes: a right schema. tests/cli holds each output to it."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import pytest
from jsonschema import Draft202012Validator, ValidationError

from pneuopt.files.first_files import first_files
from pneuopt.files.outputs import OUTPUTS, Holds, Member, members_of, output_schema
from pneuopt.quantities.parameters import ParameterSet


def test_the_schema_is_one() -> None:
    Draft202012Validator.check_schema(output_schema())
    assert set(output_schema()["$defs"]) == set(OUTPUTS)


@pytest.mark.parametrize(
    ("document", "right"),
    [
        ({"fit": [], "provenance": {"sha256[fit.toml]": "0f"}}, True),
        ({"fit": []}, False),
        ({"fit": [], "provenance": {}, "more": 1}, False),
        ({"fit": [{"log": "a"}], "provenance": {}}, False),
        ({"certified": [{"name": "0 to 0.2", "Overshoot": None}], "provenance": {}}, True),
        ({"certified": [{"name": "0 to 0.2", "Overshoot": [1]}], "provenance": {}}, False),
    ],
)
def test_a_wrong_output_is_refused(document: object, right: bool) -> None:
    validator = Draft202012Validator(output_schema())
    if right:
        validator.validate(document)
    else:
        with pytest.raises(ValidationError):
            validator.validate(document)


def test_init_writes_it() -> None:
    assert "schemas/output.json" in first_files("force", ParameterSet({}), {})


class Ending(Enum):
    GOOD = "good"
    BAD = "bad"


@dataclass(frozen=True)
class Found:
    """What a search has found.

    Attributes
    ----------
    value : float
        Of the cost [1]. The least one.
    ending : Ending
        How it ended.
    steps, tries : int
        How many.
    why : mapping of str to str, optional
    places : dict
        What no output holds.
    """

    value: float
    ending: Ending
    steps: int
    tries: int
    why: Mapping[str, str] | None
    places: dict[str, object]

    @property
    def is_good(self) -> bool:
        """Whether it ended well."""
        return self.ending is Ending.GOOD


def test_the_members_of_an_output_are_those_that_a_results_type_declares() -> None:
    assert members_of(Found, ("is_good", "value", "ending", "tries", "why")) == {
        "is_good": Member("whether it ended well", Holds.FLAG),
        "value": Member("of the cost", Holds.NUMBER),
        "ending": Member("how it ended; one of good, bad", Holds.TEXT),
        "tries": Member("how many", Holds.COUNT),
        "why": Member("why", Holds.WORDS, is_optional=True),
    }
    with pytest.raises(TypeError, match=r"Found\.places: no output holds"):
        members_of(Found)
