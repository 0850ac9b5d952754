import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers.synthetic import payload_log

from robotid.cli import main
from robotid.cli import track as command
from robotid.data.files.read import write_log
from robotid.identification.online.identifier import track
from robotid.identification.online.online_settings import OnlineSettings

ARM = [f"panda_joint{i}" for i in range(1, 8)]


@pytest.fixture(scope="module")
def log_file(panda, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "payload.parquet"
    write_log(payload_log(panda, np.random.default_rng(0)), path)
    return path


def words(panda, log_file, out):
    return ["track", str(panda.tree.path), str(log_file), "--joints", ",".join(ARM), "--out", out]


def test_track_writes_the_history_and_says_when_the_load_came(panda, log_file, tmp_path, capsys):
    assert main([*words(panda, log_file, str(tmp_path)), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    command._show(printed)
    text = capsys.readouterr().out
    rows = {line.split()[0]: line.split()[1:] for line in text.splitlines() if " +- " in line}
    for entry in printed["base_parameters"]:
        value, _, error, *unit = rows[entry["name"]]
        assert float(value) == pytest.approx(entry["value"], abs=0.06 * entry["std_error"])
        assert float(error) == pytest.approx(entry["std_error"], rel=0.06)
        assert " ".join(unit) == entry["unit"]
    assert "delay of the estimate 47 ms" in text
    change = "step change at 9.99 s, detected at 10.17 s; equivalent payload on panda_link7"
    assert change in text
    assert printed == json.loads((tmp_path / "track.json").read_text())
    (change,) = printed["changes"]
    assert change["onset"] == pytest.approx(10.0, abs=0.05)
    assert change["payload"]["body"] == "panda_link7"
    assert change["payload"]["mass"] == pytest.approx(2.0, abs=0.06)
    history = pq.read_table(tmp_path / "track.parquet")
    last = printed["base_parameters"][-1]
    assert history.column_names[0] == "time"
    assert history.column(last["name"])[-1].as_py() == last["value"]
    assert history.column(last["name"] + ".std_error")[-1].as_py() == last["std_error"]
    assert len(history.column_names) == 1 + 2 * len(printed["base_parameters"]) + 2
    # 20 rows a second from the first estimate on
    assert history.num_rows == pytest.approx(20 * (15 - printed["first_estimate"]), abs=5)


def test_a_history_has_twenty_rows_a_second_and_the_last_sample(panda):
    log = payload_log(panda, np.random.default_rng(0), duration=1.83, at=99.0)
    seen = []
    found = track(panda, log, OnlineSettings(), observer=lambda k, of: seen.append((k, of)))
    assert [k for k, _ in seen] == list(range(len(log.t)))
    assert {of for _, of in seen} == {found.identifier}
    assert found.t[-1] == log.t[-1]
    np.testing.assert_allclose(np.diff(found.t[:-1]), 0.05, atol=1e-9)
    assert 0 < found.t[-1] - found.t[-2] < 0.045
    last, columns = found.identifier.reading, found.columns()
    for k, name in enumerate(found.identifier.names):
        assert columns[name][-1] == last.theta[k]
        assert columns[f"{name}.std_error"][-1] == last.std_error[k]
    np.testing.assert_array_equal(columns["time"], found.t)
    np.testing.assert_array_equal(columns["excitation"], found.excitation)
    assert (np.diff(found.excitation) >= -1e-9).all()
    assert found.excitation[-1] == last.excitation
    np.testing.assert_array_equal(columns["converged"], found.converged)
