"""The figures of findings, by an independent computation: evidence and sentences alike."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.findings import Figures

from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.channels import check_channels, check_torque_channels

T = 3.0 + np.arange(2000) / 100


def log_of(t=T, tau=None, **changes):
    q = np.column_stack([np.sin(2 * (t - 3.0)), 0.4 * np.cos(3 * (t - 3.0))])
    tau = 5.0 * q if tau is None else tau
    return replace(Log(t, q, tau, ("a", "b"), path="run.csv"), **changes)


def one(findings, code):
    [found] = [f for f in findings if f.code == code]
    return found


def test_spikes_are_counted_by_their_share_of_what_varies():
    rng = np.random.default_rng(0)
    tau = 40.0 + 5.0 * log_of().q + 0.01 * rng.standard_normal((2000, 2))
    tau[[310, 700, 1500], 1] += [120.0, -70.0, 90.0]
    found = one(check_channels(log_of(tau=tau), SignalSettings()), "spikes")
    x = tau[:, 1]
    height = np.array([120.0, -70.0, 90.0])
    share = np.sum(height**2) / np.sum((x - np.median(x)) ** 2)
    assert (found.where, found.severity) == ("run.csv: tau_b", "error")
    assert Figures(found) == {
        "rows": 3.0, "largest": pytest.approx(120.0, abs=0.2), "first": pytest.approx(6.1),
        "energy_share": pytest.approx(share, rel=0.01),
    }  # fmt: skip
    assert "tau of b has spikes of up to 120 in 3 rows, the first at t = 6.1 s" in found.message


@pytest.mark.parametrize("rows", [3, 5, 6])
def test_a_held_torque_is_late_by_half_of_what_it_is_held_less_a_row(rows):
    held = np.arange(2000) // rows * rows
    tau = 5.0 * log_of().q
    tau[:, 1] = tau[held, 1]
    found = one(check_torque_channels(log_of(tau=tau)), "repeated_torque")
    own = (np.arange(2000) - held)[: 2000 // rows * rows]  # rows since each was new
    late = own.mean() * 0.01
    assert found.where == "run.csv: b"
    assert Figures(found) == {"rows": rows, "delay": pytest.approx(late)}
    told = f"is constant for {rows} rows: it is updated at {100 / rows:.3g} Hz and logged at 100 Hz"
    assert told in found.message
    assert f"mean delay of {1e3 * late:.2g} ms" in found.message
    assert f"torque_delay = {late:.4f} (--torque-delay {late:.4f})" in found.message
    assert f"a cutoff below {25 / rows:.2g} Hz" in found.message


def test_a_torque_is_clipped_at_either_limit_and_held_by_groups():
    t = 3.0 + np.arange(2000) / 100
    q = np.column_stack([np.sin(2 * t), np.cos(t), np.sin(t), np.cos(3 * t)])
    tau = 5.0 * q
    tau[:, 0] = np.clip(tau[:, 0], -4.0, 3.0)
    k = np.arange(2000)
    tau[:, 1], tau[:, 2], tau[:, 3] = tau[k // 4 * 4, 1], tau[k // 7 * 7, 2], tau[k // 4 * 4, 3]
    log = replace(log_of(), joints=tuple("abcd"), q=q, tau=tau)
    found = list(check_torque_channels(log))
    clipped = [f for f in found if f.code == "clipped" and f.where == "run.csv: a"]
    for finding, limit in zip(clipped, (3.0, -4.0), strict=True):
        share = np.mean(tau[:-1, 0] == limit) * 1999 / 2000
        assert Figures(finding) == pytest.approx({"limit": limit, "share": share})
        assert f"at its limit {limit:g} in {100 * share:.3g} % of the rows" in finding.message
    repeated = {f.where: Figures(f) for f in found if f.code == "repeated_torque"}
    assert repeated == {
        "run.csv: b, d": pytest.approx({"rows": 4.0, "delay": 0.015}),
        "run.csv: c": pytest.approx({"rows": 7.0, "delay": 0.03}),
    }
