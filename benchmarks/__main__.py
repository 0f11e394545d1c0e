"""python -m benchmarks run NAME... [--quick] [--write] [--against REV] | list | page NAME | case NAME SETTINGS."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks import runner
from nerif.common.conventions import InputError


def parser() -> argparse.ArgumentParser:
    """Return the options."""
    options = argparse.ArgumentParser(prog="python -m benchmarks", description="Benchmarks of nerif.")
    commands = options.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="run benchmarks and print their tables")
    run.add_argument("names", nargs="+", metavar="NAME", help=", ".join(runner.NAMES))
    run.add_argument("--only", nargs="+", default=[], metavar="WORD", help="cases of which a setting contains a word")
    run.add_argument(
        "--set", nargs="+", default=[], metavar="NAME=VALUE", help="settings of all cases, e.g. device=cuda"
    )
    run.add_argument(
        "--resume", action="store_true", help="keep records of this version of nerif and the same settings"
    )
    run.add_argument("--against", default="", metavar="REV", help="run the package of this git revision too, in turns")
    run.add_argument("--data", type=Path, help="folder of simulated data, to keep it; default: a temporary one")
    page = commands.add_parser("page", help="write the page of a benchmark from its records")
    page.add_argument("names", nargs="+", metavar="NAME")
    for command in (run, page):
        command.add_argument("--quick", action="store_true", help="small cases, under a minute; NAME-quick")
        command.add_argument("--out", type=Path, help="folder of records and page; default of page: benchmarks/results")
    run.add_argument("--write", action="store_true", help="short for --out benchmarks/results")
    commands.add_parser("list", help="list the benchmarks")
    case = commands.add_parser("case", help="run one case and print its record as JSON")
    case.add_argument("name")
    case.add_argument("settings", type=json.loads)
    case.add_argument("--data", type=Path, required=True)
    return options


def value(text: str) -> tuple[str, Any]:
    """Return name and value of NAME=VALUE; the value as JSON where it is."""
    name, _, word = text.partition("=")
    try:
        return name, json.loads(word)
    except ValueError:
        return name, word


def run(name: str, options: argparse.Namespace, data: Path) -> bool:
    """Run one benchmark, print its results, and return whether every case succeeded."""
    module = runner.benchmark(name)
    cases = runner.select(module, options.quick, options.only, dict(map(value, options.set)))
    out = runner.RESULTS if options.write else options.out
    path = out / f"{name}{'-quick' * options.quick}.jsonl" if out else None
    if out and out.is_file():
        raise InputError(f"expected a folder, got the file {out}", field="out")
    records = runner.run(name, cases, path, data, options.resume, options.against)
    blocks = runner.comparison(records) if options.against else runner.blocks_of(module, records)
    print("\n\n".join(block for block in blocks if isinstance(block, str)), flush=True)
    if path:
        print(f"\n{path.with_suffix('.md')}")
    return not any("failed" in record and "unavailable" not in record for record in records)


def main(arguments: list[str] | None = None) -> int:
    """Return 0 for success, 1 if a case failed, 2 for invalid input, 130 for Ctrl-C."""
    options = parser().parse_args(arguments)
    try:
        if options.command == "list":
            for name in runner.NAMES:
                print(f"{name:14}{(runner.benchmark(name).__doc__ or '').splitlines()[0]}")
        elif options.command == "case":
            print(json.dumps(runner.measured(options.name, options.settings, options.data)))
        elif options.command == "page":
            for name in options.names:
                path = (options.out or runner.RESULTS) / f"{name}{'-quick' * options.quick}.md"
                records = runner.read_records(path.with_suffix(".jsonl"))
                if not records:
                    raise InputError(
                        f"no records in {path.with_suffix('.jsonl')}; run it with --write or --out", field=name
                    )
                print(runner.write_page(name, path, records))
        else:
            with tempfile.TemporaryDirectory() as temporary:
                data = options.data or Path(temporary)
                data.mkdir(parents=True, exist_ok=True)
                return int(not min([run(name, options, data.resolve()) for name in options.names]))
    except InputError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command with --resume continues", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
