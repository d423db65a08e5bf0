"""One worker for all readers: importing JAX once is enough."""

import pytest

from tests.fuzz.harness import Harness


@pytest.fixture(scope="session")
def harness(tmp_path_factory):
    with Harness(tmp_path_factory.mktemp("fuzz")) as harness:
        yield harness
