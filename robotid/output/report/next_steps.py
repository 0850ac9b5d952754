"""Advice on a result: a few next steps, each with the command or the setting to type."""

from __future__ import annotations

import json
import shlex
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid.base.findings import Cause, grouped, listed, toml_key
from robotid.base.settings import is_number
from robotid.data.units import STILL
from robotid.diagnosis.catalogue import codes_with, step_of
from robotid.diagnosis.catalogue import entries as catalogue_entries
from robotid.diagnosis.residual.misfit import setting_of, with_entries
from robotid.diagnosis.verdict.verdict import GOOD, is_beaten
from robotid.estimation.fitting.fit import pinned_joints
from robotid.identification.result import Identification, TorqueIdentification
from robotid.output.files.exports import formats
from robotid.robot.drive_term import DriveTerm

if TYPE_CHECKING:
    from robotid.diagnosis.verdict.scale_check import PayloadCheck

_NEW = "NEW.csv"
_LOADED = "LOADED.csv"
MOST = 3  # steps
NAMED = 4  # joints that a step names
_APPENDED = ("--validate",)  # flags that add to what was stated before


@dataclass(frozen=True)
class Step:
    """One next step."""

    words: str  # the action, imperative, and its reason
    blocks: tuple[str, ...] = ()  # commands, or lines of the job file; each is copied separately


@dataclass(frozen=True)
class Origin:
    """The source of a result and its folder, for commands."""

    # arguments of ``robotid identify``: a job file, or URDF, logs and flags; none if no command
    # made the result
    source: tuple[str, ...] = ()
    folder: str = ""  # folder of the results; "" if they were not written
    # file that ``robotid replay`` writes, from the report's folder; "" if there is none
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

    def from_source(self, command: str) -> tuple[str, ...]:
        """Return a command with the arguments of the identification; nothing without a source."""
        return (shlex.join(["robotid", command, *self.source]),) if self.source else ()

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
    name, sign, _ = value.partition("=")
    return flag, name if sign else ""


@cache
def _texts() -> Mapping[str, Mapping[str, Any]]:
    return tomllib.loads((Path(__file__).parent / "steps.toml").read_text(encoding="utf-8"))


def _step(
    name: str,
    origin: Origin,
    blocks: Iterable[str] = (),
    values_of: Mapping[str, str] | None = None,
    **words: object,
) -> Step:
    """Return a step of steps.toml: its setting, with the values of joints, then further blocks."""
    text, setting = _texts()[name], tuple[str, ...]()
    if "table" in text:
        values = {"": ""} if values_of is None else values_of
        slots = [
            words | {"joint": joint, "key": toml_key(joint), "value": value}
            for joint, value in values.items()
        ]
        line = "\n".join(text["line"].format(**slot) for slot in slots)
        flags = [flag.format(**slot) for slot in slots for flag in text.get("flags", ())]
        setting = origin.stating(text["table"], line, *flags)
    return Step(text["words"].format(**words), (*setting, *blocks))


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
    """Return three next steps at most: those for errors, those for warnings, uses of the result."""
    if not isinstance(found, TorqueIdentification):
        return _steps_of_motion(found, origin)
    by_step: dict[str, list[Cause]] = {}
    findings = [finding for finding in found.findings if finding.severity != "note"]
    causes = [*grouped(findings, found.model.joints), *_of_verdict(found)]
    causal = {c.code for c in causes if step_of(c.code) in ("terms", "as_found")}
    causal.update(codes_with("names_cause"))
    named = {j for c in causes if c.severity != "note" and c.code in causal for j in c.joints}
    for cause in causes:
        if cause.code in _UNNAMED and named.intersection(cause.joints):
            # the named cause of these joints has a step of its own
            cause = replace(cause, joints=tuple(j for j in cause.joints if j not in named))
            if not cause.joints:
                continue
        # doctor explains all other errors
        step = _OF_VERDICT.get(cause.code) or step_of(cause.code)
        step = step or ("doctor" if cause.severity == "error" else "")
        if cause.severity != "note" and step:
            by_step.setdefault(step, []).append(cause)
    in_order = [name for name in _STEPS if name in by_step]
    urgent = sorted(in_order, key=lambda name: all(c.severity != "error" for c in by_step[name]))
    steps = [_STEPS[name](found, origin, by_step[name]) for name in urgent]
    return _once([*steps, *_uses(found, origin, steps)][:MOST])


def _steps_of_motion(found: Identification, origin: Origin) -> tuple[Step, ...]:
    """Return the uses of a result that predicts positions; of a poor one, what to correct."""
    replay, verdict = _replay(found, origin), found.verdict
    if verdict.status != "poor":
        play = _step("play_commands" if found.has_gains else "play_torques", origin, replay)
        exports = exports_of(found.model.name, origin, has_gains=found.has_gains)
        return (play, *exports) if origin.folder else ()
    again = (origin.again(),) if origin.source else ()
    if errors := verdict.log_errors:
        blocks = (*origin.from_source("doctor"), *again)
        return (_step("wrong_log", origin, blocks, error=errors[0]),)
    poor = [name for name, joint in verdict.joints.items() if joint.status == "poor"]
    causes = grouped([f for f in found.findings if f.severity == "warning"], found.model.joints)
    urgent = sorted(causes, key=lambda cause: not set(poor).intersection(cause.joints))
    last = _step("wrong_position", origin, (*replay, *again), joints=listed(poor, NAMED))
    return (*(Step(f"{sentence_of(cause.messages[0])}.") for cause in urgent[: MOST - 1]), last)


def _once(steps: Sequence[Step]) -> tuple[Step, ...]:
    """Return the steps; a block that several steps have is in the last of them only."""
    unique: list[Step] = []
    for k, step in enumerate(steps):
        later = {block for other in steps[k + 1 :] for block in other.blocks}
        blocks = tuple(block for block in step.blocks if block not in later)
        unique.append(replace(step, blocks=blocks))
    return tuple(unique)


def _of_verdict(found: TorqueIdentification) -> list[Cause]:
    causes, predictions = [], found.predictions
    measured = [(j, m) for metrics in predictions.values() for j, m in metrics.per_joint.items()]
    rescaled = {joint for f in found.findings if f.code == "log_differs" for joint in f.joints}
    settled = rescaled.union(pinned_joints(found.estimator.bounds, found.model))
    beaten = {joint for joint, m in measured if is_beaten(m)} - settled
    poor = {j for j, m in measured if m.relative_error_pct and m.relative_error_pct > GOOD}
    for code, joints in (("beaten", beaten), ("poor_prediction", poor)):
        if named := tuple(joint for joint in found.model.joints if joint in joints):
            causes.append(Cause(code, "warning", named, (), ()))
    if not predictions:
        causes.append(Cause("not_validated", "warning", (), (), ()))
    if not found.is_consistent:
        causes.append(Cause("impossible", "warning", (), (), ()))
    if not found.scale_check.agrees:
        severity = "warning" if found.scale_check.contradicts else "note"
        causes.append(Cause("scale_unchecked", severity, (), (), ()))
    return causes


def _named(causes: Sequence[Cause], default: Sequence[str] = ()) -> str:
    return listed(dict.fromkeys(j for cause in causes for j in cause.joints) or default, NAMED)


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
        stated = [value for flag, value in pairwise(origin.source) if flag == "--gain"]
        gains = [value.partition("=")[0] for value in stated] if payload.contradicts else []
        flags = [x for joint in gains for x in ("--gain", f"{joint}=GAIN")]
        again = (origin.again(*flags),) if origin.source else ()
        return _step(
            "wrong_gains" if gains else "stated_payload", origin,
            (*_payload_gains(found, origin, payload), *again), check=check,
            message=payload.message, action="Correct" if payload.contradicts else "Verify",
        )  # fmt: skip
    if found.scale_check.is_total_determined:
        return _step("known_mass", origin, check=check, masses=masses)
    return _step("known_payload", origin, _payload_gains(found, origin), check=check, masses=masses)


def _payload_gains(
    found: TorqueIdentification, origin: Origin, payload: PayloadCheck | None = None
) -> tuple[str, ...]:
    """Return the command that identifies the gains of currents; nothing without files."""
    loaded, mass, link = _LOADED, "KG", []
    if payload is not None:
        loaded, mass, link = payload.log, f"{payload.known:g}", ["--link", payload.link]
    flags = ("--reference", origin.folder, *link, "--mass", mass, "--gains")
    return origin.using("payload", str(found.model.tree.path), loaded, *flags)


def _gains(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    joints = dict.fromkeys((j for cause in causes for j in cause.joints), "GAIN")
    findings = [f for cause in causes for f in cause.findings if f.code == "current_for_torque"]
    factors = [f"{f.evidence['factor']:.3g} x" for f in findings if "factor" in f.evidence]
    return _step(
        "gains", origin, _payload_gains(found, origin), joints or {"JOINT": "GAIN"},
        joints=listed(joints or ["the joints"], NAMED),
        scales=f" ({listed(factors, NAMED)})" if factors else "",
    )  # fmt: skip


def _locks(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    joints, findings = list(found.model.locked), [f for cause in causes for f in cause.findings]
    if any(finding.evidence.get("range", 0.0) > STILL for finding in findings):
        return _as_found(found, origin, causes)
    logged = [finding for finding in findings if "median" in finding.evidence]
    places = {finding.joints[0]: f"{finding.evidence['median']:.4g}" for finding in logged}
    values = places or dict.fromkeys(joints if len(joints) <= NAMED else ["*"], "POSITION")
    return _step("locks", origin, (), values, joints=listed(places or joints, NAMED))


def _terms(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    codes = {cause.code for cause in causes}
    entries: dict[str, list[str | DriveTerm]] = {}
    couplings: dict[frozenset[str], str] = {}
    lacking = [misfit for misfit in found.misfits if misfit.term.code in codes]
    for misfit in lacking:
        if misfit.term.coupled:
            pair = frozenset((misfit.joint, misfit.term.coupled))
            couplings.setdefault(pair, setting_of(misfit, found))
        elif misfit.entries:
            terms = entries.setdefault(misfit.joint, [])
            terms += [entry for entry in misfit.entries if entry not in terms]
    lines = [with_entries(found, joint, terms) for joint, terms in entries.items()]
    blocks = [*couplings.values(), *(["\n".join(["[drives]", *lines])] if lines else [])]
    what = listed(dict.fromkeys(catalogue_entries()[cause.code]["cause"] for cause in causes))
    name = "terms" if blocks else "effect_without_term"
    if not blocks and any(misfit.term.name == "coulomb" for misfit in lacking):
        name = "plain_friction"
    again = [origin.again()] if origin.job and blocks else []
    return _step(name, origin, (*blocks, *again), joints=_named(causes), what=what)


def _as_found(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    return Step(" ".join(f"{sentence_of(m)}." for cause in causes for m in cause.messages[:1]))


def _watch(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    rows = found.metrics().per_joint
    where, advice = _named(causes, found.model.joints), dict[str, list[str]]()
    named = dict.fromkeys(joint for cause in causes for joint in cause.joints)
    for joint in (joint for joint in named if joint in rows):
        advice.setdefault(found.residual_cause(joint)[1], []).append(joint)
    of = {text: f"{listed(joints)}: " for text, joints in advice.items() if len(advice) > 1}
    why = "".join(f" {of.get(text, '')}{text}." for text in advice if text)
    if not any(joint in rows for joint in found.model.joints):  # no torques were measured
        where = "the base"
        why = " Possible causes: noise of the motion (lower cutoff), an unmeasured force, a delay."
    return _step("watch", origin, _replay(found, origin), joints=where, why=why)


def _plain(name: str, found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    """Return a step of steps.toml with figures of the result and of its findings."""
    findings = [finding for cause in causes for finding in cause.findings]
    joints = {joint for cause in causes for joint in cause.joints}
    links = [joint.child for joint in found.model.tree.movable if joint.name in joints]
    delays = [x.evidence["delay"] for x in findings if "delay" in x.evidence]
    sizes = [(x.where, -x.evidence["size"]) for x in findings if "size" in x.evidence]
    blocks: tuple[str, ...] = ()
    if name in ("unclipped", "richer"):
        blocks = _another_log(origin)
    elif name in ("inspect", "zeros"):
        blocks = (shlex.join(["robotid", "inspect", str(found.model.tree.path)]),)
    return _step(
        name, origin, blocks, joints=_named(causes), links=json.dumps(links, ensure_ascii=False),
        by="".join(f"; of {where} by {size:.3g}" for where, size in sizes),
        count=len(found.determination.undetermined), estimator=found.estimator.name,
        delay=f"{sum(delays) / max(len(delays), 1):.4f}",
    )  # fmt: skip


def _another_log(origin: Origin) -> tuple[str, ...]:
    if not origin.job and origin.source:
        urdf, *others = origin.source
        return (Origin((urdf, _NEW, *others), origin.folder).again(),)
    logs = (origin.again(),) if origin.job else ()
    return (f'[[identification]]\nlog = "{_NEW}"', *logs)


def _doctor(found: TorqueIdentification, origin: Origin, causes: Sequence[Cause]) -> Step:
    return Step(f"{sentence_of(causes[0].messages[0])}.", origin.from_source("doctor"))


def _uses(found: TorqueIdentification, origin: Origin, asked: Sequence[Step]) -> list[Step]:
    """Return the uses of a result, without commands of other steps; a poor one is only examined."""
    steps = [_step("play", origin, _replay(found, origin))]
    if found.verdict.status != "poor":
        validate = origin.using("validate", f"{origin.folder}/result.json", _NEW)
        steps.append(_step("validate_again", origin, validate))
        if found.has_urdf:
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
_STEPS: Mapping[str, Callable[[TorqueIdentification, Origin, Sequence[Cause]], Step]] = {
    "doctor": _doctor, "scale": _scale, "gains": _gains, "delay": partial(_plain, "delay"),
    "locks": _locks, "zeros": partial(_plain, "zeros"),
    "unclipped": partial(_plain, "unclipped"), "terms": _terms, "as_found": _as_found,
    "validate": partial(_plain, "validate"), "possible": partial(_plain, "possible"),
    "watch": _watch, "pin": partial(_plain, "pin"), "richer": partial(_plain, "richer"),
    "inspect": partial(_plain, "inspect"),
}  # fmt: skip
#: Those of causes of a verdict that no finding names.
_OF_VERDICT = {
    "scale_unchecked": "scale", "not_validated": "validate", "impossible": "possible",
    "poor_prediction": "watch", "beaten": "pin",
}  # fmt: skip
#: Codes that state the error of a joint only, not its cause.
_UNNAMED = ("poor_prediction", "unexplained_torque", "constraint_costs")
