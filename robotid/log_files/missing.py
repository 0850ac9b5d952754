"""The error of a log that lacks required columns: similar names in it, and what to state."""

from collections.abc import Sequence
from dataclasses import dataclass

from robotid._similar import is_commanded, similar_columns, similar_joints
from robotid.exceptions import DataError
from robotid.findings import listed, quoted, toml_key
from robotid.log_files.table import prefixes, quantity_of
from robotid.logs.settings import LogSource

__all__ = ["NOUNS", "SIZES", "Missing"]

#: Nouns for the columns of each kind.
NOUNS = {
    "q": "position",
    "dq": "velocity",
    "ddq": "acceleration",
    "tau": "torque or current",
    "qref": "commanded position",
    "dqref": "commanded velocity",
    "tauref": "commanded torque",
}
#: Prefixes of absolute values of loads, as bus servos report them.
SIZES = ("loadsize_", "load_size_")
_SHOWN = 12  # names in a list


@dataclass(frozen=True)
class Missing:
    """The required columns that a log lacks.

    Attributes:
        where: Name of the file.
        names: Names of its columns.
        absent: Quantity and joint, or motor, of each column that it lacks.
        places: Joints and motors that are read.
        source: Names of the joints in the file, and the quantity of effort columns.
    """

    where: str
    names: Sequence[str]
    absent: Sequence[tuple[str, str]]
    places: Sequence[str]
    source: LogSource

    def similar(self) -> dict[tuple[str, str], str]:
        """Return columns that may be the missing ones, by quantity and joint."""
        named = [(kind, self._named(place)) for kind, place in self.absent]
        other = self._other_joints()
        free = [x for x in self.names if self._of(x)[1] not in {*self._read_names(), *other}]
        found = similar_columns(named, free, prefixes(self.source.effort))
        own = {self._named(place): place for _, place in self.absent}
        return {(kind, own[name]): column for (kind, name), column in found.items()}

    def error(self, remedy: str) -> DataError:
        """Return the error.

        Args:
            remedy: What to do if no name is similar.
        """
        return DataError(self._of_joints() or self._of_columns(remedy), code="missing_column")

    def _of_joints(self) -> str:
        """Return the message on joints that have other names in the log, "" if none has."""
        logged = dict.fromkeys(self._of(name)[1] for name in self.names)
        absent = dict.fromkeys(x for _, x in self.absent if self._named(x) not in logged)
        others = self._other_joints()
        sought = {self._named(joint): joint for joint in absent}
        found, ordered = similar_joints(list(sought), others)
        pairs = {sought[name]: other for name, other in found.items()}
        by_order = {sought[name] for name in ordered}
        if any(x not in (*absent, *self.source.joints) for x in self.places):
            # others may be of joints that are not read, as locked ones
            pairs = {joint: name for joint, name in pairs.items() if joint not in by_order}
        stated = [joint for joint in absent if joint in self.source.joints]
        if not (pairs or stated):
            return ""
        head = f"{self.where} has no columns of joints {listed(absent)} under the names of the URDF"
        if stated:
            named = ", ".join(f"{x} = {quoted(self._named(x))}" for x in stated)
            head = f"{self.where} has no columns under the names that [log.joints] states: {named}"
        if not pairs:
            return f"{head}; names in the log: {listed(filter(None, logged))}"
        width = max(len(f"{toml_key(joint)} = {quoted(name)}") for joint, name in pairs.items())
        lines = [
            f"{f'{toml_key(joint)} = {quoted(name)}':{width}}"
            f"  # {'by order' if joint in by_order else 'similar name'}"
            for joint, name in pairs.items()
        ]
        without = [joint for joint in absent if joint not in pairs]
        left = [name for name in others if name not in pairs.values()]
        rest = f"\nJoints without a name in the log: {listed(without)}." if without else ""
        rest += f"\nOther names in the log: {listed(left, _SHOWN)}." if left else ""
        joint, name = next(iter(pairs.items()))
        return (
            f"{head}; names in the log: {listed(others)}. State the name of each joint in the job "
            f"file, or with one flag per joint, as --rename {joint}={name}. This table is a guess: "
            "check each line, an exchange of joints gives wrong parameters.\n[log.joints]\n"
            + "\n".join(lines)
            + rest
        )

    def _of_columns(self, remedy: str) -> str:
        """Return the message on missing columns."""
        near = self.similar()
        sought = [f"{kind}_{self._named(place)}" for kind, place in self.absent]
        kinds = dict.fromkeys(kind.removesuffix("m") for kind, _ in self.absent)
        of_kinds = {x for kind, _ in self.absent for x in (kind, kind.replace("tau", "current"))}
        commanded, found, others = list[str](), list[str](), list[str]()
        sizes = [name for name in self.names if name.startswith(SIZES)]
        for name in (x for x in self.names if x not in sizes):
            kind, place = self._of(name)
            if kind in of_kinds and (kind.startswith("qref") or not is_commanded(name)):
                found.append(name)
            elif kind.removesuffix("ref") in kinds:
                commanded.append(name)
            elif name not in near.values() and place not in self._read_names():
                (commanded if is_commanded(name) else others).append(name)
        plural, it = ("s", "them") if len(sought) > 1 else ("", "it")
        text = (
            f"{self.where} has no column{plural} {listed(map(repr, sought), 6)}; "
            f"{' and '.join(NOUNS[kind] for kind in kinds)} columns found: {listed(found, _SHOWN)}."
        )
        others = [name for name in others if name not in ("time", "t")]
        if commanded:
            text += f" Commanded, not measured: {listed(commanded, _SHOWN)}."
        if sizes:
            text += f" Loads without sign, which are no torques: {listed(sizes, _SHOWN)}."
        if others:
            text += f" Other columns: {listed(others, _SHOWN)}."
        stated = {f"{kind}_{place}": column for (kind, place), column in near.items()}
        if len(stated) > 1:
            lines = [f"{toml_key(key)} = {quoted(column)}" for key, column in stated.items()]
            return (
                f"{text} Similar names are in the log. Rename these columns, or check them and "
                "state them in the job file:\n[columns]\n" + "\n".join(lines)
            )
        read = self._read_names()
        if not stated and not others and all(self._of(name)[1] in read for name in found):
            return f"{text} {remedy}"  # every column has its meaning: there is none to rename
        hint = "".join(f"Did you mean {column!r}? " for column in stated.values())
        ((key, column),) = stated.items() or [("_".join(self.absent[0]), "NAME")]
        inside = f"{{ {toml_key(key)} = {quoted(column)} }}"
        end = "" if stated else f". {remedy}"
        return f"{text} {hint}Rename {it}, or state {it} in the job file: columns = {inside}{end}"

    def _named(self, place: str) -> str:
        """Return the name of a joint or motor in the file."""
        return self.source.joints.get(place, place)

    def _read_names(self) -> set[str]:
        return {self._named(place) for place in self.places}

    def _of(self, name: str) -> tuple[str, str]:
        """Return quantity and joint of a column, "" without a standard name."""
        return quantity_of(name, self.source.effort) or ("", "")

    def _other_joints(self) -> list[str]:
        """Return the names of other joints in the log.

        A single column, as q_elbw, is a misspelt one if the log has columns of joints as named.
        """
        kinds, least = dict[str, set[str]](), 1
        for name in self.names:
            kind, joint = self._of(name)
            if joint in self._read_names():
                least = 2
            elif joint and not joint.endswith(("]", ")")):  # no unit
                kinds.setdefault(joint, set()).add(kind)
        first = {"q", *(kind for kind, _ in self.absent if kind == "qm")}
        return [joint for joint, of in kinds.items() if of & first and len(of) >= least]
