import pytest
from helpers.driven import arm


@pytest.fixture(scope="session")
def plain():
    return arm()
