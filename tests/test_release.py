"""One version in all places that name it, and a workflow that publishes only what it has checked."""

from __future__ import annotations

import json
import re
import runpy
import sys
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


def test_citation_and_zenodo_agree_with_the_package() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    zenodo = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert citation["version"] == zenodo["version"] == nerif.__version__
    assert str(citation["date-released"]) == zenodo["publication_date"]
    assert citation["title"] == zenodo["title"] == next(iter(project["scripts"]))
    # the licence of the code; sample data have theirs beside them
    assert citation["license"] == zenodo["license"] == project["license"].split(" AND ")[0]
    names = [author["name"] for author in project["authors"]]
    assert [author["name"] for author in citation["authors"]] == names
    assert [creator["name"] for creator in zenodo["creators"]] == names
    assert citation["keywords"] == zenodo["keywords"]
    assert citation["abstract"].rstrip(".") in zenodo["description"]
    assert citation["preferred-citation"]["doi"] == zenodo["related_identifiers"][0]["identifier"]


PAPER = ROOT / "paper"
SECTIONS = """Summary, Statement of need, State of the field, Software design, Research impact statement,
AI usage disclosure, Acknowledgements, References"""


def test_the_paper_has_the_form_of_joss() -> None:
    """Words: within the journal's former limits, 250 to 1000, and its present ones, 750 to 1750."""
    _, head, body = (PAPER / "paper.md").read_text(encoding="utf-8").split("---\n", 2)
    metadata = yaml.safe_load(head)
    assert metadata["bibliography"] == "paper.bib"
    assert {"title", "tags", "authors", "affiliations", "date"} <= set(metadata)
    indices = {affiliation["index"] for affiliation in metadata["affiliations"]}
    assert {author["affiliation"] for author in metadata["authors"]} <= indices
    assert re.fullmatch(r"\d{1,2} [A-Z][a-z]+ 20\d\d", metadata["date"])
    assert re.findall(r"^# (.*)$", body, flags=re.MULTILINE) == re.split(r",\s", SECTIONS)
    assert 750 <= sum(any(map(str.isalnum, word)) for word in body.split()) <= 1000

    bibliography = (PAPER / "paper.bib").read_text(encoding="utf-8")
    keys = re.findall(r"^@\w+\{(\w+),$", bibliography, flags=re.MULTILINE)
    assert len(keys) == len(set(keys)) == bibliography.count("\n@") + bibliography.startswith("@")
    assert set(re.findall(r"(?<![\w.])@(\w+)", body)) == set(keys)

    labels = re.findall(r"\\label\{(\w+)\}", body)
    assert set(re.findall(r"\\autoref\{(\w+)\}", body)) == set(labels)
    [figure] = re.findall(r"^!\[[^\]]*\]\((\S+)\)$", body, flags=re.MULTILINE)
    assert 10_000 < (PAPER / figure).stat().st_size < 300_000


@pytest.mark.slow
def test_the_figure_of_the_paper_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "figure.png"
    monkeypatch.setattr(sys, "argv", ["figure.py", str(out), "16", "10", "12"])
    runpy.run_path(str(PAPER / "figure.py"), run_name="__main__")
    assert out.read_bytes().startswith(b"\x89PNG")


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
