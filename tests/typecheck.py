"""The type checker that holds shapes and types while testing; an int may stand for a float, as everywhere in Python."""

from __future__ import annotations

import ast
import functools
import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

from beartype import BeartypeConf, beartype

CHECKER = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check a function from its first call on, when what its module imports for type checkers can be imported."""
    checked: list[Callable[..., Any]] = []

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        if not checked:
            _import_for_checkers(sys.modules[function.__module__])
            checked.append(CHECKER(function))
        return checked[0](*arguments, **named)

    return call


@functools.cache
def _import_for_checkers(module: ModuleType) -> None:
    """Import the names below `if TYPE_CHECKING`."""
    for node in ast.parse(inspect.getsource(module)).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(compile(ast.Module(node.body, []), module.__file__ or "", "exec"), vars(module))
