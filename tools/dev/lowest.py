"""Print the lowest version of each requirement in pyproject.toml, as constraints for pip: `make test-lowest`.

A lower bound is correct if pip can install all of these versions together, and the tests pass with them.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

REPOSITORY = Path(__file__).resolve().parents[2]
EXTRAS = ("dask",)


def lowest_versions(pyproject: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the name and the lowest version of each requirement of the package and its build.

    Raises ValueError for a requirement without a lower bound.
    """
    project = pyproject["project"]
    extras = [line for extra in EXTRAS for line in project["optional-dependencies"][extra]]
    for text in (*pyproject["build-system"]["requires"], *project["dependencies"], *extras):
        requirement = Requirement(text)
        bounds = [part.version for part in requirement.specifier if part.operator == ">="]
        if len(bounds) != 1:
            raise ValueError(f"{text}: states no lower bound (NAME>=VERSION)")
        yield requirement.name, bounds[0]


def main() -> int:
    """Print the constraints. Return the exit code."""
    pyproject = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
    print("\n".join(f"{name}=={version}" for name, version in lowest_versions(pyproject)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
