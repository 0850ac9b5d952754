"""The export formats: each has a module in this package and an entry here."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Option:
    """An option of a format.

    Attributes:
        words: Its description, with its default.
        metavar: Placeholder of its value in the help.
        kind: Type of its value.
        among: Permitted words; any value if empty.
    """

    words: str
    metavar: str
    kind: type[int] | type[float] | type[str] = str
    among: tuple[str, ...] = ()


@dataclass(frozen=True)
class Format:
    """A format. The function ``export`` of its module, ``robotid.output.files.<name>``, writes it.

    Attributes:
        words: Its content.
        suffix: Suffix after the robot's name in the name of its file.
        use: The advice for any result; "" without advice.
        use_of_gains: The advice for a result with gains of drives.
        options: Its options, by name.
    """

    words: str
    suffix: str
    use: str = ""
    use_of_gains: str = ""
    options: Mapping[str, Option] = field(default_factory=dict)


#: Models of the delay of a command in MJCF.
DELAYS = ("history", "filter")
#: The formats by name.
FORMATS: dict[str, Format] = {
    "urdf": Format("URDF with <dynamics>, and its drive parameters file", ".urdf"),
    "mjcf": Format(
        "MuJoCo model",
        ".xml",
        use="Use the result: the identified URDF is written; this command writes a MuJoCo model.",
        use_of_gains="Simulate it in MuJoCo, gains and delays included.",
        options={
            "step": Option("time step [s], default 0.001", "S", float),
            "delay": Option("model of the command delay, default history, which needs MuJoCo 3.5",
                            "HOW", among=DELAYS),
        },
    ),
    "sdf": Format("SDF 1.9, for Gazebo and Drake", ".sdf"),
    "isaac": Format(
        "YAML of Isaac Lab's actuators",
        "_actuators.yaml",
        use_of_gains="Use it for training in Isaac Lab.",
        options={"step": Option("time step, the unit of delays [s], default 0.005", "S", float)},
    ),
    "ranges": Format(
        "YAML of 95 % intervals, for domain randomisation",
        "_ranges.yaml",
        use_of_gains="Randomise the drives within their intervals.",
        options={
            "samples": Option("also FILE.samples.json with N samples of the joint distribution",
                              "N", int),
            "seed": Option("seed of these samples, default 0", "K", int),
        },
    ),
}  # fmt: skip


def options_of(formats: Mapping[str, Format]) -> dict[str, dict[str, Option]]:
    """Return the options of formats, by name: the formats that have it, with its description."""
    found: dict[str, dict[str, Option]] = {}
    for kind, form in formats.items():
        for name, option in form.options.items():
            found.setdefault(name, {})[kind] = option
    return found
