"""One worker for all readers: importing JAX once is enough."""

import pytest

from tests.fuzz.referee import Referee


@pytest.fixture(scope="session")
def referee(tmp_path_factory):
    with Referee(tmp_path_factory.mktemp("fuzz")) as referee:
        yield referee
