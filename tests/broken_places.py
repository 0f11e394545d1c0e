"""Break fifty places of the package, one at a time, and count those that a test finds.

    python tests/broken_places.py RECORD [--only N ...]

The places are in broken_places.json: a function, a statement of it as `ast.unparse` writes its first line, and what
the statement becomes. They were drawn from all rooms with a fixed seed, without changes that nobody could observe. A
statement is searched by its text, so that it may move to another file.

If the file RECORD does not exist, the suite runs once in a copy of the committed tree whose places leave a mark, also
in processes that a test starts, to record the tests that execute each place; marks of fixtures of wider scope count
for all tests that use them. Then the tests of a place run with the place broken, shortest first, until one fails or
their recorded times reach the limit.
"""

from __future__ import annotations

import argparse
import ast
import itertools
import json
import os
import queue
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
PLACES = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
MARK = "(lambda folder: folder and open(f'{{folder}}/{}', 'wb').close())(__import__('os').environ.get('PLACE_MARKS'))"
JOBS, LIMIT, HANGS = 2, 240.0, "900"  # processes; recorded seconds of the tests of a place; seconds to stop a run after
MARKS, ORDER = os.environ.get("PLACE_MARKS"), os.environ.get("PLACE_TESTS")
TESTS: dict[str, dict[str, Any]] = {}
FIXTURES: dict[str, list[int]] = {}


def statements(node: ast.AST, name: str = "", inside: bool = False) -> Iterator[tuple[str, str, list[ast.stmt], int]]:
    """Yield the statements of all functions: qualified name, first line, and list and index where the statement is."""
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        body = getattr(node, part, ())
        for i, child in enumerate(body if isinstance(body, list) else ()):
            if inside and isinstance(child, ast.stmt):
                yield name, ast.unparse(child).split("\n", 1)[0], body, i
            named = isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            inner = f"{name}.{child.name}".lstrip(".") if named and not inside else name
            yield from statements(child, inner, inside or (named and not isinstance(child, ast.ClassDef)))


def find(tree: Path) -> list[tuple[Path, str] | None]:
    """Return file and function of each place, in a function of its name if there is one; None if it is gone."""
    at: dict[str, list[tuple[Path, str]]] = {place["statement"]: [] for place in PLACES}
    for path in sorted(tree.glob("src/**/*.py")):
        for name, line, _, _ in statements(ast.parse(path.read_text(encoding="utf-8"))):
            at.get(line, []).append((path, name))
    ends = [(place, place["function"].split(".")[-1]) for place in PLACES]
    return [max(at[p["statement"]], key=lambda one, end=end: one[1].endswith(end), default=None) for p, end in ends]


def change(path: Path, name: str, place: dict[str, str], mark: str = "") -> None:
    """Break a place of a file, or put a mark before it."""
    module = ast.parse(path.read_text(encoding="utf-8"))
    body, i = next(at[2:] for at in statements(module) if at[:2] == (name, place["statement"]))
    line = mark or place["becomes"] + "\n    pass" * place["becomes"].endswith(":")
    new: Any = ast.parse(line).body[0]
    if hasattr(new, "body"):
        new.body, new.orelse = body[i].body, body[i].orelse  # type: ignore[attr-defined]
    body[i : i + 1] = [new, body[i]] if mark else [new]
    path.write_text(ast.unparse(module), encoding="utf-8")


# -- as a plugin of pytest ---------------------------------------------------------------------------------------------


def marks() -> list[int]:
    """Return the places executed since the last call by this process and those that it started; remove their marks."""
    os.environ["PLACE_MARKS"] = folder = f"{MARKS}/{os.getpid()}"
    os.makedirs(folder, exist_ok=True)
    names = os.listdir(folder)
    for name in names:
        os.unlink(f"{folder}/{name}")
    return [int(name) for name in names]


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if ORDER:
        order = {test: i for i, test in enumerate(json.loads(Path(ORDER).read_text()))}
        items[:] = sorted((item for item in items if item.nodeid in order), key=lambda item: order[item.nodeid])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: Any) -> Iterator[Any]:
    if not MARKS:
        return (yield)
    marks()
    wide = [f"{d[-1].argname} {d[-1].baseid}" for d in item._fixtureinfo.name2fixturedefs.values() if d]
    before, start, result = item.session.testsfailed, time.perf_counter(), (yield)
    seconds, places = time.perf_counter() - start, marks() + [i for name in wide for i in FIXTURES.get(name, ())]
    if item.session.testsfailed == before:
        TESTS[re.sub(r"@\w+$", "", item.nodeid)] = {"seconds": seconds, "places": places}
    return result


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: Any) -> Iterator[Any]:
    if not MARKS or fixturedef.scope == "function":
        return (yield)
    before, result, name = marks(), (yield), f"{fixturedef.argname} {fixturedef.baseid}"
    FIXTURES[name] = FIXTURES.get(name, []) + before + marks()
    return result


def pytest_sessionfinish() -> None:
    if TESTS:
        Path(f"{MARKS}/{os.getpid()}.json").write_text(json.dumps(TESTS))


# -- as a script -------------------------------------------------------------------------------------------------------


def run(tree: Path, arguments: Sequence[str], **variables: str) -> str:
    """Run pytest in a tree; return the test that failed first, if any, with its error."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", "-p", "broken_places"]
    paths = {"PYTHONPATH": f"{tree / 'src'}{os.pathsep}{ROOT / 'tests'}", "OMP_NUM_THREADS": "1"}
    stopped = ["timeout", HANGS] if "PLACE_TESTS" in variables else []
    with (tree / "log").open("w") as log:
        done = subprocess.run(
            [*stopped, *command, *arguments], cwd=tree, env=os.environ | paths | variables, stdout=log, stderr=log
        )
    failed = re.search("^(?:FAILED|ERROR) (.*)", (tree / "log").read_text(), re.MULTILINE)
    return failed[1] if failed else f"exit code {done.returncode}" * bool(done.returncode)


def record(tree: Path) -> dict[str, Any]:
    """Run the suite in a tree with marks; return seconds and places of each test that passes."""
    for i, (place, at) in enumerate(zip(PLACES, find(tree), strict=True)):
        if at:
            change(*at, place, MARK.format(i))
    with tempfile.TemporaryDirectory() as folder:
        run(tree, ["-n", str(JOBS), "--dist", "loadgroup", "--no-loadscope-reorder"], PLACE_MARKS=folder)
        return {test: of for path in Path(folder).glob("*.json") for test, of in json.loads(path.read_text()).items()}


def outcome(i: int, tests: dict[str, Any], trees: queue.Queue[Path]) -> tuple[str, str]:
    """Break a place; return by which test it was detected, if any, and what to say otherwise."""
    names = sorted(
        (name for name, test in tests.items() if i in test["places"]), key=lambda name: tests[name]["seconds"]
    )
    ends = itertools.accumulate(tests[name]["seconds"] for name in names)
    tried = [name for name, end in zip(names, ends, strict=True) if end < LIMIT or name == names[0]]
    tree, by = trees.get(), ""
    at = find(tree)[i]
    if at and tried:
        source, order = at[0].read_bytes(), tree / "order.json"
        change(*at, PLACES[i])
        order.write_text(json.dumps(tried))
        by = run(tree, ["-x", *sorted({name.split("::")[0] for name in tried})], PLACE_TESTS=str(order))
        at[0].write_bytes(source)
    trees.put(tree)
    missed = f"**missed** by {len(tried)} of {len(names)} tests that execute it" if at else "no longer there"
    return by, missed


def main() -> None:
    """Print the table of places."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("record", type=Path, help="file of the record; read if it exists")
    parser.add_argument("--only", type=int, nargs="+", default=range(len(PLACES)), help="numbers of places")
    options, free, count = parser.parse_args(), queue.Queue(), 0
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(JOBS) as pool:
        archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True).stdout
        for tree in (Path(folder, str(i)) for i in range(JOBS + 1)):
            tree.mkdir()
            subprocess.run(["tar", "-x", "-C", str(tree)], input=archive, check=True)
            free.put(tree)
        if not options.record.exists():
            options.record.write_text(json.dumps(record(free.get())))
        tests = json.loads(options.record.read_text())
        print("| place | in | statement | becomes | detected by |\n|---|---|---|---|---|")
        for i, (by, missed) in zip(
            options.only, pool.map(lambda i: outcome(i, tests, free), options.only), strict=True
        ):
            cells = (f"`{PLACES[i][name]}`" for name in ("function", "statement", "becomes"))
            print(f"| {i} {PLACES[i]['room']}", *cells, f"{by.split(' - ')[0] or missed} |", sep=" | ", flush=True)
            count += bool(by)
    print(f"\n{count} of {len(options.only)} detected")


if __name__ == "__main__":
    main()
