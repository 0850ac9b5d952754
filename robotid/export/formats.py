"""The formats that a result is written in: each is a module of this room, and its entry here."""

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["DELAYS", "FORMATS", "Format", "Option", "options_of"]


@dataclass(frozen=True)
class Option:
    """What may be stated of how a format is written.

    Attributes:
        words: What it is, with its default.
        metavar: What stands for its value in the help.
        kind: Type of its value.
        among: The words that it may be; any if there are none.
    """

    words: str
    metavar: str
    kind: type[float | str] = str
    among: tuple[str, ...] = ()


@dataclass(frozen=True)
class Format:
    """A format. Its module, ``robotid.export.<name>``, writes it by ``export``.

    Attributes:
        words: What is written.
        suffix: What follows the robot's name in the name of a file of it.
        use: What it is advised for, of any result; "" if it is not.
        use_of_gains: The same of a result that has gains of drives.
        options: Its options, by name.
    """

    words: str
    suffix: str
    use: str = ""
    use_of_gains: str = ""
    options: Mapping[str, Option] = field(default_factory=dict)


#: How the delay of a command may be stated in MJCF.
DELAYS = ("history", "filter")
#: The formats by name.
FORMATS: dict[str, Format] = {
    "urdf": Format("URDF with <dynamics>, and its sidecar", ".urdf"),
    "mjcf": Format(
        "model of MuJoCo",
        ".xml",
        use="Use it: the identified URDF is written; this makes a model for MuJoCo of it.",
        use_of_gains="Simulate it in MuJoCo, gains and delays included.",
        options={
            "step": Option("time step [s], default 0.001", "S", float),
            "delay": Option("how commands are delayed, default history, which needs MuJoCo 3.5",
                            "HOW", among=DELAYS),
        },
    ),
    "sdf": Format("SDF 1.9, for Gazebo and Drake", ".sdf"),
    "isaac": Format(
        "YAML of Isaac Lab's actuators",
        "_actuators.yaml",
        use_of_gains="Train with it in Isaac Lab.",
        options={"step": Option("time step that counts delays [s], default 0.005", "S", float)},
    ),
    "ranges": Format(
        "YAML of 95 % intervals, for domain randomisation",
        "_ranges.yaml",
        use_of_gains="Draw its drives at random, within their intervals.",
    ),
}  # fmt: skip


def options_of(formats: Mapping[str, Format]) -> dict[str, dict[str, Option]]:
    """Return the options of formats, by name: which formats have it, each with its words.

    Args:
        formats: The formats by name.
    """
    found: dict[str, dict[str, Option]] = {}
    for kind, form in formats.items():
        for name, option in form.options.items():
            found.setdefault(name, {})[kind] = option
    return found
