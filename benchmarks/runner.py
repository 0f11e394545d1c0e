"""Run benchmarks: each case in a process of its own, one record per case. A benchmark is a module of this package with

    a docstring                        title and full stop; then what is measured
    cases(quick)                       settings of every case: flat dicts of plain values; the process of one with a
                                       "budget" (s) ends then
    measure(folder, **settings)        metrics of a case; `folder` holds simulated data that other cases of the run read
    COLUMNS                            heading: format string over settings and metrics, such as "{l2:.2%}"

and, where needed, `derive(rows)` (adds values computed from several rows, such as ratios), `notes(rows)` (text below
the table), `blocks(rows)` (blocks of Markdown, and figures, instead of the table). Cases that differ only in "seed"
share a row of medians.
"""

from __future__ import annotations

import datetime
import importlib
import json
import math
import multiprocessing
import os
import platform
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from nerif import __version__
from nerif.common.conventions import InputError
from nerif.common.files import atomic
from nerif.plotting.drawing import style
from nerif.reconstruction.device import keep_freed_memory

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
N_AMBIENT = 1.00027
NAMES = (
    "study", "methods", "one_camera", "absorption", "displacement", "calibration", "rigs", "images", "trust",
    "sequence", "voxel_cost", "full_size", "verdicts", "goals", "frame_offsets", "detail",
    "bodies", "velocity", "paper_preset", "vectors", "media", "windows", "gpu",
)  # fmt: skip
PAGE_SECONDS = 180.0  # between two versions of a page during a run
PRELOADED = [
    *("nerif.analysis.evaluation", "nerif.simulation.simulate"),
    *(f"nerif.reconstruction.voxels.{name}" for name in ("landweber", "tikhonov", "total_variation")),
    *("nerif.reconstruction.neural.neural", "nerif.reconstruction.voxels.kernels_numba"),
    *("xarray", "h5netcdf", "dask.array", "skimage.metrics"),
    # every optimiser imports it; with CUDA, what its import learns of the GPU must not be inherited by a process
    *(() if torch.backends.cuda.is_built() else ("torch._dynamo",)),
]
"""Modules that are imported once for all cases: an import takes as long as a short reconstruction."""

Settings = dict[str, Any]
Record = dict[str, Any]
"""settings, metrics (or failed: the reason), and the origin: commit, nerif, torch, machine, date."""


@dataclass(frozen=True)
class Figure:
    """A figure among the blocks of a page.

    Parameters
    ----------
    name : of its file, figures/NAME.svg
    size : width and height, inches
    draw : draws into an empty matplotlib figure
    """

    name: str
    caption: str
    size: tuple[float, float]
    draw: Callable[[Any], None]

    def write(self, folder: Path) -> str:
        """Write the figure, letters as outlines, so that it looks the same everywhere; return it as Markdown."""
        import matplotlib as mpl
        from matplotlib.figure import Figure as Canvas

        path = folder / "figures" / f"{self.name}.svg"
        path.parent.mkdir(exist_ok=True)
        with style(10), mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": self.name}), atomic(path) as part:
            figure = Canvas(figsize=self.size, layout="constrained")
            self.draw(figure)
            figure.savefig(part, format="svg", metadata={"Date": None, "Creator": None, "Title": self.caption})
        return f"![{self.caption}](figures/{path.name})\n\n*{self.caption}*"


class Unavailable(Exception):
    """A case needs a program or data that are not on this machine."""


def benchmark(name: str) -> ModuleType:
    """Return a benchmark by name."""
    if name not in NAMES:
        raise InputError(f"expected one of {', '.join(NAMES)}, got '{name}'", field="name")
    return importlib.import_module(f"benchmarks.{name}")


def peer(module: str, package: str) -> Any:
    """Import another program (`pip install -e '.[benchmarks]'`)."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise Unavailable(f"{package} not installed") from None


def machine() -> str:
    """Return GPU or CPU, threads and PyTorch in one line."""
    if torch.cuda.is_available():
        return f"{torch.cuda.get_device_name()}, torch {torch.__version__}"
    capability = torch.backends.cpu.get_cpu_capability()
    return f"{platform.machine()}, {torch.get_num_threads()} threads, {capability}, torch {torch.__version__}"


def commit(checkout: Path = ROOT) -> str:
    """Return the commit of a checkout, or "unknown" outside of git."""
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--exclude", "*"]
    result = subprocess.run(command, capture_output=True, text=True, encoding="utf-8")
    return result.stdout.strip() or "unknown"


def select(module: ModuleType, quick: bool, only: Sequence[str] = (), changes: Mapping[str, Any] | None = None) -> list:
    """Return the cases of a benchmark of which a setting contains one of the words, with some settings changed."""
    cases = [dict(case) for case in module.cases(quick)]
    for name in changes or {}:
        if name not in cases[0]:
            raise InputError(f"expected one of {', '.join(cases[0])}, got '{name}'", field="set")
    cases = [case | dict(changes or {}) for case in cases]
    if only:
        cases = [case for case in cases if any(word in str(value) for word in only for value in case.values())]
    if not cases:
        raise InputError(f"no setting of a case contains {' or '.join(only)}", field="only")
    return list({json.dumps(case): case for case in cases}.values())


def title(case: Settings) -> str:
    """Return the settings of a case in one line."""
    return ", ".join(
        f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}" for name, value in case.items()
    )


# -- records and rows --------------------------------------------------------------------------------------------------


def read_records(path: Path) -> list[Record]:
    """Return the records of a file of JSON lines, of which there may be none yet."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.is_file() else []


def latest(records: Iterable[Record]) -> list[Record]:
    """Return the last record of each case, in the order in which the cases came first."""
    return list({json.dumps(record["settings"]): record for record in records}.values())


def plain(value: Any) -> Any:
    """Return a value for JSON, in which NaN and infinity are null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if hasattr(value, "item") and not isinstance(value, str):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def number(value: object) -> bool:
    """Whether a value is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def rows_of(records: Iterable[Record]) -> list[dict[str, Any]]:
    """Return settings and metrics in one dict per row: medians over the seeds; of text the first."""
    groups: dict[str, list[Record]] = {}
    for record in latest(records):
        settings = {k: v for k, v in record["settings"].items() if k != "seed"}
        groups.setdefault(json.dumps(settings), []).append(record)
    rows = []
    for key, group in groups.items():
        metrics = [record["metrics"] for record in group if "metrics" in record]
        row = json.loads(key) | {"seeds": len(metrics)}
        if not metrics:
            row["failed"] = group[0]["failed"]
        for name in metrics[0] if metrics else ():
            values = [one[name] for one in metrics if one.get(name) is not None]
            row[name] = statistics.median(values) if values and all(map(number, values)) else (values or [None])[0]
        rows.append(row)
    return rows


def ratios(rows: Sequence[dict[str, Any]], metric: str, group: Sequence[str], **reference: Any) -> None:
    """Add `metric`_ratio to each row: its metric over that of the row of its group with the reference's settings."""
    base = {
        tuple(row.get(name) for name in group): row[metric]
        for row in rows
        if row.get(metric) and all(row.get(name) == value for name, value in reference.items())
    }
    for row in rows:
        divisor = base.get(tuple(row.get(name) for name in group))
        if divisor and row.get(metric) is not None:
            row[f"{metric}_ratio"] = row[metric] / divisor


# -- pages -------------------------------------------------------------------------------------------------------------


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], left: int | None = None) -> str:
    """Return a table in Markdown; columns after the first `left` are aligned to the right."""
    left = len(columns) if left is None else left
    rule = ["---"] * left + ["--:"] * (len(columns) - left)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (columns, rule, *rows))


def literal(text: object) -> str:
    """Return text in one line, as a cell of a table."""
    return " ".join(str(text).split()).replace("|", "\\|")


def cells(columns: Mapping[str, str], row: Mapping[str, Any]) -> list[str]:
    """Return the cells of a row; a dash for a missing value, the first of them with the reason of a failure."""

    def cell(form: str) -> str:
        try:
            return form.format(**row)
        except (KeyError, TypeError, ValueError):
            return "–"

    texts = [cell(form) for form in columns.values()]
    if "failed" in row and "–" in texts:
        texts[texts.index("–")] = literal(row["failed"])
    return texts


def blocks_of(module: ModuleType, records: Sequence[Record]) -> list[str | Figure]:
    """Return the results of a benchmark as blocks of Markdown and figures."""
    rows = rows_of(records)
    if hasattr(module, "derive"):
        module.derive(rows)
    if hasattr(module, "blocks"):
        return list(module.blocks(rows))
    notes = module.notes(rows) if hasattr(module, "notes") else []
    return [table(list(module.COLUMNS), [cells(module.COLUMNS, row) for row in rows]), *notes]


ORIGIN = {"commit": "Commit", "nerif": "nerif", "torch": "PyTorch", "machine": "Machine", "date": "Date"}


def origins(records: Iterable[Record]) -> str:
    """Return a table of where, when and by which commit the records were made."""
    counts: dict[tuple[str, ...], list[str]] = {}
    for record in records:
        made = tuple(str(record.get(key, "–")) for key in ORIGIN)
        counts.setdefault(made, []).append(str(record["settings"].get("key", "")))
    all_cases = len(counts) == 1
    last = [f"all {len(k)}" if all_cases else ", ".join(k) if all(k) else str(len(k)) for k in counts.values()]
    rows = [[*made, text] for made, text in zip(counts, last, strict=True)]
    return table([*ORIGIN.values(), "Cases"], rows)


def write_page(name: str, path: Path, records: Sequence[Record]) -> Path:
    """Write the page of a benchmark, and its figures, from its records."""
    module = benchmark(name)
    head, _, text = (module.__doc__ or "").partition("\n")
    quick = " --quick" if path.stem.endswith("-quick") else ""
    command = f"Command: `python -m benchmarks run {name}{quick}`"
    blocks = [f"# {head.rstrip('.')}", text.strip(), command, *blocks_of(module, records), origins(latest(records))]
    texts = [block.write(path.parent) if isinstance(block, Figure) else block for block in blocks]
    path.write_text("\n\n".join(filter(None, texts)) + "\n", encoding="utf-8")
    return path


# -- running -----------------------------------------------------------------------------------------------------------


def run(
    name: str, cases: Sequence[Settings], path: Path | None, data: Path, resume: bool = False, against: str = ""
) -> list[Record]:
    """Run the cases, append each record to `path` (JSON lines), rewrite the page beside it, and return the records.

    Parameters
    ----------
    data : folder of simulated measurements
    resume : reuse records of the same version of nerif and the same settings
    against : revision whose package runs each case, too, in turns with this one; metrics go to "before"
    """
    records, written = read_records(path) if path else [], time.monotonic()
    reusable = {
        json.dumps(record["settings"]): record
        for record in records
        if resume and record.get("nerif") == __version__ and "metrics" in record
    }
    results: list[Record] = []
    origin = {"commit": commit(), "nerif": __version__, "torch": str(torch.__version__), "machine": machine()}
    with worktree(against) as checkout:
        if checkout:  # Numba compiles once per checkout: not part of the times
            for case in select(benchmark(name), quick=True):
                _elsewhere(name, case, data, checkout)
        try:
            for i, case in enumerate(cases):
                record = reusable.get(json.dumps(case))
                if record is None:
                    start = time.monotonic()
                    record = {"settings": case, **origin, "date": datetime.date.today().isoformat()}
                    record |= in_turns(name, case, data, checkout, i % 2 == 0) if checkout else alone(name, case, data)
                    outcome = record.get("failed") or f"{time.monotonic() - start:.0f} s"
                    print(f"{name} {i + 1}/{len(cases)} {title(case)}: {outcome}", file=sys.stderr, flush=True)
                    records.append(record)
                    if path:
                        append(path, record)
                results.append(record)
                if path and time.monotonic() - written > PAGE_SECONDS:
                    write_page(name, path.with_suffix(".md"), records)
                    written = time.monotonic()
        finally:
            if path and records:
                write_page(name, path.with_suffix(".md"), records)
    return results


def append(path: Path, record: Record) -> None:
    """Append a record to a file of JSON lines."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(plain(record), allow_nan=False) + "\n")


def alone(name: str, case: Settings, data: Path) -> Record:
    """Run a case in a process of its own: its peak memory is its own, and a crash ends only itself."""
    methods = multiprocessing.get_all_start_methods()
    context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
    if "forkserver" in methods:
        context.set_forkserver_preload(PRELOADED)
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(name, case, data, sender))
    process.start()
    sender.close()
    try:
        if not receiver.poll(case.get("budget")):
            return {"failed": f"stopped after its budget of {case['budget']:g} s"}
        record: Record = receiver.recv()
        process.join(10)
    except EOFError:
        record = {"failed": "its process was killed, possibly for lack of memory"}
    finally:
        process.terminate()
        process.join()
    return record


def _work(name: str, case: Settings, data: Path, sender: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sender.send(measured(name, case, data))


def _end_with_parent() -> None:
    """End this process with its parent, also if that is killed: nothing shall compute beside the next run."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def measured(name: str, case: Settings, data: Path) -> Record:
    """Run a case in this process; an error becomes the reason of a failure."""
    keep_freed_memory()
    try:
        return {"metrics": plain(benchmark(name).measure(data, **case))}
    except Unavailable as error:
        return {"failed": str(error), "unavailable": True}
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return {"failed": f"{type(error).__name__}: {error} ({Path(place.filename).name}, line {place.lineno})"}


# -- another revision --------------------------------------------------------------------------------------------------


@contextmanager
def worktree(revision: str) -> Iterator[Path | None]:
    """Check out a revision in a temporary git worktree; None for an empty name."""
    if not revision:
        yield None
        return
    folder = Path(tempfile.mkdtemp()) / "before"
    git = ["git", "-C", str(ROOT), "worktree"]
    result = subprocess.run(
        [*git, "add", "--detach", str(folder), revision], capture_output=True, text=True, encoding="utf-8"
    )
    if result.returncode:
        raise InputError(f"expected a revision of this repository, got '{revision}'", field="against")
    try:
        yield folder
    finally:
        subprocess.run([*git, "remove", "--force", str(folder)], capture_output=True)
        shutil.rmtree(folder.parent, ignore_errors=True)


def in_turns(name: str, case: Settings, data: Path, checkout: Path, before_first: bool) -> Record:
    """Run a case with the package of a checkout and with this one, each in a new interpreter."""
    order = (checkout, ROOT) if before_first else (ROOT, checkout)
    results = {path: _elsewhere(name, case, data, path) for path in order}
    before = {"commit": commit(checkout), **results[checkout]}
    return results[ROOT] | {"before": before}


def _elsewhere(name: str, case: Settings, data: Path, checkout: Path) -> Record:
    command = [sys.executable, "-m", "benchmarks", "case", name, json.dumps(case), "--data", str(data)]
    paths = os.pathsep.join([str(checkout / "src"), *filter(None, [os.environ.get("PYTHONPATH")])])
    result = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": paths}, cwd=ROOT, stdout=subprocess.PIPE, text=True, encoding="utf-8"
    )
    if result.returncode:
        return {"failed": f"its process ended with exit code {result.returncode}"}
    return dict(json.loads(result.stdout.splitlines()[-1]))


def comparison(records: Iterable[Record]) -> list[str]:
    """Return tables of metrics before and now as Markdown: every case, and the median of the ratios."""
    rows: list[list[str]] = []
    by_metric: dict[str, list[float]] = {}
    for record in records:
        before, now = record["before"].get("metrics", {}), record.get("metrics", {})
        for name in (n for n in now if number(now[n]) and number(before.get(n))):
            ratio = now[name] / before[name] if before[name] else math.nan
            by_metric.setdefault(name, []).append(ratio)
            rows.append([title(record["settings"]), name, f"{before[name]:.4g}", f"{now[name]:.4g}", f"{ratio:.3f}"])
        reasons = {"before": record["before"].get("failed"), "now": record.get("failed")}
        rows += [[title(record["settings"]), f"{when}: {why}", "–", "–", "–"] for when, why in reasons.items() if why]
    medians = [[n, f"{statistics.median(values):.3f}", str(len(values))] for n, values in by_metric.items()]
    return [
        table(["case", "metric", "before", "now", "now / before"], rows, 2),
        table(["metric", "median of now / before", "cases"], medians, 1),
    ]
