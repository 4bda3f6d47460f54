"""One browser for all tests of a worker; each test has its own cookies and pages."""

from collections.abc import Iterator

import pytest

from tests.web.phone import Phone, phone


@pytest.fixture(scope="session")
def shared_browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Phone]:
    with phone(tmp_path_factory.mktemp("browser")) as one:
        yield one


@pytest.fixture
def browser(shared_browser: Phone) -> Iterator[Phone]:
    with shared_browser.separate():
        yield shared_browser
