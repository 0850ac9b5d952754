"""Advice on a result: a few next steps, each with the command or the setting to type."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

from robotid.base.findings import Cause, grouped, listed, toml_key
from robotid.base.settings import is_number
from robotid.diagnosis.catalogue import entries as catalogue_entries
from robotid.diagnosis.catalogue import step_of
from robotid.diagnosis.residual.misfit import setting_of, with_entries
from robotid.diagnosis.verdict.verdict import GOOD, is_beaten
from robotid.identification.result import Identification, TorqueIdentification
from robotid.output.files.exports import formats
from robotid.robot.drive_term import DriveTerm

if TYPE_CHECKING:
    from robotid.diagnosis.verdict.scale_check import PayloadCheck

_NEW = "NEW.csv"
_LOADED = "LOADED.csv"
_PLAIN = "viscous+coulomb"


MOST = 3
NAMED = 4  # joints that a step names
_APPENDED = ("--validate",)  # flags that add to what was stated before


@dataclass(frozen=True)
class Step:
    """One next step.

    Attributes:
        words: The action, imperative, and its reason.
        blocks: Commands, or lines of the job file; each is copied separately.
    """

    words: str
    blocks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Origin:
    """The source of a result and its folder, for commands.

    Attributes:
        source: The arguments of ``robotid identify``: a job file, or URDF, logs and flags; empty
            if no command made the result.
        folder: Folder of the results; "" if they were not written.
        replay: File that ``robotid replay`` writes, from the report's folder; "" if there is none.
    """

    source: tuple[str, ...] = ()
    folder: str = ""
    replay: str = ""

    @property
    def job(self) -> str:
        """The job file; "" if there is none."""
        return self.source[0] if self.source and self.source[0].endswith(".toml") else ""

    def again(self, *flags: str) -> str:
        """Return the command that repeats the identification."""
        out = ["--out", self.folder] if self.folder else []
        return shlex.join(["robotid", "identify", *_without(self.source, flags), *flags, *out])

    def stating(self, table: str, line: str, *flags: str) -> tuple[str, ...]:
        """Return the blocks that repeat the identification with another setting."""
        if flags and self.source and not self.job:
            return (self.again(*flags),)
        return (f"{table}\n{line}", *([self.again()] if self.job else []))

    def using(self, command: str, *words: str) -> tuple[str, ...]:
        """Return a command that reads the results; nothing if they were not written."""
        return (shlex.join(["robotid", command, *words]),) if self.folder else ()


def _without(source: Sequence[str], flags: Sequence[str]) -> list[str]:
    """Return the words of a command without the flags that new flags replace."""
    replaced = {_key(*pair) for pair in pairwise(flags) if pair[0] not in _APPENDED}
    words, remaining = [*source, ""], []
    skip = False
    for word, following in pairwise(words):
        flag, sign, value = word.partition("=")
        has_separate_value = word.startswith("--") and not sign
        if not skip and _key(flag, value if sign else following) not in replaced:
            remaining.append(word)
            continue
        skip = has_separate_value and not skip
    return remaining


def _key(flag: str, value: str) -> tuple[str, str]:
    """Return the key of a flag: its name, and the joint if its value is JOINT=VALUE."""
    name, sign, _ = value.partition("=")
    return flag, name if sign else ""


def exports_of(robot: str, origin: Origin, *, has_gains: bool = False) -> list[Step]:
    """Return the exports of a result to the formats that can use it."""
    steps = []
    for name, form in formats().items():
        if words := form.use_of_gains if has_gains else form.use:
            target = f"{robot or 'robot'}{form.suffix}"
            stated = (f"{origin.folder}/result.json", "--format", name, "--out", target)
            steps.append(Step(words, origin.using("export", *stated)))
    return steps


def sentence_of(message: str) -> str:
    """Return a message as a sentence; the name of a file at its start stays as it is."""
    first = message.partition(" ")[0].rstrip(":,")
    return message if "." in first else f"{message[0].upper()}{message[1:]}"


def next_steps(found: Identification, origin: Origin) -> tuple[Step, ...]:
    """Return the next steps, the most urgent first: three at most.

    Steps for errors come first, then steps for warnings, then uses of the result.
    """
    if not isinstance(found, TorqueIdentification):
        return _steps_of_motion(found, origin)
    asked: dict[str, list[Cause]] = {}
    findings = [finding for finding in found.findings if finding.severity != "note"]
    causes = (*grouped(findings, found.model.joints), *_of_verdict(found))
    named = {j for c in causes if c.severity != "note" and _names_cause(c) for j in c.joints}
    for cause in causes:
        if cause.code in _UNNAMED and named.intersection(cause.joints):
            # the named cause of these joints has a step of its own
            cause = replace(cause, joints=tuple(j for j in cause.joints if j not in named))
            if not cause.joints:
                continue
        step = _step_for(cause)
        if cause.severity != "note" and step:
            asked.setdefault(step, []).append(cause)
    in_order = [name for name in _STEPS if name in asked]
    urgent = sorted(in_order, key=lambda name: all(c.severity != "error" for c in asked[name]))
    steps = [_STEPS[name](found, origin, asked[name]) for name in urgent]
    return _once([*steps, *_uses(found, origin, steps)][:MOST])


def _steps_of_motion(found: Identification, origin: Origin) -> tuple[Step, ...]:
    """Return the uses of a result that predicts positions; of a poor one, what to correct."""
    words = "Compare measured and predicted torque in the replay."
    if found.has_gains:
        words = "Compare the commanded, measured and simulated robot in the replay."
    verdict, replay = found.verdict, Step(words, _replay(found, origin))
    if verdict.status != "poor":
        exports = exports_of(found.model.name, origin, has_gains=found.has_gains)
        return (replay, *exports) if origin.folder else ()
    again = (origin.again(),) if origin.source else ()
    if errors := verdict.log_errors:
        doctor = (shlex.join(["robotid", "doctor", *origin.source]),) if origin.source else ()
        correct = f"Correct the logs, then repeat the identification: {errors[0]}."
        return (Step(correct, (*doctor, *again)),)
    poor = [name for name, joint in verdict.joints.items() if joint.status == "poor"]
    causes = grouped([f for f in found.findings if f.severity == "warning"], found.model.joints)
    urgent = sorted(causes, key=lambda cause: not set(poor).intersection(cause.joints))
    words = (
        f"Do not use the result: the simulated position of {listed(poor, NAMED)} is wrong. Find "
        "out in the replay when, correct gains, limits, encoder zeros or the motion, and repeat "
        "the identification."
    )
    steps = [Step(f"{sentence_of(cause.messages[0])}.") for cause in urgent[: MOST - 1]]
    return (*steps, Step(words, (*replay.blocks, *again)))


def _once(steps: Sequence[Step]) -> tuple[Step, ...]:
    """Return the steps; a block that several steps have is in the last of them only."""
    unique: list[Step] = []
    for k, step in enumerate(steps):
        later = {block for other in steps[k + 1 :] for block in other.blocks}
        blocks = tuple(block for block in step.blocks if block not in later)
        unique.append(replace(step, blocks=blocks))
    return tuple(unique)


_Maker: TypeAlias = "Callable[[TorqueIdentification, Origin, Sequence[Cause]], Step]"


def _of_verdict(found: TorqueIdentification) -> list[Cause]:
    """Return the causes of a verdict that no finding names."""
    causes, predictions = [], found.predictions
    measured = [(j, m) for metrics in predictions.values() for j, m in metrics.per_joint.items()]
    rescaled = {joint for f in found.findings if f.code == "gain_change" for joint in f.joints}
    beaten = {joint for joint, m in measured if is_beaten(m)} - rescaled
    poor = {j for j, m in measured if m.relative_error_pct and m.relative_error_pct > GOOD}
    for code, joints in (("beaten", beaten), ("poor_prediction", poor)):
        if joints:
            named = tuple(joint for joint in found.model.joints if joint in joints)
            causes.append(Cause(code, "warning", named, (), ()))
    if not predictions:
        causes.append(Cause("not_validated", "warning", (), (), ()))
    if not found.is_consistent:
        causes.append(Cause("impossible", "warning", (), (), ()))
    if not found.scale_check.agrees:
        severity = "warning" if found.scale_check.contradicts else "note"
        causes.append(Cause("scale_unchecked", severity, (), (), ()))
    return causes


def _step_for(cause: Cause) -> str:
    """Return the name of the step that removes a cause; empty if there is none."""
    last = "doctor" if cause.severity == "error" else ""  # doctor explains all other errors
    return _OF_VERDICT.get(cause.code) or step_of(cause.code) or last


def _names_cause(cause: Cause) -> bool:
    """Whether a cause names why the error of its joints is large."""
    names_cause = catalogue_entries().get(cause.code, {}).get("names_cause", False)
    return names_cause or step_of(cause.code) in ("terms", "as_found")


def _named(causes: Sequence[Cause], wanted: Sequence[str] = ()) -> str:
    """Return the joints of causes, as part of a sentence."""
    return listed(dict.fromkeys(j for cause in causes for j in cause.joints) or wanted, NAMED)


def _scale(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    before, after, _ = found.scale_check.masses
    check = ""
    if any(cause.code in ("total_mass", "urdf_mismatch") for cause in causes):
        check = "Check the sign, the order and the unit of the torques and the URDF's masses. "
    source = "stated" if is_number(found.estimator.bounds.total_mass) else "identified"
    origin_of = "assumed" if found.scale_check.assumed else "in the URDF"
    masses = f"{after:.4g} kg {source}, {before:.4g} kg {origin_of}"
    if payloads := found.scale_check.payloads:
        payload = next((x for x in payloads if x.contradicts), payloads[0])
        action = "Correct" if payload.contradicts else "Verify"
        words = f"{check}{action} the torque scale: {payload.message}."
        gains = _gain_flags(origin) if payload.contradicts else []
        if gains:
            words += (
                " State the gains that the first command prints in the place of GAIN, and verify "
                "them with another log of a payload: this one determines them."
            )
        flags = [x for joint, _ in gains for x in ("--gain", f"{joint}=GAIN")]
        again = (origin.again(*flags),) if origin.source else ()
        return Step(words, (*_payload_gains(found, payload), *again))
    if found.scale_check.is_total_determined:
        words = (
            f"{check}State the measured mass of the moving links to verify the torque scale: "
            f"{masses}."
        )
        return Step(words, origin.stating("[estimator.constraints]", "total_mass = KG"))
    words = (
        f"{check}Verify the torque scale with a payload of known mass, because torque does not "
        f"determine the total mass ({masses}): record a log with it and state it as below. Its "
        "identified mass may differ by at most 5 %; the torques, masses and inertias are wrong by "
        "the same factor as it. If the torques are motor currents, the last command identifies "
        "their gains."
    )
    line = f'log = "{_LOADED}"\nmass = KG'
    stated = origin.stating("[[payload_check]]", line, "--payload-check", f"{_LOADED}=KG")
    return Step(words, (*stated, *_payload_gains(found)))


def _gain_flags(origin: Origin) -> list[tuple[str, str]]:
    """Return the joint and the value of each gain that a command states."""
    stated = [value for flag, value in pairwise(origin.source) if flag == "--gain"]
    return [(joint, value) for joint, _, value in (text.partition("=") for text in stated)]


def _payload_gains(found: TorqueIdentification, payload: PayloadCheck | None = None) -> list[str]:
    """Return the command that identifies the gains of currents; nothing without files."""
    urdf, log = str(found.model.tree.path), str(found.fitted[0].recording.log.path)
    if not log:
        return []
    loaded, mass, link = _LOADED, "KG", []
    if payload is not None:
        loaded, mass, link = payload.log, f"{payload.known:g}", ["--link", payload.link]
    flags = ("--reference", log, *link, "--mass", mass, "--gains")
    return [shlex.join(["robotid", "payload", urdf, loaded, *flags])]


def _gains(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    joints = list(dict.fromkeys(j for cause in causes for j in cause.joints))
    words = (
        f"If the column is a current, state the gain of {listed(joints or ['the joints'], NAMED)} "
        "in N m per A (N per A for a prismatic joint): the torque is consistent with the URDF only "
        "at another scale. A payload of known mass determines unknown gains: the last command."
    )
    line = "\n".join(f"{toml_key(joint)} = GAIN" for joint in joints or ["JOINT"])
    flags = [x for joint in joints or ["JOINT"] for x in ("--gain", f"{joint}=GAIN")]
    return Step(words, (*origin.stating("[torque.gains]", line, *flags), *_payload_gains(found)))


def _delay(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    delays = [finding.evidence["delay"] for cause in causes for finding in cause.findings]
    delay = f"{sum(delays) / len(delays):.4f}"
    words = (
        f"If the drives filter their torque, state its delay of {delay} s. Unmodelled friction can "
        "cause the same finding."
    )
    line = f"torque_delay = {delay}"
    return Step(words, origin.stating("[signals]", line, "--torque-delay", delay))


def _locks(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    joints = list(found.model.locked)
    places = {
        finding.joints[0]: f"{finding.evidence['median']:.4g}"
        for cause in causes
        for finding in cause.findings
        if "median" in finding.evidence
    }
    asked = places or dict.fromkeys(joints if len(joints) <= NAMED else ["*"], "POSITION")
    words = f"State the true positions of the locked joints {listed(places or joints, NAMED)}."
    flags = [x for joint, place in asked.items() for x in ("--lock", f"{joint}={place}")]
    line = "\n".join(f"{toml_key(joint)} = {place}" for joint, place in asked.items())
    return Step(words, origin.stating("[locked]", line, *flags))


def _validate(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    words = (
        "Record another motion and use it as validation log: the prediction of other motions is "
        "not verified."
    )
    line = f'log = "{_NEW}"'
    return Step(words, origin.stating("[[validation]]", line, "--validate", _NEW))


def _pin(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    joints = {joint for cause in causes for joint in cause.joints}
    links = [joint.child for joint in found.model.tree.movable if joint.name in joints]
    words = (
        f"Keep the URDF's values for the links of {_named(causes)}: with fitted drives, the URDF "
        "predicts the torque of these joints better than the identified links."
    )
    line = f"pinned = {json.dumps(links, ensure_ascii=False)}"
    return Step(words, origin.stating("[estimator.constraints]", line))


def _terms(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    """Return the step that adds missing drive terms to the model."""
    codes = {cause.code for cause in causes}
    entries: dict[str, list[str | DriveTerm]] = {}
    couplings: dict[frozenset[str], str] = {}
    for misfit in found.misfits:
        term = misfit.term
        if term.code in codes and term.coupled:
            couplings.setdefault(frozenset((misfit.joint, term.coupled)), setting_of(misfit, found))
        elif term.code in codes and misfit.entries:
            own = entries.setdefault(misfit.joint, [])
            own += [entry for entry in misfit.entries if entry not in own]
    lines = [with_entries(found, joint, own) for joint, own in entries.items()]
    blocks = [*couplings.values(), *(["\n".join(["[drives]", *lines])] if lines else [])]
    what = listed(dict.fromkeys(catalogue_entries()[cause.code]["cause"] for cause in causes))
    words = f"Add the missing drive terms to the model of {_named(causes)}: {what}."
    if not blocks and any(m.term.name == "coulomb" and m.term.code in codes for m in found.misfits):
        return Step(
            words, origin.stating("[model]", f'friction = "{_PLAIN}"', "--friction", _PLAIN)
        )
    if not blocks:
        words = (
            f"Exclude the samples with an effect that the model has no term for, or record another "
            f"motion: {what} of {_named(causes)}."
        )
    return Step(words, (*blocks, *((origin.again(),) if origin.job and blocks else ())))


def _payload(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    logs = [x for x in found.validation if not x.is_refitted] or list(found.fitted)
    log, urdf = str(logs[0].recording.log.path), str(found.model.tree.path)
    words = (
        "Validate with the payload of the fitted logs: this log has another one. Identify the "
        "payload with robotid payload."
    )
    if all(f.evidence.get("mass", 0.0) < 0 for cause in causes for f in cause.findings):
        # the fitted log carries the payload
        gains = [x for pair in _gain_flags(origin) for x in ("--gain", "=".join(pair))]
        loaded = str(found.fitted[0].recording.log.path)
        return Step(words, origin.using("payload", urdf, loaded, "--reference", log, *gains))
    words_of = (urdf, log, "--reference", f"{origin.folder}/result.json")
    return Step(words, origin.using("payload", *words_of))


def _unclipped(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    words = (
        f"Record a slower motion, or one with less load: the torque of {_named(causes)} is clipped "
        "at its limit."
    )
    return Step(words, _another_log(origin))


def _zeros(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    sizes = [f for cause in causes for f in cause.findings if "size" in f.evidence]
    by = "".join(f"; of {f.where} by {-f.evidence['size']:.3g}" for f in sizes)
    words = (
        f"Correct the position offset of {_named(causes)}, in the log or by the joint's "
        f"origin in the URDF{by}."
    )
    return Step(words, (shlex.join(["robotid", "inspect", str(found.model.tree.path)]),))


def _as_found(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    """Return the messages of the findings, which name a cause and its remedy."""
    return Step(" ".join(f"{sentence_of(m)}." for cause in causes for m in cause.messages[:1]))


def _possible(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    words = (
        f"Identify with the consistent estimator: the result of {found.estimator.name} is not "
        "physically consistent, and no URDF was written."
    )
    flags = ("--estimator", "consistent")
    return Step(words, origin.stating("[estimator]", 'name = "consistent"', *flags))


def _watch(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    rows = found.metrics().per_joint
    where, why = _named(causes, found.model.joints), "a wrong torque channel, a spring, gear ripple"
    if not any(joint in rows for joint in found.model.joints):  # no torques were measured
        where = "the base"
        why = (
            "noise of the motion (lower cutoff), a force that is not measured, a delay between "
            "motion and forces"
        )
    words = (
        f"Examine the residual of {where} in the section Residual analysis and in the replay. "
        f"Possible causes: {why}."
    )
    return Step(words, _replay(found, origin))


def _richer(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    count = len(found.determination.undetermined)
    words = (
        f"Record another motion with higher speeds and wider poses, and add it to the fitted logs: "
        f"the data do not determine {count} base parameters."
    )
    return Step(words, _another_log(origin))


def _another_log(origin: Origin) -> tuple[str, ...]:
    """Return the blocks that repeat the identification with one more log."""
    if not origin.job and origin.source:
        urdf, *others = origin.source
        return (Origin((urdf, _NEW, *others), origin.folder).again(),)
    logs = (origin.again(),) if origin.job else ()
    return (f'[[identification]]\nlog = "{_NEW}"', *logs)


def _inspect(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    words = "Correct the inertials of the URDF that its inspection rejects: they are the prior."
    return Step(words, (shlex.join(["robotid", "inspect", str(found.model.tree.path)]),))


def _doctor(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    words = f"{sentence_of(causes[0].messages[0])}."
    return Step(
        words, (shlex.join(["robotid", "doctor", *origin.source]),) if origin.source else ()
    )


def _uses(found: TorqueIdentification, origin: Origin, asked: Sequence[Step]) -> list[Step]:
    """Return the uses of a result, without commands that other steps have.

    A poor result is only examined.
    """
    result = f"{origin.folder}/result.json"
    is_poor = found.verdict.status == "poor"
    steps = [
        Step("Play a recording and examine the prediction error over time.", _replay(found, origin))
    ]
    if not is_poor:
        validated = Step(
            "Validate the result on another motion, at the speeds of your application.",
            origin.using("validate", result, _NEW),
        )
        steps.append(validated)
    if found.has_urdf and not is_poor:
        steps = [*exports_of(found.model.name, origin), *steps]
    typed = {block for step in asked for block in step.blocks}
    if not found.scale_check.agrees:
        check = _scale(found, origin, ())
        blocks = tuple(b for b in check.blocks if b != origin.again() or b not in typed)
        steps.insert(0, replace(check, blocks=blocks))
    return [step for step in steps if step.blocks and typed.isdisjoint(step.blocks)]


def _replay(found: Identification, origin: Origin) -> tuple[str, ...]:
    log = str((found.validation or found.fitted)[0].log.path)
    return origin.using("replay", str(found.model.tree.path), log, origin.folder)


#: The steps, the most informative first, by the name that the catalogue of findings gives them.
_STEPS: Mapping[str, _Maker] = {
    "doctor": _doctor, "scale": _scale, "gains": _gains, "delay": _delay, "locks": _locks,
    "zeros": _zeros, "payload": _payload, "unclipped": _unclipped, "terms": _terms,
    "as_found": _as_found, "validate": _validate, "possible": _possible, "watch": _watch,
    "pin": _pin, "richer": _richer, "inspect": _inspect,
}  # fmt: skip
#: Those of causes of a verdict that no finding names.
_OF_VERDICT = {
    "scale_unchecked": "scale", "not_validated": "validate", "impossible": "possible",
    "poor_prediction": "watch", "beaten": "pin",
}  # fmt: skip
#: Codes that state the error of a joint only, not its cause.
_UNNAMED = ("poor_prediction", "unexplained_torque", "constraint_costs")
