"""Addresses of the published project, from one place: `[tool.publication]` in pyproject.toml.

    python tools/publication.py write     fill in all places from there
    python tools/publication.py check     list the places that have none yet, with the table to fill in; exit code 1
    python tools/publication.py recipe SDIST    print the conda recipe with the checksum of this sdist

Files that no program reads before a person does have a block between the comments "addresses" and "end of addresses",
which is written here. docs/conf.py and setup.py read the table themselves.
"""

from __future__ import annotations

import hashlib
import re
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMMENT = r"^(?:#|<!--|\.\.)"
BLOCK = re.compile(rf"({COMMENT} addresses\b[^\n]*\n)(.*?)({COMMENT} end of addresses\b)", re.MULTILINE | re.DOTALL)
NOTEBOOKS = "docs/tutorials"


@dataclass(frozen=True)
class Addresses:
    """What only the publisher knows; an empty text where it does not exist yet."""

    #: such as https://github.com/OWNER/nerif
    repository: str
    #: of all versions, by Zenodo: 10.5281/zenodo.N
    doi: str
    #: account on GitHub of the person who looks after the conda-forge package
    maintainer: str

    def __post_init__(self) -> None:
        forms = {"repository": r"https://github\.com/[\w-]+/[\w.-]*[\w-]", "doi": r"10\.\d+/\S+"}
        forms |= {"maintainer": r"[\w-]+"}
        for name, form in forms.items():
            value = getattr(self, name)
            if value and not re.fullmatch(form, value):
                raise ValueError(f"pyproject.toml, tool.publication.{name}: expected {form} or '', got '{value}'")

    @classmethod
    def read(cls, root: Path = ROOT) -> Addresses:
        return cls(**tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["publication"])

    @property
    def site(self) -> str:
        """The documentation on GitHub Pages, without a slash at the end."""
        owner, _, name = self.repository.removeprefix("https://github.com/").partition("/")
        return f"https://{owner.lower()}.github.io/{name}" if owner else ""

    def binder(self, notebook: str = "") -> str:
        path = self.repository.removeprefix("https://github.com/")
        return f"https://mybinder.org/v2/gh/{path}/HEAD?labpath={NOTEBOOKS}/{notebook}" if path else ""

    def colab(self, notebook: str) -> str:
        path = self.repository.removeprefix("https://github.com/")
        root = "https://colab.research.google.com/github"
        return f"{root}/{path}/blob/gh-pages/latest/notebooks/{notebook}" if path else ""


def urls(a: Addresses) -> str:
    """`[project.urls]`: the links at the left of the page on PyPI."""
    if not a.repository:
        return ""
    names = {"Repository": a.repository, "Documentation": f"{a.site}/", "Issues": f"{a.repository}/issues"}
    names |= {"Changelog": f"{a.repository}/blob/main/CHANGELOG.md"}
    names |= {"DOI": f"https://doi.org/{a.doi}"} if a.doi else {}
    return "\n".join(["[project.urls]", *(f'{name} = "{address}"' for name, address in names.items()), ""])


def badges(a: Addresses) -> str:
    if not a.repository:
        return ""
    tests = f"{a.repository}/actions/workflows/tests.yml"
    texts = ["[![PyPI](https://img.shields.io/pypi/v/nerif-bost)](https://pypi.org/project/nerif-bost/)"]
    texts += [f"[![tests]({tests}/badge.svg)]({tests})", f"[documentation]({a.site}/)"]
    texts += [f"[![DOI](https://zenodo.org/badge/DOI/{a.doi}.svg)](https://doi.org/{a.doi})"] if a.doi else []
    return "\n" + "\n".join(texts) + "\n\n"


def citation(a: Addresses) -> str:
    lines = [f"repository-code: {a.repository}", f"url: {a.site}/"] if a.repository else []
    return "".join(f"{line}\n" for line in [*lines, *([f"doi: {a.doi}"] if a.doi else [])])


def recipe(a: Addresses) -> str:
    lines = [f"  homepage: {a.site}/", f"  repository: {a.repository}"] if a.repository else []
    lines += ["extra:", f"  recipe-maintainers: [{a.maintainer}]"] if a.maintainer else []
    return "".join(f"{line}\n" for line in lines)


def launches(a: Addresses) -> str:
    """Below the title of the notebooks: where each runs without an installation."""
    if not a.repository:
        return ""
    scripts = sorted(path.stem for path in (ROOT / NOTEBOOKS).glob("*.py"))
    rows = [f"- {n}: `Binder <{a.binder(f'{n}.ipynb')}>`__, `Colab <{a.colab(f'{n}.ipynb')}>`__" for n in scripts]
    return "\nWithout an installation, on computers of others:\n\n" + "\n".join(rows) + "\n\n"


#: file with a block, what writes it, and the entries of the table that it needs
PLACES: dict[str, tuple[Callable[[Addresses], str], tuple[str, ...]]] = {
    "pyproject.toml": (urls, ("repository", "doi")),
    "README.md": (badges, ("repository", "doi")),
    "CITATION.cff": (citation, ("repository", "doi")),
    "recipe/recipe.yaml": (recipe, ("repository", "maintainer")),
    f"{NOTEBOOKS}/GALLERY_HEADER.rst": (launches, ("repository",)),
}
#: files that read the table themselves
READERS = {
    "docs/conf.py": (("repository",), "canonical addresses of pages, the first cell of notebooks"),
    "setup.py": (("repository",), "links and images of the README on PyPI"),
}


def filled(path: str, text: str, a: Addresses) -> str:
    """The text of one of `PLACES` with its block written from the table."""
    text, n = BLOCK.subn(lambda match: match[1] + PLACES[path][0](a) + match[3], text)
    if n != 1:
        raise ValueError(f"{path}: expected one block from a comment 'addresses' to one 'end of addresses', found {n}")
    return text


def write(root: Path = ROOT) -> None:
    a = Addresses.read(root)
    for path in PLACES:
        before = (root / path).read_text(encoding="utf-8")
        (root / path).write_text(filled(path, before, a), encoding="utf-8", newline="\n")


def missing(root: Path = ROOT) -> list[str]:
    """A line for each place without an address, and for each that differs from the table."""
    a = Addresses.read(root)
    lines = [f"pyproject.toml: tool.publication.{name} is empty" for name in vars(a) if not getattr(a, name)]
    for path, (_, names) in PLACES.items():
        lines += [f"{path}: no {name}" for name in names if not getattr(a, name)]
        text = (root / path).read_text(encoding="utf-8")
        if filled(path, text, a) != text:
            lines.append(f"{path}: differs from tool.publication; run `python tools/publication.py write`")
    for path, (names, use) in READERS.items():
        lines += [f"{path}: no {name} ({use})" for name in names if not getattr(a, name)]
    return lines


def recipe_of(sdist: Path, root: Path = ROOT) -> str:
    """The conda recipe with the version and the checksum of an sdist."""
    text = (root / "recipe" / "recipe.yaml").read_text(encoding="utf-8")
    version = sdist.name.removeprefix("nerif_bost-").removesuffix(".tar.gz")
    digest = hashlib.sha256(sdist.read_bytes()).hexdigest()
    text = re.sub(r'^  version: ".*"$', f'  version: "{version}"', text, flags=re.MULTILINE)
    return re.sub(r"^  # sha256: .*$", f"  sha256: {digest}", text, flags=re.MULTILINE)


def main(arguments: list[str]) -> int:
    if arguments == ["write"]:
        write()
    elif arguments == ["check"]:
        lines = missing()
        print("\n".join(lines or ["every place has its address"]))
        return bool(lines)
    elif len(arguments) == 2 and arguments[0] == "recipe":
        print(recipe_of(Path(arguments[1])), end="")
    else:
        print(__doc__)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
