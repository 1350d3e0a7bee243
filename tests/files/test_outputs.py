"""The declaration of what --json writes: a right schema. tests/cli holds each output to it."""

import pytest
from jsonschema import Draft202012Validator, ValidationError

from pneuopt.files.first_files import first_files
from pneuopt.files.outputs import OUTPUTS, output_schema
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
