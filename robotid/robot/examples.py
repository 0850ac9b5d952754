"""URDFs of the installed package example-robot-data, by file name."""

from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from robotid.base.exceptions import MissingDependencyError, ModelError
from robotid.base.findings import listed


@cache
def example_urdfs() -> tuple[Path, ...]:
    """Return the paths of every URDF of example-robot-data, sorted."""
    # its wheel contains data without a Python loader, so its record lists the files
    try:
        found = distribution("example-robot-data")
    except PackageNotFoundError as error:
        raise MissingDependencyError(
            "finding example robots", "example-robot-data", "dev"
        ) from error
    files = [file for file in found.files or [] if file.suffix == ".urdf"]
    return tuple(sorted(Path(str(found.locate_file(file))).resolve() for file in files))


def example_urdf(name: str) -> Path:
    """Return the path of one example robot."""
    by_name = {path.name: path for path in reversed(example_urdfs())}
    if name not in by_name:
        raise ModelError(f"example-robot-data has no {name!r}; it has {listed(sorted(by_name))}")
    return by_name[name]
