"""A working folder for all tests of a file."""

import pytest


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An empty working folder with a cache of its own."""
    folder = tmp_path_factory.mktemp("folder")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield folder
