"""No text installs the package of another project that is called nerif on PyPI."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from nerif.cli.cli import main
from nerif.common.installation import DISTRIBUTION, install, package_conflict

ROOT = Path(__file__).parents[2]
FOLDERS = ("src", "docs", "examples", "benchmarks", "tests")
ENDINGS = (".py", ".pyi", ".md", ".html", ".js", ".ipynb", ".toml", ".txt", ".cff")
TEXTS = sorted(
    path
    for path in (*ROOT.glob("*"), *(p for folder in FOLDERS for p in (ROOT / folder).rglob("*")))
    if path.is_file() and (path.suffix in ENDINGS or path.name == "Makefile") and "_build" not in path.parts
)
FOREIGN = re.compile(r"(?<![\w.-])nerif\\?\[[\w,]+\\?\]|pip3? install(?: -\S+)* [\"'`]?nerif(?![\w-])")


def test_no_text_installs_the_other_package():
    assert len(TEXTS) > 100
    assert not [path for path in TEXTS if any(map(FOREIGN.search, path.read_text(encoding="utf-8").splitlines()))]
    for extra in ("app", "sequence,movie"):  # the search can fail
        assert FOREIGN.search(install(extra).replace(DISTRIBUTION, "nerif"))
        assert not FOREIGN.search(install(extra))
    assert FOREIGN.search("pip " + "install -U nerif, then")


def test_messages_name_the_distribution_and_an_extra_that_it_has():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == DISTRIBUTION
    source = "".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    named = set(re.findall(r"install\('(\w+)'\)", source))
    assert {"app", "sequence", "movie"} <= named <= set(project["optional-dependencies"])


@pytest.mark.parametrize(
    ("version", "command", "warning"),
    [
        ("", "", ""),
        ("0.1.0", "nerif.cli.cli:main", ""),  # an older installation of this program
        ("1.4.0", "nerif.cli.cli.main:main", "the package nerif 1.4.0 of another project"),
    ],
)
def test_the_other_package_is_named_with_the_remedy(tmp_path, monkeypatch, version, command, warning):
    if version:
        folder = tmp_path / f"nerif-{version}.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: nerif\nVersion: {version}\n")
        (folder / "entry_points.txt").write_text(f"[console_scripts]\nnerif = {command}\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    assert package_conflict().startswith(warning) if warning else package_conflict() == ""
    assert ("pip uninstall nerif" in package_conflict()) == bool(warning)


def test_a_command_warns_in_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "damaged.nc").write_text("no NetCDF")
    monkeypatch.setattr("nerif.common.installation.package_conflict", lambda: "the package nerif 1.4.0")
    assert main(["info", str(tmp_path / "damaged.nc")]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == "nerif: the package nerif 1.4.0"
    assert "damaged.nc" in second


def test_help_does_not_check_for_it():
    code = "import sys; from nerif.cli.cli import main; main(['--help'])\n"
    code += "sys.exit('nerif.common.installation' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False).returncode == 0
