"""What to do next: the cause of trouble first, in words and commands that the program takes."""

import shlex
from dataclasses import replace

import pytest

from robotid.cli import _parser
from robotid.findings import Finding
from robotid.identification.advice import Origin, next_steps

JOB = Origin(("my job.toml",), "out")
FLAGS = Origin(("arm.urdf", "first.csv", "--cutoff", "8"), "out")


def told(identified, *findings, **others):
    return replace(identified, findings=findings, **others)


def warning(code, where="elbow_joint", severity="warning", **evidence):
    return Finding(code, severity, where, f"{code} is so; do something", evidence)


def words(steps):
    return [step.words.split()[0] for step in steps]


def test_every_command_is_one_that_the_program_takes(identified):
    codes = ["current_for_torque", "torque_delay", "unexplained_torque", "undetermined"]
    codes += ["zero_mass", "repeated_motion", "spikes"]
    typed = 0
    for origin in (JOB, FLAGS):
        for found in (
            told(identified),
            *(told(identified, warning(code, delay=0.01)) for code in codes),
        ):
            for step in next_steps(found, origin):
                for block in step.blocks:
                    if block.startswith("robotid"):
                        _parser(shlex.split(block)[1:]).parse_args(shlex.split(block)[1:])
                        typed += 1
    assert typed > 30


def test_a_result_without_trouble_is_measured_used_and_played(identified):
    calm = told(identified, validation=identified.validation)
    result = "out/result.json"
    blocks = [block for step in next_steps(calm, JOB) for block in step.blocks]
    assert len(next_steps(calm, JOB)) <= 3
    assert f"robotid export {result} --format mjcf --out ur5.xml" in blocks


def test_an_error_comes_before_a_warning_and_three_steps_are_enough(identified):
    codes = ("undetermined", "current_for_torque", "torque_delay", "unexplained_torque")
    found = told(
        identified,
        *(warning(code, delay=0.01) for code in codes),
        warning("not_known", severity="error"),
    )
    steps = next_steps(found, JOB)
    assert next(step.words for step in steps) == "Not_known is so; do something."
    assert steps[0].blocks == ("robotid doctor 'my job.toml'",)
    assert words(steps)[1:] == ["State", "If"]
    grave = told(
        identified, warning("torque_delay", delay=0.01), warning("spikes", severity="error")
    )
    assert words(next_steps(grave, JOB))[:2] == ["Look", "If"]


@pytest.mark.parametrize(
    ("code", "evidence", "table", "flags"),
    [
        (
            "current_for_torque",
            {},
            "[torque.gains]\nelbow_joint = GAIN",
            "--gain elbow_joint=GAIN",
        ),
        (
            "torque_delay",
            {"delay": 0.0051},
            "[signals]\ntorque_delay = 0.0051",
            "--torque-delay 0.0051",
        ),
    ],
)
def test_a_setting_is_a_line_of_the_job_file_or_a_flag(identified, code, evidence, table, flags):
    found = told(identified, warning(code, **evidence))
    assert next_steps(found, FLAGS)[0].blocks == (
        f"robotid identify arm.urdf first.csv --cutoff 8 {flags} --out out",
    )
    assert next_steps(found, JOB)[0].blocks == (
        table,
        "robotid identify 'my job.toml' --out out",
    )


def test_what_two_steps_ask_to_be_typed_is_typed_last(identified):
    found = told(identified, warning("current_for_torque"), warning("torque_delay", delay=0.01))
    first, second, *_ = next_steps(found, JOB)
    assert first.blocks == ("[torque.gains]\nelbow_joint = GAIN",)
    assert second.blocks[-1] == "robotid identify 'my job.toml' --out out"


def test_without_a_recording_apart_one_is_asked_for(identified):
    step = next_steps(told(identified, validation=()), FLAGS)[0]
    assert step.words.startswith("Record another motion and keep it apart")
    assert step.blocks[0].endswith("--validate NEW.csv --out out")


def test_links_that_the_urdf_describes_better_are_pinned(identified):
    (kept,) = identified.validation
    measured = kept.metrics["estimate"].per_joint
    joint = {
        name: replace(m, baselines={**m.baselines, "urdf_with_drives": 0.1})
        if name == "elbow_joint"
        else replace(m, baselines={**m.baselines, "urdf_with_drives": 99.0})
        for name, m in measured.items()
    }
    metrics = {**kept.metrics, "estimate": replace(kept.metrics["estimate"], per_joint=joint)}
    steps = next_steps(told(identified, validation=(replace(kept, metrics=metrics),)), JOB)
    (step,) = [step for step in steps if step.words.startswith("Leave the links of")]
    assert step.blocks[0] == '[estimator.constraints]\npinned = ["forearm_link"]'


def test_nothing_is_typed_where_nothing_is_known_of_commands(identified):
    found = told(identified, warning("torque_delay", delay=0.005))
    for step in next_steps(found, Origin()):
        assert not any(block.startswith("robotid identify") for block in step.blocks)
    assert Origin().using("replay", "x") == ()


def test_the_source_of_a_command_line_is_what_is_identified():
    from robotid.commands.flags import source_words

    line = "identify --verbose arm.urdf a.csv --out here --gain j=2 --json --validate b.csv"
    wanted = ("arm.urdf", "a.csv", "--gain", "j=2", "--validate", "b.csv")
    assert source_words(line.split()) == wanted
    assert source_words(["identify", "job.toml", "--out=x", "--resume"]) == ("job.toml",)
    assert (Origin(wanted).job, JOB.job) == ("", "my job.toml")
