"""Errors of invalid input, checked by type and field; their sentences are free to change."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from nerif.common.conventions import InputError


@contextmanager
def refused(field: object) -> Iterator[pytest.ExceptionInfo[InputError]]:
    """Expect an InputError that names this parameter, variable or file."""
    with pytest.raises(InputError) as error:
        yield error
    assert error.value.field == str(field), error.value
