"""A job whose logs are read in pieces ends where the same job in memory ends."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.driven import arm
from helpers.synthetic import exact_log, truth

from robotid.cli.identify import run_job
from robotid.cli.job import Job, LogEntry
from robotid.cli.validate import validate
from robotid.data.files.read import read_log, write_log
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.robot.drives import DRIVE_TERMS

HELD = 1024  # rows in memory, so that pieces have 256


@pytest.fixture(scope="module")
def noisy_job(tmp_path_factory):
    """Return a job with a log to fit in CSV, and one kept apart in Parquet."""
    model, rng, folder = arm(), np.random.default_rng(0), tmp_path_factory.mktemp("job")
    logs = [exact_log(model, truth(model), rng, samples=n, noise=0.3) for n in (1500, 700)]
    paths = [folder / "fit.csv", folder / "kept.parquet"]
    for log, path in zip(logs, paths, strict=True):
        write_log(log, path)
    return Job(
        urdf=Path(model.tree.path),
        joints=model.joints,
        signals=SignalSettings(cutoff=10.0),
        terms=DRIVE_TERMS,  # of a log in pieces, what else there is is judged by three segments
        identification=(LogEntry(paths[0]),),
        validation=(LogEntry(paths[1]), LogEntry(paths[1], 2.0, 9.0)),
        report=False,
    )


@pytest.fixture
def without_doctor(monkeypatch):
    monkeypatch.setattr("robotid.cli.identify.examine_logs", lambda *_: ())


def assert_same(one, other, first, second):
    """Check a job in pieces, the second, beside that in memory."""
    # Standard errors are the scatter of segments, which pieces cut elsewhere. One that depends on f
    # degrees of freedom is itself known to 1 / sqrt(2 f): so far, with the f of both, may their
    # logarithms differ. Of 60 normal values one is beyond 4 standard deviations in one case of 260.
    wls = one.wls.theta
    np.testing.assert_allclose(other.wls.theta, wls, rtol=0, atol=1e-9 * np.abs(wls).max())
    np.testing.assert_allclose(other.prior_std, one.prior_std, rtol=1e-9)
    gap = np.abs(other.standard - one.standard) / one.standard_error
    assert gap.max() < 1e-3, "what the solver makes of equal factors differs within its tolerance"
    ratio = np.log(other.standard_error / one.standard_error)
    assert abs(np.median(ratio)) < np.log(1.25), np.exp(ratio)
    assert np.sqrt(np.mean(ratio**2)) < 1 / 3, np.exp(ratio)
    known = np.sqrt(0.5 / one.errors.freedom + 0.5 / other.errors.freedom)
    off = np.log(other.base_error / one.base_error) / known
    assert np.sqrt(np.mean(off**2)) < 1.25, off
    assert np.abs(off).max() < 4.0, off
    for verdict in (first["verdict"], *first["verdict"]["per_joint"].values()):
        # one side may find another
        verdict["reasons"] = [x for x in verdict["reasons"] if "largest error" not in x]
    for key, rtol in TOLERANCES.items():
        assert_close(second[key], first[key], rtol)
    for key in ("identification", "validation"):
        assert_close(second["wls"][key], first["wls"][key], 1e-8)
    assert {w["code"] for w in second["warnings"]} == {w["code"] for w in first["warnings"]}


#: Of the parts of result.json.
TOLERANCES = dict.fromkeys(("verdict", "structure", "joints", "outputs"), 1e-6)
TOLERANCES |= {"inputs": 1e-14, "identification": 1e-5, "validation": 1e-5}


def leaves(value, place=""):
    """Yield values of JSON by place; no bands: they follow errors of segments cut elsewhere."""
    if isinstance(value, str):
        words = re.split(r"(\d+\.?\d*)", value)
        yield place, "#".join(words[::2])
        yield f"{place} figures", [float(x) for x in words[1::2]]
    elif isinstance(value, dict | list):
        for key, x in value.items() if isinstance(value, dict) else enumerate(value):
            if key not in ("band", "expected"):
                yield from leaves(x, f"{place}/{key}")
    else:
        yield place, value


def assert_close(found, wanted, rtol):
    """Check values of JSON, numbers to a tolerance."""
    values = dict(leaves(wanted))
    for key, x in values.items():
        if isinstance(x, float | list):
            rel = 0.015 if isinstance(x, list) else rtol
            values[key] = pytest.approx(x, rel=rel, abs=1e-12)
    assert dict(leaves(found)) == values


def test_a_job_in_pieces_ends_where_it_ends_in_memory(noisy_job, tmp_path):
    runs = [
        run_job(replace(noisy_job, rows_in_memory=rows), tmp_path / str(rows))
        for rows in (10**9, HELD)
    ]
    (one, first), (other, second) = runs
    assert_same(one, other, first, second)
    # all samples are drawn of one so short
    assert [e.recording.is_partial for e in other.validation] == [False, False]
    assert other.fitted[0].recording.name == one.fitted[0].recording.name
    assert second["settings"]["reduction"] == {"rows_in_memory": HELD}
    kept = noisy_job.validation[0].path
    again = [validate(tmp_path / str(x) / "result.json", [kept]) for x in (HELD, 10**9)]
    assert_close(*(x["validation"] for x in again), 1e-5)


@pytest.mark.parametrize("name", ["rls", "prx"])  # one pass and several
def test_recursive_estimators_read_pieces_in_the_order_of_time(
    noisy_job, name, tmp_path, without_doctor
):
    job = replace(noisy_job, estimator=EstimatorSettings(name), validation=())
    one, _ = run_job(replace(job, rows_in_memory=10**9), tmp_path / "memory")
    other, _ = run_job(replace(job, rows_in_memory=HELD), tmp_path / "pieces")
    size = np.abs(one.estimate.theta).max()
    np.testing.assert_allclose(other.estimate.theta, one.estimate.theta, rtol=0, atol=1e-8 * size)


def test_a_fitted_recording_is_no_validation_in_pieces_either(noisy_job, tmp_path, without_doctor):
    """The rows are found whatever the file is called, where it starts and what its clock says."""
    log = read_log(noisy_job.identification[0].path, noisy_job.joints)
    part = Log(t=log.t + 7.0, q=log.q, tau=log.tau, joints=log.joints).window(20.0, 30.0)
    write_log(part, tmp_path / "other_name.parquet")
    again, apart = LogEntry(tmp_path / "other_name.parquet"), noisy_job.validation[0]
    job = replace(noisy_job, validation=(apart, again), rows_in_memory=HELD)
    identification, _ = run_job(job, tmp_path / "out")
    assert [e.is_refitted for e in identification.validation] == [False, True]
