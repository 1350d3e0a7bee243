import json
import math
from pathlib import Path

import pandas as pd
import pytest

from pneuopt.quantities.errors import InputError
from pneuopt.quantities.output import check_output_paths, write_json, write_records, write_text


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "out.toml"
    path.write_text("before", encoding="utf-8")
    write_text(path, "after\n")
    assert path.read_bytes() == b"after\n"
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "half of it \ud800")
    assert path.read_bytes() == b"after\n"
    assert [p.name for p in tmp_path.iterdir()] == ["out.toml"]
    with pytest.raises(InputError, match="the folder does not exist; make it first"):
        write_text(tmp_path / "none" / "out.toml", "")
    with pytest.raises(InputError, match="cannot be written"):
        write_text(tmp_path, "")


def test_records_are_plain_json(tmp_path: Path) -> None:
    frame = pd.DataFrame({"value": [1.5, math.nan, math.inf], "holds": [True, False, True], "unit": ["%", "s", "µm"]})
    write_records(tmp_path / "claims.json", frame)
    records = json.loads((tmp_path / "claims.json").read_text(encoding="utf-8"))
    assert records[0] == {"value": 1.5, "holds": True, "unit": "%"}
    assert [r["value"] for r in records] == [1.5, None, None]
    write_records(tmp_path / "estimates.json", frame.set_axis(["a", "b", "c"], axis=0))
    assert [r["name"] for r in json.loads((tmp_path / "estimates.json").read_text(encoding="utf-8"))] == ["a", "b", "c"]


def test_a_table_of_logs_and_channels_keeps_both_names(tmp_path: Path) -> None:
    frame = pd.DataFrame({"log": ["a", "b"], "channel": ["speed", "speed"], "rmse": [1.0, 2.0]})
    write_records(tmp_path / "fit.json", frame.set_index(["log", "channel"]))
    assert json.loads((tmp_path / "fit.json").read_text(encoding="utf-8")) == frame.to_dict(orient="records")


def test_a_document_is_plain_json(tmp_path: Path) -> None:
    write_json(tmp_path / "x.json", {"a": {"b": math.nan, "path": Path("c")}, "rows": [{"v": math.inf}]})
    said = json.loads((tmp_path / "x.json").read_text(encoding="utf-8"))
    assert said == {"a": {"b": None, "path": "c"}, "rows": [{"v": None}]}


def test_outputs_are_refused_before_the_work(tmp_path: Path) -> None:
    given = tmp_path / "drive.toml"
    given.touch()
    check_output_paths([tmp_path / "fit.toml", None, tmp_path / "fit.json"], [given])
    with pytest.raises(InputError, match=r"drive\.toml: is an input of this command"):
        check_output_paths([tmp_path / "." / "drive.toml"], [given])
    with pytest.raises(InputError, match="named for two outputs"):
        check_output_paths([tmp_path / "a", tmp_path / "a"], [given])
    with pytest.raises(InputError, match="the folder does not exist"):
        check_output_paths([tmp_path / "none" / "a"], [given])
    with pytest.raises(InputError, match="is a folder"):
        check_output_paths([tmp_path], [given])
