"""One version in all places that name it, and a workflow that publishes only what it has checked."""

from __future__ import annotations

import re
import tomllib
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import nerif

ROOT = Path(__file__).parents[1]


def test_citation_and_changelog_name_the_version_and_its_date() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == nerif.__version__
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## (.*)$", changelog, flags=re.MULTILINE)
    assert sections[:2] == ["[Unreleased]", f"[{nerif.__version__}] - {citation['date-released']}"]
    kinds = set(re.findall(r"^### (.*)$", changelog, flags=re.MULTILINE))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def test_the_corpus_has_files_of_the_version() -> None:
    assert (ROOT / "tests" / "corpus" / f"{nerif.__version__}.tar.gz").is_file()


def test_every_core_dependency_is_in_the_table() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    packages = [re.match(r"[\w-]+", requirement)[0] for requirement in project["dependencies"]]  # type: ignore[index]
    table = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8").split("## Extras")[0]
    assert sorted(re.findall(r"^\| ([\w-]+) \| \d", table, flags=re.MULTILINE)) == sorted(packages)


def test_constraints_pin_all_that_is_installed() -> None:
    """The packages that the extra dev asks for, and those that they ask for in turn, as far as they are installed."""
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    pinned = {canonicalize_name(name) for name in re.findall(r"^([\w.-]+)==[\w.]+$", pins, flags=re.MULTILINE)}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = ("sequence", "cluster", "movie", "app", "video", "raw", "dev")
    lists = [project["dependencies"], *(project["optional-dependencies"][extra] for extra in extras)]
    open_, names = [Requirement(text) for texts in lists for text in texts], set[str]()
    while open_:
        requirement = open_.pop()
        name = canonicalize_name(requirement.name)
        key = f"{name} {sorted(requirement.extras)}"
        if key in names or name == "nerif-bost":
            continue
        with suppress(PackageNotFoundError):
            further = [Requirement(text) for text in requires(name) or ()]
            names |= {name, key}
            environments = [{"extra": extra} for extra in ("", *requirement.extras)]
            open_ += [r for r in further if r.marker is None or any(map(r.marker.evaluate, environments))]
    names = {name for name in names if " " not in name}
    assert len(names) > 100
    assert names <= pinned, sorted(names - pinned)


WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


@pytest.mark.skipif(not WORKFLOWS, reason="the sdist has no workflows")
def test_workflows_have_no_secrets_and_publish_only_a_checked_tag() -> None:
    for path in WORKFLOWS:
        text = path.read_text(encoding="utf-8")
        assert "secrets." not in text
        assert yaml.safe_load(text)["permissions"] == {"contents": "read"}
        uses = re.findall(r"uses: (.*)", text)
        assert all(re.fullmatch(r"[\w/-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", use) for use in uses), uses  # tags move
        assert "EXTRA_INDEX" not in text.upper().replace("-", "_")  # any package could come from a second index
    release = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8"))
    publish = release["jobs"]["publish"]
    assert publish["if"] == "github.ref_type == 'tag'"
    assert publish["needs"] == ["build", "install"]
