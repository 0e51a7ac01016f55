"""The review pack: one HTML file with all in it, readable by someone who was not in the room; and as PDF."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from maxq.design.verify.verify import Verification
from maxq.sim.files import write_whole
from maxq.tools.pages.render import render
from maxq.tools.verify import text

PAGE_NAME, PDF_NAME = "review.html", "review.pdf"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINT_S = 60.0


def write_page(folder: Path, found: Verification, command: str) -> list[Path]:
    """Write review.html, and review.pdf where a browser is there that prints. Raises FileError."""
    from maxq.tools.verify.pictures import pictures  # noqa: PLC0415  # lazy: matplotlib comes with it

    page = write_whole(folder / PAGE_NAME, page_of(found, command, pictures(found)))
    printed = print_page(page, folder / PDF_NAME)
    return [page, printed] if printed is not None else [page]


def print_page(page: Path, pdf: Path) -> Path | None:
    """The page as PDF by a headless browser; None where there is none, or it fails."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        return None
    part = pdf.with_name(f".{pdf.name}.part")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", f"--user-data-dir={profile}", "--no-pdf-header-footer",
            f"--print-to-pdf={part.resolve()}", page.resolve().as_uri(),
        ]  # fmt: skip
        try:
            subprocess.run(command, capture_output=True, timeout=_PRINT_S, check=True)
            part.replace(pdf)
        except (OSError, subprocess.SubprocessError):
            part.unlink(missing_ok=True)
            return None
    return pdf


def page_of(found: Verification, command: str, pictures: dict[str, bytes]) -> str:
    """The page as text."""
    return render("review.html.j2", found=found, command=command, pictures=pictures, headline=text.headline(found))
