"""The section that says why: its sentences, its tables, and its charts in the browser."""

import re
from html import unescape

import numpy as np
import pytest
from helpers.pages import number, percent, tables

from robotid.diagnosis.residual.torque_split import joint_torques
from robotid.output.report.report_content import why_section


@pytest.fixture(scope="module")
def section(identified):
    return why_section(identified)


@pytest.fixture(scope="module")
def torques(identified):
    return {torque.joint: torque for torque in joint_torques(identified)}


def test_joints_stand_worst_first_with_their_sentence_and_the_worst_is_open(section, torques):
    folds = re.findall(r'<details id="why-(\d+)"( open)?><summary>(.*?)</summary>', section)
    assert [bool(opened) for _, opened, _ in folds] == [True] + [False] * 5
    said = [unescape(re.sub("<.*?>", "", summary)) for *_, summary in folds]
    joints = [text.partition(":")[0] for text in said]
    shares = [torques[j].rms["residual"] / torques[j].rms["measured"] for j in joints]
    assert shares == sorted(shares, reverse=True)
    assert sorted(joints) == sorted(torques)
    assert said == [f"{joint}: {torques[joint].sentence}" for joint in joints]
    names = list(torques)
    assert [names[int(row)] for row, *_ in folds] == joints


def test_the_tables_hold_the_root_mean_squares(section, identified):
    kept, found = identified.validation[0], tables(section)
    for j, joint in enumerate(identified.model.joints):
        (table,) = (t for caption, t in found.items() if caption.startswith(f"{joint}:"))
        rows, measured = table.by_name(), kept.metrics["estimate"].per_joint[joint]
        assert rows["residual"]["RMS N m"] == number(measured.rmse, ".3g")
        assert rows["residual"]["% of torque"] == percent(measured.relative_error_pct)
        mask, motion = kept.recording.mask[:, j], kept.recording.trajectory
        assert rows["measured"]["RMS N m"] == number(
            np.sqrt(np.mean(motion.tau[mask, j] ** 2)), ".3g"
        )
        theta = dict(zip(identified.model.layout.names, identified.standard, strict=True))
        inertia = theta[f"{joint}.armature"] * np.sqrt(np.mean(motion.a[mask, j] ** 2))
        if "motor inertia" in rows:
            assert rows["motor inertia"]["RMS N m"] == number(inertia, ".3g")
        viscous = theta[f"{joint}.viscous"] * np.sqrt(np.mean(motion.v[mask, j] ** 2))
        assert f"viscous {viscous:.3g}" in rows["friction"]["terms, RMS"]
