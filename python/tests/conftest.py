"""Shared by the tests: where the texts are, and the command to compare with."""

import os
import shutil
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def root():
    return ROOT


@pytest.fixture(scope="session")
def command():
    """The command, as the wheel or a build has put it on the path."""
    found = os.environ.get("FRIC_COMMAND") or shutil.which("fric")
    assert found, "the command `fric` is not on the path: .ci/python installs it with the wheel"
    return found


@pytest.fixture
def seed():
    return int(os.environ.get("FRIC_SEED", "1"))
