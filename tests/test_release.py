"""One version in all places that name it, and a workflow that publishes only what it has checked."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

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


WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


@pytest.mark.skipif(not WORKFLOWS, reason="the sdist has no workflows")
def test_workflows_have_no_secrets_and_publish_only_a_checked_tag() -> None:
    for path in WORKFLOWS:
        text = path.read_text(encoding="utf-8")
        assert "secrets." not in text
        assert yaml.safe_load(text)["permissions"] == {"contents": "read"}
        assert all(re.fullmatch(r"[\w/-]+@(v\d+|release/v\d+)", use) for use in re.findall(r"uses: (\S+)", text))
    release = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8"))
    publish = release["jobs"]["publish"]
    assert publish["if"] == "github.ref_type == 'tag'"
    assert publish["needs"] == ["build", "install"]
