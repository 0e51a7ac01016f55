"""Scenarios that come with maxq: the folder scenarios/, which is package data of an installed maxq."""

from __future__ import annotations

from pathlib import Path

DATA_FOLDERS = ("vehicles", "designs", "winds", "campaigns", "suites")
"""Folders of data that scenarios name; their files are no scenarios."""

BUILTIN = "a built-in scenario (simrun --list names them)"
"""What is allowed where such a name is wanted."""


def scenarios_folder() -> Path:
    """Folder of the built-in scenarios.

    The packaging puts scenarios/ beside sim/ both in a checkout (the repository's top) and when installed
    (the folder of the package maxq).
    """
    return Path(__file__).resolve().parents[2] / "scenarios"


def builtin_names() -> list[str]:
    """Names of the built-in scenarios, such as `nominal` or `checkcases/nesc-01`, sorted."""
    folder = scenarios_folder()
    files = (path.relative_to(folder) for path in folder.rglob("*.toml"))
    return sorted(path.with_suffix("").as_posix() for path in files if path.parts[0] not in DATA_FOLDERS)


def builtin_path(name: str) -> Path | None:
    """The file of the built-in scenario `name`, or None."""
    return scenarios_folder() / f"{name}.toml" if name in builtin_names() else None


def campaign_names() -> list[str]:
    """Names of the built-in campaigns, such as `campaigns/ksr3`, sorted."""
    folder = scenarios_folder()
    return sorted(p.relative_to(folder).with_suffix("").as_posix() for p in (folder / "campaigns").rglob("*.toml"))


def campaign_path(name: str) -> Path | None:
    """The file of the built-in campaign `name`, or None."""
    return scenarios_folder() / f"{name}.toml" if name in campaign_names() else None
