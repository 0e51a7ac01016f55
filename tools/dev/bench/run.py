"""The runner of all benchmarks: `make bench`.

Results are written to docs/performance.json, tables and picture to docs/performance.md and docs/pictures. Every part
runs in separate processes, so that no part uses the memory or caches of another.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from maxq.tools.dev.bench import latency, page, side_by_side

REPOSITORY = Path(__file__).resolve().parents[3]
DOCS = REPOSITORY / "docs"
RESULTS = DOCS / "performance.json"
PAGE = DOCS / "performance.md"
PICTURE = DOCS / "pictures" / "work-precision.svg"


def _in_own_process(module: str, *arguments: str) -> Any:
    """Return the JSON printed by a module of this folder. Raises RuntimeError with the last line of its stderr."""
    done = subprocess.run(
        [sys.executable, "-m", f"maxq.tools.dev.bench.{module}", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        words = done.stderr.strip().splitlines()
        raise RuntimeError(f"{module}: {words[-1] if words else f'exit code {done.returncode}'}")
    return json.loads(done.stdout)


def _machine() -> dict[str, Any]:
    processor = platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        names = [line for line in information.read_text().splitlines() if line.startswith("model name")]
        processor = names[0].partition(":")[2].strip() if names else processor
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("maxq", "numpy", "numba", "scipy")},
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--peers",
        type=Path,
        default=REPOSITORY / ".venv-bench/bin/python",
        help="Python of the environment that has the programs for comparison",
    )
    parser.add_argument("--rounds", type=int, default=5, help="flights of each of these programs (default 5)")
    parser.add_argument("--repetitions", type=int, default=5, help="runs of each command (default 5)")
    parser.add_argument(
        "--search-seconds",
        type=float,
        default=20.0,
        help="CPU time of each search compared with the optimiser (default 20; long run: 1800)",
    )
    parser.add_argument("--only", default="", help="comma-separated parts; the others keep their last results")
    choice = parser.parse_args()
    parts: dict[str, Callable[[], Any]] = {
        "peers": lambda: side_by_side.measure(choice.peers, choice.rounds),
        "accuracy": lambda: side_by_side.accuracy(choice.peers),
        "latency": lambda: latency.measure(choice.repetitions),
        "precision": lambda: _in_own_process("precision"),
        "steps": lambda: _in_own_process("steps"),
        "replay": lambda: _in_own_process("replay"),
        "margins": lambda: _in_own_process("margins"),
        "campaigns": lambda: _in_own_process("campaigns"),
        "cluster": lambda: _in_own_process("cluster"),
        "optimise": lambda: _in_own_process("optimise", "--seconds", str(choice.search_seconds)),
    }
    wanted = [name for name in choice.only.split(",") if name] or list(parts)
    unknown = set(wanted) - set(parts)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}: there are {', '.join(parts)}")
    results: dict[str, Any] = {"sections": {}}
    if RESULTS.exists():
        results = json.loads(RESULTS.read_text())
    results["machine"] = _machine()
    failed = 0
    for name in wanted:
        print(f"Measuring {name} ...", end=" ", flush=True)
        start = time.perf_counter()
        section: dict[str, Any] = {"load": round(os.getloadavg()[0], 2)}
        try:
            section["result"] = parts[name]()
        except RuntimeError as error:
            section["failed"] = f"Failed: {error}"
            failed = 1
        results["sections"][name] = section
        print(section.get("failed", f"{time.perf_counter() - start:.0f} s"), flush=True)
    results["sections"] = {name: results["sections"][name] for name in parts if name in results["sections"]}
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    if results["sections"].get("precision", {}).get("result") is not None:
        PICTURE.parent.mkdir(exist_ok=True)
        subprocess.run([sys.executable, "-m", "maxq.tools.dev.bench.plots", str(RESULTS), str(PICTURE)], check=True)
    text = page.filled(PAGE.read_text(), results)
    PAGE.write_text(text)
    for name in ("peers", "latency"):
        table = text.partition(f"<!-- bench:{name} -->\n")[2].partition("<!-- end -->")[0]
        print(f"\n{table}", end="")
    print(f"\nWritten: {', '.join(str(p.relative_to(REPOSITORY)) for p in (RESULTS, PAGE, PICTURE))}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
