"""Rows with equal time steps, whole, in parts, and converted."""

import numpy as np
import pandas as pd
import pytest

from robotid.cli.convert import convert
from robotid.data.files.read import lay_out, read_log
from robotid.data.files.table import RowReader, Table, with_even_stamps
from robotid.data.signal_settings import LogSource, LogUnits

EVEN = LogSource(stamp="even")
START, STEP, ROWS = 7000.0, 4.0, 500  # [ms]


@pytest.fixture(params=[".csv", ".parquet", ".npz"])
def path(request, tmp_path):
    """Return a file of a joint whose rows wait for every fifth one, in ms."""
    k = np.arange(ROWS)
    t = START + STEP * (k // 5 * 5 + 4) + 0.01 * (k % 5)
    table = {"time": t, "q_a": np.sin(0.01 * k), "tau_a": np.cos(0.01 * k)}
    path = tmp_path / f"log{request.param}"
    if request.param == ".npz":
        np.savez(path, **table)
    else:
        frame = pd.DataFrame(table)
        frame.to_csv(path, index=False) if request.param == ".csv" else frame.to_parquet(path)
    return path


def test_stamps_are_the_line_through_those_of_the_rows(path):
    k, given = np.arange(ROWS), START + STEP * (np.arange(ROWS) // 5 * 5 + 4)
    step, start = np.polyfit(k, given + 0.01 * (k % 5), 1)
    units = LogUnits(time="ms")
    log = read_log(path, ["a"], source=EVEN, units=units)
    np.testing.assert_allclose(log.t, (start + step * k) / 1e3, atol=1e-12)
    np.testing.assert_allclose(np.diff(log.t), STEP / 1e3, rtol=1e-3)
    layout, table = lay_out(path, ["a"], source=EVEN, units=units)
    if table.rows is None:
        return
    blocks = [(values, place) for values, place in table.rows.scan("time")]
    np.testing.assert_allclose(np.concatenate([x for x, _ in blocks]) / 1e3, log.t, atol=1e-12)
    part = layout.to_log(table.rows.read(layout.wanted, 123, 321, blocks[0][1]), 123)
    np.testing.assert_allclose(part.t, log.t[123:321], atol=1e-12)
    np.testing.assert_array_equal(part.q, log.q[123:321])
    assert table.rows.count() == pytest.approx(ROWS, rel=0.2)


def test_a_file_is_converted_with_equal_steps(path, tmp_path):
    convert(path, tmp_path / "out.csv", source=EVEN)
    out = pd.read_csv(tmp_path / "out.csv")
    assert np.ptp(np.diff(out["time"])) < 1e-9
    np.testing.assert_array_equal(out["q_a"], np.sin(0.01 * np.arange(ROWS)))
    convert(path, tmp_path / "as_is.csv")
    assert np.ptp(np.diff(pd.read_csv(tmp_path / "as_is.csv")["time"])) > STEP


def test_one_row_and_other_columns_stay():
    table = Table(["time", "q"], lambda names: {name: np.array([3.0]) for name in names})
    even = with_even_stamps(table, "time")
    assert even.read(["time", "q"]) == {"time": [3.0], "q": [3.0]}
    assert even.read(["q"]) == {"q": [3.0]}
    assert even.rows is None


class Blocks(RowReader):
    """Rows in blocks of unlike lengths, the first one empty."""

    def __init__(self, t):
        self.t, self.parts = t, np.split(t, [0, 3, 50, 51])

    def count(self):
        return len(self.t)

    def scan(self, name):
        yield from ((part if name == "time" else -part, k) for k, part in enumerate(self.parts))

    def read(self, wanted, first, stop, near):
        return {name: (1 if name == "time" else -1) * self.t[first:stop] for name in wanted}


def test_the_line_is_that_through_all_blocks_of_a_long_file(rng):
    t = 1.7e9 + 0.004 * np.arange(90) + 0.001 * rng.random(90)
    even = with_even_stamps(Table(["time", "q"], lambda names: {}, rows=Blocks(t)), "time").rows
    k = np.arange(90)
    step, start = np.polyfit(k, t - t[0], 1)
    wanted = start + step * k
    blocks = list(even.scan("time"))
    assert [(len(x), place) for x, place in blocks] == [(0, 0), (3, 1), (47, 2), (1, 3), (39, 4)]
    np.testing.assert_allclose(np.concatenate([x for x, _ in blocks]) - t[0], wanted, atol=1e-6)
    np.testing.assert_array_equal(np.concatenate([x for x, _ in even.scan("q")]), -t)
    part = even.read(["q", "time"], 40, 60, 2)
    np.testing.assert_allclose(part["time"] - t[0], wanted[40:60], atol=1e-6)
    np.testing.assert_array_equal(part["q"], -t[40:60])
