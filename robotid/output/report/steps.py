"""The steps of an advice, and the commands that repeat or use a result."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from robotid.output.files.exports import formats

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
