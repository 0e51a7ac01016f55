"""The links to the layers in tools/.ns, which mypy and import-linter follow (pyproject.toml): `make lint`.

In the repository they are symbolic links. A checkout that cannot contain them, as on Windows without this right, has a
text file in place of each. This module then makes links again, or else junctions or copies.

    python -m maxq.tools.dev.links
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
LAYERS = ("api", "control", "sim", "design", "tools")


def _symbolic(layer: Path, link: Path) -> None:
    os.symlink(os.path.relpath(layer, link.parent), link, target_is_directory=True)


def _junction(layer: Path, link: Path) -> None:
    """Make a junction, which needs no rights (Windows). Raises OSError elsewhere."""
    if sys.platform != "win32":
        raise OSError("junctions exist on Windows only")
    import _winapi  # noqa: PLC0415  # Windows

    _winapi.CreateJunction(str(layer), str(link))


def _copy(layer: Path, link: Path) -> None:
    """Copy the modules of a layer. The next call makes the copy again, because the layer may have changed."""
    shutil.copytree(layer, link, ignore=shutil.ignore_patterns("__pycache__", ".ns"))
    (link / _MARK).touch()


_MARK = ".copied"
WAYS: tuple[Callable[[Path, Path], None], ...] = (_symbolic, _junction, _copy)


def make_links(folder: Path, root: Path, ways: Sequence[Callable[[Path, Path], None]] = WAYS) -> list[str]:
    """Make a link in `folder` to each layer in `root` that has none, in the first of the `ways` that works.

    Returns the names of the links made. Raises OSError if no way works.
    """
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for name in LAYERS:
        layer, link = root / name, folder / name
        if link.is_dir() and not (link / _MARK).exists():
            continue
        if link.is_dir():
            shutil.rmtree(link)
        else:
            link.unlink(missing_ok=True)
        for way in ways:
            try:
                way(layer, link)
                break
            except OSError as error:
                failed = error
        else:
            raise failed
        made.append(name)
    return made


def main() -> int:
    if made := make_links(REPOSITORY / "tools" / ".ns" / "maxq", REPOSITORY):
        print(f"tools/.ns: linked {', '.join(made)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
