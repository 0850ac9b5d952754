import pytest
from helpers.figure_runs import SCENARIOS
from helpers.stored import check


@pytest.fixture(scope="session")
def ran(tmp_path_factory):
    """A function that runs a scenario once and returns its documents and what is known of it."""
    done = {}

    def run(name):
        if name not in done:
            done[name] = SCENARIOS[name](tmp_path_factory.mktemp(name))
        return done[name]

    return run


@pytest.fixture(scope="session")
def same(ran):
    """A function that fails if a scenario's figures are not those that are stored."""

    def compare(name):
        check(name, ran(name)[0].documents)

    return compare
