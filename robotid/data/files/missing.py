"""The error of a log that lacks required columns: what was found, and a table to complete."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from robotid.base.exceptions import DataError
from robotid.base.findings import listed, quoted, toml_key
from robotid.data.files.column_names import by_number, is_commanded, quantity_of
from robotid.data.signal_settings import LogSource

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
        joints: The joints that are read.
        source: Names of the joints in the file, and the quantity of effort columns.
        found: The recognised columns by standard name.
    """

    where: str
    names: Sequence[str]
    absent: Sequence[tuple[str, str]]
    joints: Sequence[str]
    source: LogSource
    found: Mapping[str, str]

    def error(self, remedy: str) -> DataError:
        """Return the error."""
        named = self.source.joints
        sought = [f"{kind}_{named.get(place, place)}" for kind, place in self.absent]
        sizes = [name for name in self.names if name.startswith(SIZES)]
        left = [x for x in self.names if x not in {*self.found.values(), *sizes}]
        references = tuple(f"{kind.removesuffix('ref')}ref_" for kind, _ in self.absent)
        read = [x for key, x in self.found.items() if key.startswith(references)]
        commanded = [x for x in self.names if is_commanded(x) and x in {*left, *read}]
        others = [name for name in left if name not in commanded]
        nouns = dict.fromkeys(NOUNS[kind.removesuffix("m")] for kind, _ in self.absent)
        ends = tuple(kind.replace("tau", t) + "_" for kind, _ in self.absent
                     for t in ("tau", "current"))  # fmt: skip
        of_kind = [column for key, column in self.found.items() if key.startswith(ends)]
        commanded = [name for name in commanded if name not in of_kind]
        text = (
            f"{self.where} has no column{'s' * (len(sought) > 1)} {listed(map(repr, sought), 6)}; "
            f"{' and '.join(nouns)} columns found: {listed(of_kind, _SHOWN)}."
        )
        for label, some in (
            ("Commanded, not measured", commanded),
            ("Loads without sign, which are no torques", sizes),
            ("Other columns", others),
        ):
            text += f" {label}: {listed(some, _SHOWN)}." if some else ""
        by_order = self._by_order(left)
        if not (by_order or others):
            return DataError(f"{text} {remedy}", code="missing_column")
        absent = [key for key in map("_".join, self.absent) if key not in by_order]
        lines = [f"{toml_key(key)} = {quoted(x)}" for key, x in self.found.items()]
        lines += [f"{toml_key(key)} = {quoted(x)}  # by order" for key, x in by_order.items()]
        lines += [f'# {toml_key(key)} = "NAME"' for key in absent]
        if by_order:
            remedy += (
                ". If joints have other names in the log, this table pairs them by order: check "
                "each line, an exchange of joints gives wrong parameters"
            )
        return DataError(
            f"{text} {remedy}. Rename the columns, or state them in the job file:\n[columns]\n"
            + "\n".join(lines),
            code="missing_column",
        )

    def _by_order(self, names: Sequence[str]) -> dict[str, str]:
        """Return the columns of joints with other names by standard name, in their order."""
        read = [(name, quantity_of(name, self.source.effort)) for name in names]
        known = [(name, *found) for name, found in read if found]
        absent = by_number([joint for joint in self.joints if ("q", joint) in self.absent])
        labels = by_number([label for _, kind, label in known if kind == "q"])
        if not absent or len(labels) != len(absent):
            return {}
        joint_of = dict(zip(labels, absent, strict=True))
        return {
            f"{kind}_{joint_of[label]}": name for name, kind, label in known if label in joint_of
        }
