"""The JSON schema of job files accepts what a job reads, and refuses what it refuses."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest
from helpers.paths import ROOT

from robotid.base.exceptions import SettingsError
from robotid.cli.job import job_from_settings
from robotid.cli.schema import job_schema

JOBS = sorted((ROOT / "tests/jobs").rglob("*.toml"))
LOG = {"log": "run.csv"}


@pytest.fixture(scope="module")
def check():
    schema = job_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema).validate


@pytest.mark.parametrize(
    "wrong",
    [
        {"joint": ["a"]},
        {"joints": "a"},
        {"gravity": [0.0, -9.81]},
        {"gravity": [0.0, 0.0, -9.81, 0.0]},
        {"locked": {"a": "here"}},
        {"signals": {"velocity": "guessed"}},
        {"signals": {"rate": "fast"}},
        {"estimator": {"name": "magic"}},
        {"estimator": {"prior_weight": "heavy"}},
        {"estimator": {"constraints": {"masses": {}}}},
        {"identification": [{"start": 1.0}]},
        {"validation": LOG},
        {"coupling": [{"name": "motor"}]},
        {"reduction": {"workers": 2.5}},
    ],
    ids=lambda wrong: json.dumps(wrong),
)
def test_what_a_job_refuses_is_invalid(check, wrong):
    job = {"urdf": "robot.urdf", "identification": [LOG]}
    check(job)
    job_from_settings(job, "job.toml", Path())
    with pytest.raises(jsonschema.ValidationError):
        check(job | wrong)
    with pytest.raises(SettingsError):
        job_from_settings(job | wrong, "job.toml", Path())


def test_a_shell_is_told_what_may_follow(tmp_path):
    answers = {}
    for line in ("robotid exc", "robotid export result --format s"):
        asked = {
            "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "COMP_LINE": line,
            "COMP_POINT": str(len(line)), "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "words"),
        }  # fmt: skip
        words = [sys.executable, "-m", "robotid"]
        done = subprocess.run(words, env=os.environ | asked, capture_output=True, timeout=60)
        assert done.returncode == 0
        answers[line] = (tmp_path / "words").read_text().split()
    assert list(answers.values()) == [["excite"], ["sdf"]]
