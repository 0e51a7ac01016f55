"""The copy of a campaign's folder in object storage, or in another place that fsspec reaches (the extra maxq[objects]).

    run_campaign(campaign, Path("runs/ksr3"), sync="s3://bucket/ksr3")

A part is copied as soon as it is in the local folder. At the beginning, parts that only one side has are copied to the
other one. A campaign therefore continues on another machine, with an empty local folder, after its machine was lost.
There is no lock in the storage: only one process at a time may use an address.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from maxq.sim.campaign.error import CampaignError
from maxq.sim.files import write_whole

_KEPT = ("campaign.json", "runs/", "histories/")
"""The files of a campaign from which all others can be made; only these are copied from the storage."""


def is_address(place: str) -> bool:
    """Return True for an address such as s3://bucket/ksr3, and False for a path."""
    return "://" in place


class ObjectFolder:
    """The copy of a campaign's folder at an address. All methods raise CampaignError, which names the address."""

    def __init__(self, address: str) -> None:
        self.address = address
        try:
            from fsspec.core import url_to_fs  # noqa: PLC0415  # an extra
        except ImportError:
            raise CampaignError(f"{address}: needs fsspec: pip install 'maxq[objects]'") from None
        with self._explained("opened"):
            self._system, self._root = url_to_fs(address)

    def pull(self, folder: Path) -> None:
        """Copy campaign.json and the parts that the local folder lacks."""
        with self._explained("read"):
            there = self._files()
            for name in sorted(there, reverse=True):  # histories before the runs to which they belong
                path = folder / name
                if name.startswith(_KEPT) and not path.exists():
                    write_whole(path, self._system.cat_file(self._at(name)), CampaignError, durable=True)

    def manifest(self) -> dict[str, Any] | None:
        """Return the content of campaign.json, or None if there is none."""
        with self._explained("read"):
            if "campaign.json" not in self._files():
                return None
            content: dict[str, Any] = json.loads(self._system.cat_file(self._at("campaign.json")))
        return content

    def push(self, folder: Path) -> None:
        """Copy the local files that are missing in the storage or have another size there.

        Parts that the local folder lacks are removed from the storage: after `pull`, these are the damaged ones.
        """
        with self._explained("written"):
            there, here = self._files(), dict[str, Path]()
            for path in sorted(folder.rglob("*")):
                name = path.relative_to(folder)
                hidden = any(part.startswith(".") for part in name.parts)
                if path.is_file() and not hidden and name.suffix != ".corrupt" and name.as_posix() != "lock":
                    here[name.as_posix()] = path
            for text, path in here.items():
                if there.get(text) != path.stat().st_size:
                    self.write(text, path.read_bytes())
            for text in there.keys() - here.keys():
                if text.startswith(("runs/", "histories/")):
                    self._system.rm_file(self._at(text))

    def write(self, name: str, content: bytes) -> None:
        """Write a file, completely or not at all; `name` is its path in the folder."""
        with self._explained("written"):
            place = self._at(name)
            self._system.makedirs(str(PurePosixPath(place).parent), exist_ok=True)
            with self._system.transaction, self._system.open(place, "wb") as file:
                file.write(content)

    def _at(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def _files(self) -> dict[str, int]:
        """Return the sizes of all files, by their paths in the folder."""
        self._system.invalidate_cache()
        try:
            found: dict[str, dict[str, Any]] = self._system.find(self._root, detail=True)
        except FileNotFoundError:
            return {}
        start = len(self._root.rstrip("/")) + 1
        return {name[start:]: int(about["size"]) for name, about in found.items()}

    @contextmanager
    def _explained(self, done: str) -> Iterator[None]:
        """Raise an error of the storage as a CampaignError. Each storage has exceptions of its own."""
        try:
            yield
        except CampaignError:
            raise
        except Exception as error:
            said = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
            raise CampaignError(f"{self.address}: cannot be {done}: {said}; the same command continues") from error


def folders_at(pattern: str) -> list[ObjectFolder]:
    """Return the folders at an address with wildcards, such as s3://bucket/part-*. Raises CampaignError."""
    whole = ObjectFolder(pattern)
    with whole._explained("read"):
        found = sorted(whole._system.glob(whole._root)) if "*" in pattern else [whole._root]
        names = [whole._system.unstrip_protocol(name) for name in found]
    if not names:
        raise CampaignError(f"{pattern}: there is no such folder")
    return [ObjectFolder(name) for name in names]
