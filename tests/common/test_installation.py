"""Nobody is led to the package that another project has on PyPI under the name nerif."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from nerif.cli.cli import main
from nerif.common.installation import DISTRIBUTION, install, stranger

ROOT = Path(__file__).parents[2]
FOLDERS = ("src", "docs", "examples", "benchmarks", "tests")
ENDINGS = (".py", ".pyi", ".md", ".html", ".js", ".ipynb", ".toml", ".txt", ".cff")
TEXTS = sorted(
    path
    for path in (*ROOT.glob("*"), *(p for folder in FOLDERS for p in (ROOT / folder).rglob("*")))
    if path.is_file() and (path.suffix in ENDINGS or path.name == "Makefile") and "_build" not in path.parts
)
OF_THE_STRANGER = re.compile(r"(?<![\w.-])nerif\\?\[[\w,]+\\?\]|pip3? install(?: -\S+)* [\"'`]?nerif(?![\w-])")


def test_no_text_tells_anybody_to_install_the_other_package():
    assert len(TEXTS) > 100
    wrong = [
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for path in TEXTS
        for line in path.read_text(encoding="utf-8").splitlines()
        if OF_THE_STRANGER.search(line)
    ]
    assert not wrong


@pytest.mark.parametrize("extra", ["app", "sequence,movie"])
def test_the_search_for_such_texts_can_fail(extra):
    assert OF_THE_STRANGER.search(install(extra).replace(DISTRIBUTION, "nerif"))
    assert OF_THE_STRANGER.search("pip " + "install -U nerif, then")
    assert not OF_THE_STRANGER.search(install(extra))


def test_messages_name_the_distribution_and_an_extra_that_it_has():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == DISTRIBUTION
    source = "".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    named = set(re.findall(r"install\('(\w+)'\)", source))
    assert {"app", "sequence", "movie"} <= named <= set(project["optional-dependencies"])


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install something under the name nerif, for this test alone."""

    def put(version: str, command: str) -> None:
        folder = tmp_path / f"nerif-{version}.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: nerif\nVersion: {version}\n")
        (folder / "entry_points.txt").write_text(f"[console_scripts]\nnerif = {command}\n")

    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    return put


def test_the_other_package_is_named_with_the_remedy(installed):
    installed("1.4.0", "nerif.cli.cli.main:main")
    assert stranger().startswith("the package nerif 1.4.0 of another project is installed")
    assert "pip uninstall nerif" in stranger()


def test_an_older_installation_of_this_program_is_none_of_another_project(installed):
    assert stranger() == ""
    installed("0.1.0", "nerif.cli.cli:main")
    assert stranger() == ""


def test_a_verb_says_it_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr("nerif.common.installation.stranger", lambda: "the package nerif 1.4.0")
    assert main(["info", "nowhere.nc"]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == "nerif: the package nerif 1.4.0"
    assert "nowhere.nc" in second


def test_help_does_not_look_for_it():
    code = "import sys; from nerif.cli.cli import main; main(['--help'])\n"
    code += "sys.exit('nerif.common.installation' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False).returncode == 0
