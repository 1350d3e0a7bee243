"""What a tuning's file becomes with a result."""

from dataclasses import replace
from pathlib import Path

import pytest

from pneuopt.files.drive import read_status
from pneuopt.files.toml import read_toml
from pneuopt.files.tuned import write_tuned
from pneuopt.files.tuning import read_tuning
from pneuopt.quantities.errors import InputError
from pneuopt.quantities.status import Code, Status
from tests.files.test_tuning import PLANT, read_all, tuned


def test_of_a_failed_tuning_the_best_candidate_is_written_without_the_old_certificate(tmp_path: Path) -> None:
    _, found = read_all(tmp_path, {"pid.Kp": 12.34})
    write_tuned(tmp_path / "tuned.toml", tmp_path / "tuning.toml", tuned(found))
    nothing = tuned(found, status=Status(Code.NOT_CERTIFIED, ("grazes the band",)))
    with pytest.raises(InputError, match="found no candidate: grazes the band"):
        write_tuned(tmp_path / "again.toml", tmp_path / "tuned.toml", nothing)
    assert not (tmp_path / "again.toml").exists()
    failed = replace(nothing, best={"pid.Kp": 50.0})
    write_tuned(tmp_path / "again.toml", tmp_path / "tuned.toml", failed)
    assert read_tuning(tmp_path / "again.toml", PLANT).parameters.value("pid.Kp") == 50.0
    said = read_toml(tmp_path / "again.toml").unwrap()
    assert "certified" not in said
    assert "no certificate" in said["status"]["gains"]
    assert read_status(tmp_path / "again.toml") == failed.status
