"""What determines the reductions of a job's logs: a checkpoint of anything else is not used."""

from pathlib import Path
from typing import Any

from robotid._files import file_sha256
from robotid.commands.job import Job
from robotid.versions import code_versions

__all__ = ["checkpoint_inputs"]

_NO_MATTER = ("validation", "estimator", "output", "doctor")


def checkpoint_inputs(job: Job) -> dict[str, Any]:
    """Return all that determines what the logs of a job come down to, as plain values.

    A log is told from others by path, size and time of change: hashing it takes as long as reading.

    Args:
        job: The job.

    Returns:
        Settings, versions and files.

    Raises:
        OSError: If a file does not exist.
    """
    settings = {key: value for key, value in job.to_dict().items() if key not in _NO_MATTER}
    settings["reduction"] = {"rows_in_memory": job.rows_in_memory}
    return {
        "versions": code_versions(),
        "settings": settings,
        "urdf_sha256": file_sha256(job.urdf),
        "logs": [_identity(entry.path) for entry in job.identification],
    }


def _identity(path: Path) -> dict[str, Any]:
    """Return size [bytes] and time of change [ns] of a file, or of each file of a folder."""
    whole = path.resolve()
    files = sorted(p for p in whole.rglob("*") if p.is_file()) if whole.is_dir() else [whole]
    found = {}
    for file in files:
        about = file.stat()
        found[str(file)] = {"size": about.st_size, "changed": about.st_mtime_ns}
    return found
