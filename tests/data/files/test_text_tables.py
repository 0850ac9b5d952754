"""Tables of texts: read from CSV and Parquet, written to Parquet in row groups."""

import pyarrow
import pyarrow.parquet
import pytest

from robotid.base.exceptions import DataError
from robotid.data.files import parquet_files
from robotid.data.files.parquet_files import parquet_rows, read_text_table


def test_csv_and_parquet_have_the_same_rows(tmp_path):
    text = '\ufeffunit,log,mass\na, "x,1.csv",\n\nb,y.csv,2.5\n'.replace(' "', '"')
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    columns = {"unit": ["a", "b"], "log": ["x,1.csv", "y.csv"], "mass": [None, 2.5]}
    pyarrow.parquet.write_table(pyarrow.table(columns), tmp_path / "t.parquet")
    expected = (
        ["unit", "log", "mass"],
        [{"unit": "a", "log": "x,1.csv", "mass": ""}, {"unit": "b", "log": "y.csv", "mass": "2.5"}],
    )
    assert read_text_table(tmp_path / "t.csv") == expected
    assert read_text_table(tmp_path / "t.parquet") == expected


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("t.csv", "a,b\n1,2,3\n", "row 1 has 3 values, wanted 2"),
        ("t.csv", "", "is empty"),
        ("t.csv", "a,a\n1,2\n", "several columns 'a'"),
        ("t.csv", 'a\n"x\n', "is not a CSV table"),
        ("t.txt", "a\n1\n", "the suffix is '.txt', wanted a table of type .csv or .parquet"),
        ("t.parquet", "a\n1\n", "broken Parquet file"),
    ],
)
def test_bad_tables_are_refused(tmp_path, name, content, said):
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError, match=said):
        read_text_table(tmp_path / name)


def test_a_missing_table_is_refused(tmp_path):
    with pytest.raises(DataError, match="there is no table"):
        read_text_table(tmp_path / "t.csv")


def test_rows_are_written_in_groups_of_a_fixed_size(tmp_path, monkeypatch):
    monkeypatch.setattr(parquet_files, "_GROUP", 4)
    rows = [{"name": f"n{k}", "value": k / 3} if k != 5 else {"name": "n5"} for k in range(10)]
    for path, size in (("a", 1), ("b", 10)):
        with parquet_rows(tmp_path / path, {"name": str, "value": float}) as table:
            for k in range(0, 10, size):
                table.add(rows[k : k + size])
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    with pyarrow.parquet.ParquetFile(tmp_path / "a") as file:
        assert [file.metadata.row_group(k).num_rows for k in range(3)] == [4, 4, 2]
        found = file.read().to_pylist()
    assert found == [{"name": None, "value": None} | row for row in rows]
