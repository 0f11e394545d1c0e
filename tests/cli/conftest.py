"""Commands that must fail."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from nerif.cli.cli import main


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that must end with exit code 2 and one line on standard error, and return the line."""

    def run(*arguments: object) -> str:
        capsys.readouterr()
        assert main([str(a) for a in arguments]) == 2
        error = capsys.readouterr().err
        assert "Traceback" not in error
        lines = [line for line in error.splitlines(keepends=True) if not line.endswith(" s\n")]  # progress
        assert len(lines) == 1, error
        return lines[0]

    return run
