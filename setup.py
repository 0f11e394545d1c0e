"""The README as PyPI shows it; all else is in pyproject.toml.

PyPI has the text alone. Links and images of files are replaced by their addresses in the repository, at the tag of the
version. Without an address (`[tool.publication]` in pyproject.toml) images are left out and links become plain text.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup

HERE = Path(__file__).parent
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\((?!\w+:|#)([^)\s]+)\)")


def readme_on_pypi(text: str, repository: str, version: str) -> str:
    """Replace links to files of the repository."""

    def replace(match: re.Match[str]) -> str:
        image, words, path = match.groups()
        if not repository:
            return "" if image else words
        kind = "raw" if image else "tree" if (HERE / path.split("#")[0]).is_dir() else "blob"
        return f"{image}[{words}]({repository}/{kind}/v{version}/{path})"

    return re.sub(r"\n{3,}", "\n\n", LINK.sub(replace, text))


if __name__ == "__main__":
    settings = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["publication"]
    [version] = re.findall(r'^__version__ = "(.*)"', (HERE / "src/nerif/__init__.py").read_text("utf-8"), re.MULTILINE)
    readme = readme_on_pypi((HERE / "README.md").read_text(encoding="utf-8"), settings["repository"], version)
    setup(long_description=readme, long_description_content_type="text/markdown")
