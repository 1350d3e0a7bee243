from pathlib import Path

import pandas as pd
import pytest

from pneuopt.quantities.errors import InputError
from pneuopt.quantities.parameters import Parameter, ParameterSet
from pneuopt.studies.cases import read_cases

RIG = ParameterSet(
    {
        "load.mass": Parameter(5.0, "kg", 0.1, 100.0),
        "supply.pressure": Parameter(7e5, "Pa(a)"),
    }
)


def test_rows_of_a_file_become_cases_in_si(tmp_path: Path) -> None:
    path = tmp_path / "plants.csv"
    path.write_text("load.mass [g],case,supply.pressure [bar(a)]\n4000,left,5\n6500,right,7\n", encoding="utf-8")
    assert read_cases(RIG, path) == {
        "left": {"load.mass": 4.0, "supply.pressure": 5e5},
        "right": {"load.mass": 6.5, "supply.pressure": 7e5},
    }


def test_rows_without_a_name_are_counted_and_plain_columns_are_si() -> None:
    assert read_cases(RIG, pd.DataFrame({"load.mass": [4, 5]})) == {
        "row 1": {"load.mass": 4.0},
        "row 2": {"load.mass": 5.0},
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("load.mas\n1\n", "unknown parameter 'load.mas'; did you mean 'load.mass'"),
        ("load.mass [m]\n1\n", r"load\.mass \[m\].*m"),
        ("supply.pressure [bar]\n7\n", "bar"),
        ("load.mass\n1\n\nlight\n", "load.mass: row 2 is no number"),
        ("load.mass,supply.pressure\n1,\n", "supply.pressure: row 1 is no number"),
        ("load.mass\n1\n200\n", r"row 2: load\.mass: value 200 kg lies outside its bounds"),
        ("load.mass,load.mass [g]\n1,2\n", "a parameter has two columns"),
        ("case,load.mass\na,1\na,2\n", "two cases have the same name"),
        ("case\na\n", "no case; it needs a row, and a column of a parameter"),
        ("load.mass\n", "no case"),
        ("", "is no table of cases in CSV"),
        ('load.mass\n1\n"2\n3,4\n', "is no table of cases in CSV"),
        ("load.mass\n\xff\x00\n", "plants.csv: "),
    ],
)
def test_a_bad_table_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "plants.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=said) as raised:
        read_cases(RIG, path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_table_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_cases(RIG, tmp_path / "none.csv")
