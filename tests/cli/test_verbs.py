"""The public functions take job files, files and what was found, as the commands do."""

import numpy as np
import pytest

import robotid
from robotid.base.exceptions import SettingsError


def test_a_job_file_and_its_settings_in_python_find_the_same(arm, arm_logs, tmp_path):
    urdf, log, job = arm.tree.path, arm_logs / "fit.csv", tmp_path / "job.toml"
    job.write_text(
        f'urdf = "{urdf}"\n[model]\nfriction = "viscous+coulomb"\n'
        f'[[identification]]\nlog = "{log}"\n'
    )
    found = robotid.identify(job)
    same = robotid.identify(urdf, log, friction="viscous+coulomb")
    np.testing.assert_allclose(same.base, found.base, rtol=1e-9)
    assert same.verdict.status == found.verdict.status
    codes = [[f.code for f in robotid.doctor(*given)] for given in ((job,), (urdf, log))]
    assert codes[0] == codes[1]
    for given, options, words in (
        (job, {"signals": robotid.SignalSettings()}, "state validation, signals, controller"),
        (job, {"validation": log}, "state validation"),
        (urdf, {}, "no log is given"),
    ):
        with pytest.raises(SettingsError, match=words):
            robotid.identify(given, **options)


def test_a_result_is_exported_from_memory_as_from_its_folder(arm, arm_logs, tmp_path):
    found = robotid.identify(arm, arm_logs / "fit.csv", friction="viscous+coulomb")
    robotid.save_result(found, tmp_path / "out", report=False)
    robotid.export(tmp_path / "out", "sdf", tmp_path / "a.sdf")
    robotid.export(found, "sdf", tmp_path / "b.sdf")
    texts = [(tmp_path / name).read_text() for name in ("a.sdf", "b.sdf")]
    assert texts[0] == texts[1]
    verdict = robotid.validate(tmp_path / "out", [arm_logs / "keep.csv"])["verdict"]
    assert verdict["status"] in ("good", "usable")
    compared = robotid.compare([tmp_path / "out"] * 2, tmp_path / "page.html")
    assert not any(x["differences"][-1] for x in compared["base_parameters"])
    assert (tmp_path / "page.html").is_file()
