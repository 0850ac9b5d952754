import pytest


@pytest.mark.parametrize("name", "commands faults".split())
def test_all_figures_are_those_that_are_stored(same, name):
    same(name)
