"""The tables that a program writes into a document, between `<!-- name: begin -->` and `<!-- name: end -->`."""

from __future__ import annotations

from pathlib import Path

DOCS = Path(__file__).resolve().parents[3] / "docs"
VERIFICATION = DOCS / "verification.md"


def markers(name: str) -> tuple[str, str]:
    """Return the lines before and after a table."""
    return f"<!-- {name}: begin -->", f"<!-- {name}: end -->"


def rewrite(document: Path, name: str, table: str) -> None:
    """Write a table between its markers. Raises ValueError if they are missing."""
    begin, end = markers(name)
    text = document.read_text()
    before, found, rest = text.partition(begin)
    _, ended, after = rest.partition(end)
    if not found or not ended:
        raise ValueError(f"{document.name} has no markers {begin} and {end}")
    document.write_text(f"{before}{begin}\n{table.rstrip()}\n{end}{after}")
