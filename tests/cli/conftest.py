"""The script is called in this process, whose devices are fixed by now, and whose signals are not the script's."""

from unittest import mock

import pytest

from hybrid_jax.cli import main


@pytest.fixture(scope="session", autouse=True)
def devices():
    with mock.patch("hybrid_jax.cli.command.configure"), mock.patch("hybrid_jax.cli.command._answer_at_once"):
        yield


@pytest.fixture
def called(capsys):
    """The exit code, stdout and stderr of a command line."""

    def call(*arguments):
        with pytest.raises(SystemExit) as stop:
            main([*map(str, arguments)])
        return (stop.value.code or 0, *capsys.readouterr())

    return call
