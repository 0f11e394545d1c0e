"""Addresses come from one place, and the packages of other systems have what pyproject.toml states."""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from packaging.requirements import Requirement

import nerif

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
TABLE = {"repository": "https://github.com/Example/nerif", "doi": "10.5281/zenodo.1", "maintainer": "example"}
#: names on conda-forge where they differ from those on PyPI
CONDA = {
    "torch": "pytorch",
    "matplotlib": "matplotlib-base",
    "opencv-contrib-python-headless": "py-opencv",
    "typing-extensions": "typing_extensions",
}


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))


@pytest.fixture
def publication(tools: None) -> ModuleType:
    import publication

    return publication


@pytest.fixture
def published(tmp_path: Path, publication: ModuleType) -> Path:
    """A copy of the files with addresses, after the one edit and the one command."""
    for path in publication.PLACES:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / path, tmp_path / path)
    pyproject = tmp_path / "pyproject.toml"
    text = pyproject.read_text(encoding="utf-8")
    for name, value in TABLE.items():
        text, n = re.subn(rf'^{name} = ".*?"', f'{name} = "{value}"', text, flags=re.MULTILINE)
        assert n == 1
    pyproject.write_text(text, encoding="utf-8")
    publication.write(tmp_path)
    return tmp_path


def test_files_have_the_addresses_of_the_table(publication: ModuleType) -> None:
    assert [line for line in publication.missing() if "differs" in line] == []


def test_one_edit_fills_in_every_place(published: Path, publication: ModuleType) -> None:
    assert publication.missing(published) == []
    urls = tomllib.loads((published / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    assert urls["Repository"] == TABLE["repository"]
    assert urls["Documentation"] == "https://example.github.io/nerif/"
    citation = yaml.safe_load((published / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["repository-code"], citation["doi"]) == (TABLE["repository"], TABLE["doi"])
    recipe = yaml.safe_load((published / "recipe" / "recipe.yaml").read_text(encoding="utf-8"))
    assert recipe["about"]["repository"] == TABLE["repository"]
    assert recipe["extra"]["recipe-maintainers"] == ["example"]
    assert "badge.svg" in (published / "README.md").read_text(encoding="utf-8")
    header = (published / "docs" / "tutorials" / "GALLERY_HEADER.rst").read_text(encoding="utf-8")
    assert header.count("mybinder.org/v2/gh/Example/nerif/HEAD?labpath=docs/tutorials/") == len(
        list((ROOT / "docs" / "tutorials").glob("*.py"))
    )
    before = [(published / path).read_bytes() for path in publication.PLACES]
    publication.write(published)
    assert before == [(published / path).read_bytes() for path in publication.PLACES]


def test_places_without_an_address_are_named(published: Path, publication: ModuleType) -> None:
    pyproject = published / "pyproject.toml"
    pyproject.write_text(pyproject.read_text(encoding="utf-8").replace('doi = "10.5281/zenodo.1"', 'doi = ""'), "utf-8")
    lines = publication.missing(published)
    assert "pyproject.toml: tool.publication.doi is empty" in lines
    assert {"README.md: no doi", "CITATION.cff: no doi", "pyproject.toml: no doi"} <= set(lines)
    assert "README.md: differs from tool.publication; run `python tools/publication.py write`" in lines
    publication.write(published)
    assert "zenodo" not in (published / "README.md").read_text(encoding="utf-8")
    assert "doi: 10.5281" not in (published / "CITATION.cff").read_text(encoding="utf-8")


@pytest.mark.parametrize(("name", "value"), [("repository", "github.com/a/b"), ("doi", "zenodo.1"), ("doi", "10.1/ b")])
def test_an_address_of_another_form_is_refused(publication: ModuleType, name: str, value: str) -> None:
    with pytest.raises(ValueError, match=f"tool.publication.{name}"):
        publication.Addresses(**(TABLE | {name: value}))


@pytest.mark.parametrize("repository", ["", TABLE["repository"]])
def test_the_readme_on_pypi_has_no_relative_links(monkeypatch: pytest.MonkeyPatch, repository: str) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    import setup

    text = setup.readme_on_pypi((ROOT / "README.md").read_text(encoding="utf-8"), repository, "1.2.3")
    links = re.findall(r"\]\(([^)\s]+)\)", text)
    assert links
    assert [link for link in links if not re.match(r"https://|#", link)] == []
    if repository:
        assert f"]({repository}/raw/v1.2.3/docs/report.png)" in text
        assert f"]({repository}/tree/v1.2.3/docs/tutorials)" in text
        assert f"]({repository}/blob/v1.2.3/docs/choosing.md#standard-deviations)" in text
    else:
        assert "![" not in text
        assert "github.com" not in text


def test_the_recipe_has_version_and_dependencies_of_the_package() -> None:
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text(encoding="utf-8"))
    assert recipe["context"]["version"] == nerif.__version__
    requirements = [Requirement(text) for text in PROJECT["project"]["dependencies"]]
    expected = [f"{CONDA.get(r.name, r.name)} {r.specifier}" for r in requirements]
    assert sorted(recipe["requirements"]["run"]) == sorted(["python >=${{ python_min }}", *expected])
    assert f">={recipe['context']['python_min']}" == PROJECT["project"]["requires-python"]
    [build] = PROJECT["build-system"]["requires"]
    assert build.replace(">=", " >=") in recipe["requirements"]["host"]
    assert recipe["about"]["license"] == PROJECT["project"]["license"]
    assert recipe["about"]["summary"] == PROJECT["project"]["description"]
    files = [p.relative_to(ROOT).as_posix() for text in PROJECT["project"]["license-files"] for p in ROOT.glob(text)]
    assert sorted(recipe["about"]["license_file"]) == sorted(files)
    [script] = [f"{name} = {target}" for name, target in PROJECT["project"]["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == [script]


def test_the_recipe_of_a_release_has_its_checksum(tmp_path: Path, publication: ModuleType) -> None:
    sdist = tmp_path / "nerif_bost-9.8.7.tar.gz"
    sdist.write_bytes(b"an sdist")
    recipe = yaml.safe_load(publication.recipe_of(sdist))
    assert recipe["context"]["version"] == "9.8.7"
    assert recipe["source"]["sha256"] == hashlib.sha256(b"an sdist").hexdigest()


def test_the_container_runs_without_privileges_and_compiles_once() -> None:
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    code = re.sub(r"\\\n\s*", "", "\n".join(line for line in text.splitlines() if not line.startswith("#")))
    lines = [line.split(" ", 1) for line in code.splitlines() if line]
    values = {word: [rest for first, rest in lines if first == word] for word, _ in lines}
    assert values["FROM"] == [f"python:{PROJECT['project']['requires-python'].removeprefix('>=')}-slim"]
    assert values["ARG"][0] == "TORCH_INDEX=https://download.pytorch.org/whl/cpu"
    assert values["USER"] == ["$UID"]
    assert "UID=1000" in values["ARG"]
    assert [word for word, _ in lines].index("USER") < [word for word, _ in lines].index("ENTRYPOINT")
    assert values["ENTRYPOINT"] == ['["nerif"]']
    assert values["CMD"] == ['["--help"]']
    assert values["VOLUME"] == values["WORKDIR"][-1:] == ["/data"]
    [torch, compiled] = [next(run for run in values["RUN"] if word in run) for word in ("torch", "compileall")]
    assert '--no-deps --index-url "$TORCH_INDEX" torch' in torch
    assert "extra-index" not in torch
    assert compiled.startswith("PYTHONDONTWRITEBYTECODE='' ")
    assert "-x /torch/testing/ " in compiled  # has a file that Python 3.11 cannot compile, and the build would fail
    assert "||" not in code
    copied = {name for copy in values["COPY"] for name in copy.split()[:-1]}
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8")
    assert copied == set(re.findall(r"^!(.*)$", ignored, flags=re.MULTILINE))
    assert all((ROOT / name).exists() for name in copied)


def test_binder_installs_what_the_tests_ran_with() -> None:
    text = (ROOT / ".binder" / "postBuild").read_text(encoding="utf-8")
    assert "--no-deps --index-url https://download.pytorch.org/whl/cpu torch" in text
    assert "-c constraints.txt" in text
    assert "extra-index" not in text
    assert (ROOT / ".binder" / "postBuild").stat().st_mode & 0o100


def test_an_sdist_depends_on_its_files_alone(tmp_path: Path, tools: None) -> None:
    from reproducible_sdist import rewrite

    def sdist(name: str, files: list[str], mode: int, time: int) -> Path:
        path = tmp_path / name
        with gzip.GzipFile(path, "wb", mtime=time) as zipped, tarfile.open(fileobj=zipped, mode="w") as archive:
            for file in files:
                member = tarfile.TarInfo(file)
                member.size, member.mode, member.mtime, member.uname = len(file), mode, time, f"user{time}"
                archive.addfile(member, io.BytesIO(file.encode()))
        rewrite(path, 10**9)
        return path

    one = sdist("one.tar.gz", ["p/a", "p/b" * 70], 0o664, 1)
    two = sdist("two.tar.gz", ["p/b" * 70, "p/a"], 0o600, 2)
    assert one.read_bytes() == two.read_bytes()
    with tarfile.open(one) as archive:
        assert {m.name: archive.extractfile(m).read() for m in archive} == {"p/a": b"p/a", "p/b" * 70: b"p/b" * 70}  # type: ignore[union-attr]


def test_versions_of_the_site_are_beside_each_other(tmp_path: Path, tools: None) -> None:
    from site_versions import add

    pages, site = tmp_path / "pages", tmp_path / "site"
    (pages / ".git").mkdir(parents=True)
    site.mkdir()
    (site / "index.html").write_text("1", encoding="utf-8")

    def versions(*new: str) -> list[str]:
        for name in new:
            add(pages, site, name)
        return list(json.loads((pages / "versions.json").read_text(encoding="utf-8")))

    assert versions("latest", "v1.0.0rc1") == ["latest", "v1.0.0rc1"]
    assert "url=latest/" in (pages / "index.html").read_text(encoding="utf-8")
    assert versions("v1.9.0", "v1.10.0", "v1.0.0") == ["latest", "v1.10.0", "v1.9.0", "v1.0.0", "v1.0.0rc1"]
    assert "url=v1.10.0/" in (pages / "index.html").read_text(encoding="utf-8")
    (site / "index.html").write_text("2", encoding="utf-8")
    versions("latest")
    assert (pages / "latest" / "index.html").read_text(encoding="utf-8") == "2"
    assert (pages / "v1.0.0" / "index.html").read_text(encoding="utf-8") == "1"
    with pytest.raises(ValueError, match="expected 'latest' or a tag"):
        add(pages, site, "../elsewhere")


def test_the_list_of_missing_addresses_is_a_command() -> None:
    done = subprocess.run([sys.executable, ROOT / "tools" / "publication.py", "check"], capture_output=True, text=True)
    assert done.returncode == int("no repository" in done.stdout or "is empty" in done.stdout)
    assert done.stdout.strip()
