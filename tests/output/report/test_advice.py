"""What to do next: the cause of trouble first, in words and commands that the program takes."""

import shlex
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robotid.base.findings import Finding
from robotid.cli import _parser
from robotid.cli.job import job_from_settings
from robotid.diagnosis.catalogue import codes_with
from robotid.diagnosis.residual.misfit import (
    CANDIDATES,
    Misfit,
    couplings,
    misfit_finding,
    ripples,
    setting_of,
)
from robotid.diagnosis.verdict.verdict import JointVerdict, Verdict
from robotid.estimation.fitting.drive_terms import JointMotion
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.result import TorqueIdentification
from robotid.output.report.next_steps import Origin, Step, _once, next_steps, sentence_of
from robotid.robot.examples import example_urdf

JOB = Origin(("my job.toml",), "out")
FLAGS = Origin(("arm.urdf", "first.csv", "--cutoff", "8"), "out")


def told(identified, *findings, **others):
    return replace(identified, findings=findings, **others)


def warning(code, where="elbow_joint", severity="warning", **evidence):
    joints = tuple(where.rpartition(": ")[2].split(", "))
    return Finding(code, severity, where, f"{code} is so; do something", evidence, joints=joints)


def words(steps):
    return [step.words.split()[0] for step in steps]


def test_every_command_is_one_that_the_program_takes(identified):
    codes = ["current_for_torque", "torque_delay", "unexplained_torque", "undetermined"]
    codes += ["zero_mass", "repeated_motion", "spikes", *NAMED, "locked_position"]
    every = [told(identified), *(told(identified, warning(code, delay=0.01)) for code in codes)]
    steps = [step for found in every for o in (JOB, FLAGS) for step in next_steps(found, o)]
    blocks = [block for step in steps for block in step.blocks]
    for block in {*blocks}:
        if block.startswith("robotid"):
            _parser(shlex.split(block)[1:]).parse_args(shlex.split(block)[1:])
        else:
            read(block)
    assert sum(block.startswith("robotid") for block in blocks) > 30


#: Codes that name what is wrong with a joint, and the first words of their steps.
NAMED = {
    "backlash": "Exclude the samples",
    "clipped": "Record a slower motion",
    "coupling": "Add the missing drive terms",
    "drift": "Drift is so; do something",
    "friction_shape": "Add the missing drive terms",
    "load_friction": "Add the missing drive terms",
    "position_offset": "Correct the position offset",
    "position_periodic": "Add the missing drive terms",
    "spring": "Add the missing drive terms",
}


def read(block):
    """Return the job of a block, as it stands in a file with a robot and a log."""
    for blank in ("GAIN", "POSITION", "KG"):
        block = block.replace(f"= {blank}", "= 1.5")
    table = tomllib.loads(block)
    table.setdefault("identification", [{"log": "a.csv"}])
    return job_from_settings(
        {"urdf": str(example_urdf("ur5_robot.urdf")), **table}, "job", Path.cwd()
    )


def lacking(joint, term, entries=()):
    none = np.zeros(1)
    still = JointMotion(*[none] * 7)
    size = (1.0, 0.1, "N m rms", 0.1)
    return Misfit(joint, term, 0.9, 1e-9, 0.9, *size, none, none, still, entries)


def motion_of(joint, other, rng):
    x = rng.standard_normal((7, 40))
    alone = JointMotion(*x)
    return replace(alone, others={other: alone})


def candidates(joint, other, rng):
    motion = motion_of(joint, other, rng)
    found = ripples(motion, np.ones(40), rng.standard_normal(40))
    return (*CANDIDATES, *couplings(motion), *found)


@pytest.mark.parametrize("joint", ["elbow_joint", 'odd "j".1'])
def test_every_setting_that_is_advised_for_a_term_is_read(identified, joint, rng):
    """Each term that a drive may lack, with each family that it may be given."""
    other, seen = "b c", set()
    for term in candidates(joint, other, rng):
        for entries in ((name,) for name in term.families) if term.families else (term.terms,):
            found = told(identified, misfits=(lacking(joint, term, entries),))
            setting = setting_of(found.misfits[0], found)
            (misfit,) = found.misfits
            finding = misfit_finding(misfit, found, found.on_misfit)
            if not setting:
                assert term.name in ("coulomb", "windup", "drift")
                assert finding.message.endswith(term.advice)
                continue
            job = read(setting)
            assert all(line in finding.message for line in setting.split("\n"))
            if term.coupled:
                (made,) = job.couplings
                assert dict(made.ratios) == {joint: 1.0, other: term.ratio}
            else:
                assert job.drives == {joint: entries}
            seen.add(term.name.split()[0])
    assert seen == {
        "stribeck", "tanh", "power", "cubic", "asymmetric", "load", "harmonics2",
        "harmonics4", "spring", "ripple", "coupling",
    }  # fmt: skip


@pytest.mark.parametrize("code", NAMED)
def test_a_named_cause_has_its_step_and_no_guess_beside_it(identified, code, rng):
    """A joint that is also badly predicted has no guessed spring or gear ripple as cause."""
    joint = "elbow_joint"
    own = [c for c in candidates(joint, "wrist_1_joint", rng) if c.code == code]
    entries = {c.name: c.families[:1] or c.terms for c in own}
    lacks = [lacking(joint, c, entries[c.name]) for c in own[:2]]
    found = told(identified, warning("unexplained_torque"), warning(code), misfits=tuple(lacks))
    steps = next_steps(found, JOB)
    assert not any(_guesses(step, joint) for step in steps)
    assert sum(step.words.startswith(NAMED[code]) for step in steps) == 1
    blocks = [block for step in steps for block in step.blocks]
    if code in ("friction_shape", "spring"):
        (drives,) = [block for block in blocks if block.startswith("[drives]")]
        wanted = {"friction_shape": ("stribeck",), "spring": ("harmonics2", "spring")}
        assert read(drives).drives == {joint: wanted[code]}
    if code == "backlash":  # there is no term for it, and the same logs are not repeated
        assert [step.blocks for step in steps if step.words.startswith(NAMED[code])] == [()]
    if code == "coupling":
        (made,) = read(blocks[0]).couplings
        assert set(dict(made.ratios)) == {joint, "wrist_1_joint"}
    alone = told(identified, warning("unexplained_torque"))
    assert any(_guesses(step, joint) for step in next_steps(alone, JOB))


def test_a_residual_is_examined_for_the_cause_at_each_joint(identified, monkeypatch):
    for other, said in (("Try friction", "elbow_joint: Try friction."), ("Look", "replay. Look.")):
        causes = {"elbow_joint": ("", other)}
        cause_of = lambda _, joint, known=causes: known.get(joint, ("", "Look"))  # noqa: E731
        monkeypatch.setattr(TorqueIdentification, "residual_cause", cause_of)
        found = told(identified, warning("unexplained_torque"))
        (step,) = [x for x in next_steps(found, JOB) if x.words.startswith("Examine the residual")]
        assert said in step.words


def _guesses(step, joint):
    return step.words.startswith("Examine the residual") and joint in step.words


def test_a_flag_that_was_given_is_stated_anew_and_not_twice():
    origin = Origin(
        ("arm.urdf", "a.csv", "--lock", "j6=0", "--lock=j7=1", "--torque-delay", "0.01",
         "--validate", "b.csv"), "out",
    )  # fmt: skip
    again = origin.again("--lock", "j6=0.1824", "--torque-delay", "0.02", "--validate", "NEW.csv")
    assert again == (
        "robotid identify arm.urdf a.csv --lock=j7=1 --validate b.csv --lock j6=0.1824 "
        "--torque-delay 0.02 --validate NEW.csv --out out"
    )
    assert "j7=1" not in origin.again("--lock", "j7=2").replace("j7=2", "")


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
    assert words(steps)[1:] == ["If", "If"]
    assert ["gain" in step.words for step in steps[1:]] == [True, False]
    grave = told(
        identified, warning("torque_delay", delay=0.01), warning("spikes", severity="error")
    )
    assert words(next_steps(grave, JOB))[:2] == ["Examine", "If"]


SETTINGS = {
    "current_for_torque": (
        [{"factor": 31.6}], "[torque.gains]\nelbow_joint = GAIN", "--gain elbow_joint=GAIN",
    ),
    "torque_delay": (
        [{"delay": 0.0041}, {"delay": 0.0061}], "[signals]\ntorque_delay = 0.0051",
        "--torque-delay 0.0051",
    ),
}  # fmt: skip


@pytest.mark.parametrize("code", SETTINGS)
def test_a_setting_is_a_line_of_the_job_file_or_a_flag(identified, code):
    evidence, table, flags = SETTINGS[code]
    found = told(identified, *(warning(code, **figures) for figures in evidence))
    block, *of_payload = next_steps(found, FLAGS)[0].blocks
    assert block == f"robotid identify arm.urdf first.csv --cutoff 8 {flags} --out out"
    assert len(of_payload) == (code == "current_for_torque")
    assert ("another scale (31.6 x)" in next_steps(found, FLAGS)[0].words) == bool(of_payload)
    assert next_steps(found, JOB)[0].blocks == (
        table,
        "robotid identify 'my job.toml' --out out",
        *of_payload,
    )


IN_DOUBT = {*codes_with("verdict"), *codes_with("term"), "payload"}


@pytest.mark.parametrize("code", sorted(IN_DOUBT - {"total_mass"}))
def test_whatever_leaves_a_result_in_doubt_has_a_step(identified, code):
    """Findings whose remedy is no setting are said again in their own words."""
    calm = {step.words for step in next_steps(told(identified), JOB)}
    found = told(identified, warning(code, delay=0.01, size=0.1, mass=1.0))
    own = [step for step in next_steps(found, JOB) if step.words not in calm]
    assert own, code
    if code in ("joint_axis", "torque_sign"):
        assert own[0].words == f"{code.capitalize()} is so; do something."


def test_nothing_is_typed_where_nothing_is_known_of_commands(identified):
    found = told(identified, warning("torque_delay", delay=0.005))
    for step in next_steps(found, Origin()):
        assert not any(block.startswith("robotid identify") for block in step.blocks)
    assert Origin().using("replay", "x") == ()


def test_a_block_of_several_steps_is_in_the_last_of_them_only():
    steps = [Step("a", ("x", "y")), Step("b", ("z",)), Step("c", ("x", "w")), Step("d", ("w",))]
    assert [step.blocks for step in _once(steps)] == [("y",), ("z",), ("x",), ("w",)]


def judged(crane, status, findings=(), log_errors=()):
    """Return the crane with a verdict: the rail is good, the turning joint as stated."""
    found = replace(crane, findings=tuple(findings), log_errors=tuple(log_errors))
    joints = {"rail": JointVerdict("good", ()), "turn": JointVerdict(status, ())}
    vars(found)["verdict"] = Verdict(status, (), joints, tuple(log_errors))
    return found


def test_a_usable_result_of_commands_is_exported(crane):
    replay, *exports = next_steps(judged(crane, "usable"), JOB)
    assert replay.words == "Compare the commanded, measured and simulated robot in the replay."
    assert replay.blocks[0].startswith(f"robotid replay {crane.model.tree.path} ")
    exported = {step.blocks[0].split()[4]: step.blocks[0].split()[6] for step in exports}
    files = {"mjcf": "crane.xml", "isaac": "crane_actuators.yaml", "ranges": "crane_ranges.yaml"}
    assert exported == files
    assert next_steps(judged(crane, "usable"), Origin()) == ()
    driven = judged(replace(crane, loop=LoopSettings(kind="torque")), "usable")
    replay, export = next_steps(driven, JOB)
    assert replay.words == "Compare measured and predicted torque in the replay."
    assert export.words.startswith("Use the result in MuJoCo")


def test_a_poor_result_of_commands_is_corrected_and_not_used(crane):
    findings = [warning("c0", "rail"), warning("c1", "a.csv: turn"), warning("c2", "rail")]
    steps = next_steps(judged(crane, "poor", findings), JOB)
    assert [step.words.split()[0] for step in steps] == ["C1", "C0", "Do"]  # of the poor joint
    assert "position of turn is wrong" in steps[-1].words
    assert [block.split()[1] for step in steps for block in step.blocks] == ["replay", "identify"]
    wrong = judged(crane, "poor", log_errors=["a.csv: turn moves before its command", "x"])
    assert [step.blocks for step in next_steps(wrong, Origin())] == [()]
    (step,) = next_steps(wrong, JOB)
    assert "Correct the logs, then repeat the identification: a.csv: turn moves" in step.words
    assert [block.split()[1] for block in step.blocks] == ["doctor", "identify"]


def test_a_poor_result_of_torques_is_not_exported(identified):
    wrong = told(identified)
    vars(wrong)["verdict"] = replace(identified.verdict, status="poor")
    blocks = [block for step in next_steps(wrong, JOB) for block in step.blocks]
    assert wrong.has_urdf
    assert blocks
    assert not any(block.split()[1] in ("export", "validate") for block in blocks)


def test_the_name_of_a_file_keeps_its_letters():
    messages = ["first_2.csv: a load", "a.csv, b.csv: it", "the torque"]
    assert [sentence_of(x) for x in messages] == [*messages[:2], "The torque"]
