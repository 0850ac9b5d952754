"""Whatever is in a file or a setting: robotid says what is wrong, and never how it broke."""

import tempfile
from pathlib import Path

import pytest
from helpers.hostile_commands import COMMAND_KINDS
from helpers.hostile_inputs import KINDS as INPUT_KINDS
from hypothesis import HealthCheck, Phase, given, settings

KINDS = INPUT_KINDS | COMMAND_KINDS
EXAMPLES = {
    "values, identified": 4,
    "excite": 6,
    "loop of a job": 3,
    "result.json": 15,
}  # others: 8


@pytest.mark.filterwarnings("ignore:Generating overly large repr")  # a whole result.json
@pytest.mark.parametrize("kind", KINDS)
def test_no_input_gives_a_traceback(kind):
    strategy, run = KINDS[kind]

    @settings(
        max_examples=EXAMPLES.get(kind, 8), derandomize=True, database=None, deadline=None,
        phases=[Phase.generate], suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(strategy)
    def try_one(example):
        with tempfile.TemporaryDirectory() as folder:
            run(example, Path(folder))

    try_one()
