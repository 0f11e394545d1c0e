"""Versions of the documentation beside each other: a folder each, and the list that their pages read.

    python tools/site_versions.py PAGES SITE VERSION

copies a built SITE to PAGES/VERSION (`latest`, or a tag such as v1.0.0) and writes PAGES/versions.json, newest first,
and an index.html that leads to the newest release, before the first one to `latest`.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

INDEX = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>nerif</title>
<meta http-equiv="refresh" content="0; url={0}/"><a href="{0}/">nerif {0}</a></html>
"""
TAG = re.compile(r"v(\d+)\.(\d+)\.(\d+)(?:(a|b|rc)(\d+))?")


def age(tag: str) -> tuple[int, int, int, str, int]:
    """Sorts 1.0.0rc1 before 1.0.0, and 1.9.0 before 1.10.0."""
    match = TAG.fullmatch(tag)
    assert match is not None
    return int(match[1]), int(match[2]), int(match[3]), match[4] or "release", int(match[5] or 0)


def add(pages: Path, site: Path, version: str) -> None:
    if version != "latest" and not TAG.fullmatch(version):
        raise ValueError(f"expected 'latest' or a tag such as v1.0.0, got '{version}'")
    shutil.rmtree(pages / version, ignore_errors=True)
    shutil.copytree(site, pages / version)
    tags = sorted((p.name for p in pages.iterdir() if p.is_dir() and TAG.fullmatch(p.name)), key=age, reverse=True)
    versions = [name for name in ("latest", *tags) if (pages / name).is_dir()]
    (pages / "versions.json").write_text(json.dumps(versions) + "\n", encoding="utf-8")
    releases = [tag for tag in tags if age(tag)[3] == "release"]
    (pages / "index.html").write_text(INDEX.format([*releases, *versions][0]), encoding="utf-8")
    (pages / ".nojekyll").touch()  # folders with an underscore are pages, too


if __name__ == "__main__":
    add(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
