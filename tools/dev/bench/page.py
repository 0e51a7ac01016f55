"""The tables of docs/performance.md, made from the results: all text between `<!-- bench:NAME -->` and `<!-- end -->`.

The page shows a selection; docs/performance.json contains all results.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from textwrap import fill
from typing import Any

from maxq.sim.flight.metric_table import title_of

WIDTH = 120  # characters of a line of text
SHOWN_METHODS = ("step_s=0.001", "step_s=0.005", "accuracy=0.05")
SHOWN_STEPS_MS = (5.0, 2.0, 1.0, 0.25)
SHOWN_STRUCTURES = ("F2", "F4", "F6")
SHOWN_ACCURACY = {
    "maxq": ("accuracy 0.1", "accuracy 0.001", "RK4, 1 ms"),
    "JSBSim": ("4 ms", "1 ms", "0.25 ms"),
    "Basilisk": ("20 ms", "10 ms", "5 ms"),
    "RocketPy": ("LSODA, rtol 1e-06", "LSODA, rtol 1e-08"),
}


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _peers(result: dict[str, Any]) -> str:
    ours = result["maxq"]
    rows = []
    for case in result.values():
        name = case.get("program", "?")
        if "skipped" in case:
            rows.append([name, case["what"], "skipped: " + case["skipped"], "", "", "", ""])
            continue
        ratio = ""
        if case is not ours and "skipped" not in ours:
            ratio = f"{case['cpu_s_median'] / ours['cpu_s_median']:.1f}, {case['cpu_s_min'] / ours['cpu_s_min']:.1f}"
        rows.append(
            [
                f"{name} {case['version']}",
                case["what"],
                f"{case['cpu_s_median']:.3f}, {case['cpu_s_min']:.3f}",
                f"{case['steps'] / case['cpu_s_median']:,.0f}",
                ratio,
                f"{case['needed']:g}" if case["needed"] else "",
            ]
        )
    head = ("program", "flight", "CPU, s: median, minimum", "steps/s", "ratio to maxq: median, minimum", "required")
    return _table(head, rows)


def _accuracy(result: list[dict[str, Any]]) -> str:
    ours = [row for row in result if row["program"] == "maxq" and "skipped" not in row]
    rows = []
    for row in result:
        if "skipped" in row:
            rows.append([row["program"], row["method"], "skipped: " + row["skipped"], "", "", ""])
            continue
        if row["method"] not in SHOWN_ACCURACY[row["program"]]:
            continue
        as_exact = [
            each["cpu_s"] for each in ours if all(each[error] <= row[error] for error in ("position_m", "attitude_deg"))
        ]
        ratio = f"{row['cpu_s'] / min(as_exact):.1f}" if as_exact and row not in ours else ""
        errors = (f"{row['position_m']:.1e}", f"{row['attitude_deg']:.1e}")
        rows.append([row["program"], row["method"], f"{row['cpu_s']:.3f}", *errors, ratio])
    head = (
        "program",
        "steps",
        "CPU, s",
        "position, m",
        "attitude, deg",
        "ratio to the fastest maxq run as accurate in both",
    )
    return _table(head, rows)


LATENCY = (
    ("help", "`simrun --help`", "wall_s", 0.1),
    ("api", "`import maxq`, with Python's start", "wall_s", 0.3),
    ("first", "`simrun nominal`, kernels not compiled", "wall_s", 20.0),
    ("second", "`simrun nominal`, with log", "wall_s", 1.2),
    ("no_log", "`simrun nominal --no-log`", "wall_s", None),
    ("orbit", "`simrun checkcases/exo-06a`: 8 h of orbit in steps of 1 s, with log", "wall_s", None),
    ("second", "peak memory of `simrun nominal`, 1 kHz log", "peak_MB", 400.0),
    ("first", "peak memory while compiling", "peak_MB", None),
    ("in_memory", "peak memory of `fly(scenario)`, 1 kHz log in arrays", "peak_MB", 400.0),
)


def _latency(result: dict[str, Any]) -> str:
    rows = []
    for key, what, quantity, limit in LATENCY:
        case, unit = result[key], "s" if quantity == "wall_s" else "MB"
        bound = f"{limit:g} {unit}" if limit else ""
        if "skipped" in case:
            rows.append([what, "skipped: " + case["skipped"], bound, ""])
        else:
            met = "" if limit is None else "yes" if case[quantity] <= limit else "no"
            rows.append(
                [what, f"{case[quantity]:.2f} {unit}" if unit == "s" else f"{case[quantity]:.0f} MB", bound, met]
            )
    return _table(("quantity", "measured", "limit", "met"), rows)


def _errors(row: dict[str, Any]) -> list[str]:
    return [f"{value:.1e}" for value in row["largest"].values()]


def _precision(result: dict[str, Any]) -> str:
    rows = [
        [f"RK4, {row['step_ms']:g} ms", f"{row['evaluations_per_s']:,}", f"{row['cpu_s']:.3f}", *_errors(row)]
        for row in [*(row for row in result["steps"] if row["step_ms"] in SHOWN_STEPS_MS), result["agreement"]]
    ]
    rows += [
        [f"DOP853, rtol {row['relative']:.0e}", f"{row['evaluations_per_s']:,}", "", *_errors(row)]
        for row in result["adaptive"]
    ]
    quantities = ("attitude, deg", "bending, m", "slosh, deg", "position, m")
    head = ["method", "derivatives per s", "CPU, s", *quantities]
    reference, motion = result["reference"], result["reference"]["motion"]
    text = (
        f"Reference: DOP853 at rtol {reference['relative']:.0e}, {reference['evaluations_per_s']:,}"
        f" derivatives per second of flight. The bending coordinates reach {motion['bending_m']:.1e} m and the"
        f" pendulums {motion['slosh_deg']:.1f} deg."
    )
    return f"{_table(head, rows)}\n\n{fill(text, WIDTH)}"


def _steps(result: dict[str, Any]) -> str:
    head = (
        "flight",
        "method",
        "longest step, ms",
        "steps/s",
        "CPU, s",
        "attitude, deg",
        "bending, m",
        "slosh, deg",
        "position, m",
        "worst metric: error / requirement",
    )
    rows = []
    for flight, methods in result.items():
        for n, method in enumerate(SHOWN_METHODS):
            row = methods[method]
            name = f"RK4, {1e3 * float(method[7:]):g} ms" if method.startswith("step_s") else method.replace("=", " ")
            rows.append(
                [
                    "" if n else flight,
                    name,
                    ", ".join(f"{ms:g}" for ms in row["longest_ms"]),
                    f"{row['steps_per_s']:,}",
                    f"{row['cpu_s']:.3f}",
                    *(f"{row[q]:.1e}" for q in ("attitude_deg", "bending_m", "slosh_deg")),
                    f"{row['position_m']:.1e}",
                    f"{title_of(row['worst_metric']).removeprefix('largest ')}: {row['share']:.1e}",
                ]
            )
    return _table(head, rows)


def _campaigns(result: dict[str, Any]) -> str:
    local, memory, dask = result["local"], result["memory"], result["dask"]
    rows = [
        ("one worker, flights/s", f"{local['one_per_s']:.1f}", ""),
        (f"{local['workers']} workers, flights/s", f"{local['all_per_s']:.1f}", ">= 45 on two cores"),
        ("efficiency", f"{local['efficiency_percent']:.0f} %", ">= 90 %"),
        ("CPU of the kernel, s per flight", f"{local['kernel_cpu_s']:.3f}", ""),
        ("CPU of the campaign, s per flight", f"{local['campaign_cpu_s']:.3f}", ""),
        ("overhead of the campaign", f"{local['overhead_percent']:.1f} %", "<= 10 %"),
        (
            "command with 200 runs, kernels compiled, flights/s",
            f"{result['cold']['per_s']:.1f}" if "cold" in result else "not measured",
            ">= 25 on two cores",
        ),
        ("overhead of Dask's worker processes", f"{dask['overhead_percent']:.1f} %", "<= 10 %"),
        (f"peak memory, {memory['runs']:,} short flights", f"{memory['flown_MB']} MB", ""),
        (
            "its growth from half of them on, MB per 1,000 flights",
            f"{memory.get('growth_MB', float('nan')):.2f}",
            "none",
        ),
        (f"peak memory, verdicts and report of {memory['rows']:,} runs", f"{memory['judged_MB']} MB", "<= 500 MB"),
    ]
    return _table(("quantity", "measured", "required"), rows)


def _cluster(result: list[dict[str, Any]]) -> str:
    rows = [
        [
            f"{row['workers']:,}" + (" simulated" if row["workers"] > row["processes"] else ""),
            f"{row['lost']}",
            f"{row['runs']:,}",
            f"{row['batches']:,}",
            f"{row['per_s']:,.0f}",
            f"{row['client_ms']:.2f}",
            f"{row['scheduler_ms_a_batch']:.1f}",
            f"{1e3 / row['client_ms']:,.0f}",
        ]
        for row in result
    ]
    head = (
        "workers",
        "killed",
        "runs",
        "batches",
        "runs/s",
        "client CPU, ms per run",
        "scheduler CPU, ms per batch",
        "limit of the client, runs/s",
    )
    return _table(head, rows)


FURTHER = (
    ("their CPU", "table_cpu_s", 0.0),
    ("robust design of petrel, three stages, wall", "petrel_s", 60.0),
    ("its CPU", "petrel_cpu_s", 0.0),
    ("first design of a new case, from the start of the process, wall", "first_s", 5.0),
    ("its CPU", "first_cpu_s", 0.0),
)
"""The rows of the optimiser's further times: text, key, and limit in seconds, or 0 without a limit."""


def _optimise(result: dict[str, Any]) -> str:
    one, optima = result["single"], result["table"]
    rows = [
        ["F6, free gains, CPU", f"{one['seconds']:.1f} s", "3 s", _met(one["seconds"], 3.0)],
        ["its operating points, CPU", f"{one['seconds_plants']:.1f} s", "", ""],
        ["CPU at 44 operating points / at 11", f"{one['nodes_ratio']:.1f}", "4.5", _met(one["nodes_ratio"], 4.5)],
        [f"{len(optima)} optima, all cores, wall", f"{one['table_s']:.1f} s", "8 s", _met(one["table_s"], 8.0)],
        *(
            [what, f"{one[key]:.1f} s", f"{most:g} s" if most else "", _met(one[key], most) if most else ""]
            for what, key, most in FURTHER
            if key in one
        ),
        ["robust design with worst-case search, wall", f"{one['robust_s']:.1f} s", "60 s", _met(one["robust_s"], 60.0)],
    ]
    text = _table(("quantity", "measured", "limit", "met"), rows)
    searches, methods = result["searches"], list(dict.fromkeys(r["method"] for r in result["searches"]))
    searched = {
        (r["structure"], r["schedule"], r["method"]): "none" if r["exact_db"] is None else f"{r['exact_db']:.3f}"
        for r in searches
    }
    rows = [
        [
            f"{o['structure']}, {o['schedule']}",
            f"{o['objective_db']:.3f}",
            f"{o['leaps_back']}/{o['leaps']}",
            f"{o['kkt_residual']:.0e}",
            f"{o['seconds']:.1f}",
            *(searched.get((o["structure"], o["schedule"], method), "") for method in methods),
        ]
        for o in optima
        if o["structure"] in SHOWN_STRUCTURES
    ]
    columns = (
        "optimum",
        "peak of mode 1, dB",
        "perturbations that return",
        "KKT residual",
        "CPU, s",
        *(f"{m}, {searches[0]['seconds']:.0f} s, dB" for m in methods),
    )
    ahead = min(r["exact_db"] - r["ours_db"] for r in searches if r["exact_db"] is not None)
    told = f"The best search result is {-ahead:.3f} dB below that of maxq."
    if ahead > -5e-4:
        told = "No search finds a lower peak."
    return "\n\n".join([text, _table(columns, rows), told])


def _margins(result: dict[str, float]) -> str:
    sweep_s = result["sweep_s"]
    rows = [
        ["margins of one loop, from Python", f"{result['loop_ms']:.2f} ms", "", ""],
        ["sweep of 10,000 vehicles at 40 s", f"{sweep_s:.1f} s", "4 s", _met(sweep_s, 4.0)],
        ["one of its loops, with its plant", f"{sweep_s / 10.0:.2f} ms", "", ""],
        ["its loops near a limit, measured one by one", f"{result['exact']:g}", "", ""],
        ["`simdesign analyse ksr3-default --no-pictures`", f"{result['analyse_s']:.1f} s", "", ""],
    ]
    return _table(("quantity", "CPU", "limit", "met"), rows)


def _met(value: float, limit: float) -> str:
    return "yes" if value <= limit else "no"


def _machine(results: dict[str, Any]) -> str:
    m = results["machine"]
    loads = ", ".join(f"{name} {s['load']:.1f}" for name, s in results["sections"].items())
    text = (
        f"Measured with maxq {m['maxq']} on {m['processor']} ({m['cores']} cores), Python {m['python']},"
        f" NumPy {m['numpy']}, Numba {m['numba']}. Load average over 1 minute at the start of each part: {loads}."
    )
    return fill(text, WIDTH)


REPLAY = (
    ("conversion", "read_s", "reading the log", "s", None),
    ("conversion", "convert_s", "conversion", "s", 1.5),
    ("conversion", "rrd_MB", "size of the `.rrd`", "MB", 40.0),
    ("screenshot", "wall_s", "`simreplay LOG --screenshot`, to the settled picture", "s", 6.0),
    ("screenshot", "peak_MB", "its peak memory, viewer included", "MB", 1000.0),
    ("save", "wall_s", "`simreplay LOG --save`", "s", None),
    ("summary", "wall_s", "`simreplay LOG --summary`", "s", None),
    ("plots", "wall_s", "`simreplay LOG --plots`: 14 sheets, SVG and PNG", "s", None),
    ("many", "save_s", "100 dispersed ascents, 100 Hz logs, 20 samples/s: `--save`", "s", None),
    ("many", "save_peak_MB", "100 flights: its peak memory", "MB", None),
    ("many", "picture_s", "100 flights: open, settled picture", "s", None),
    ("many", "viewer_MB", "100 flights: viewer memory", "MB", None),
    ("many", "move_s", "100 flights: change of time, software rendering, twice", "s", None),
)


def _replay(result: dict[str, Any]) -> str:
    rows = []
    for part, key, what, unit, limit in REPLAY:
        if part not in result:
            rows.append([what, f"skipped: {result.get('skipped', 'no reason given')}", ""])
            continue
        digits = 2 if unit == "s" else 0
        rows.append([what, f"{result[part][key]:.{digits}f} {unit}", f"{limit:g} {unit}" if limit else ""])
    return _table(("nominal, 233 s at 1 kHz", "measured", "limit"), rows)


def filled(text: str, results: dict[str, Any]) -> str:
    """Return the page with its tables renewed from the results. Raises ValueError if a marker is missing."""
    sections = {name: s.get("result") for name, s in results["sections"].items()}

    def whole(name: str, draw: Callable[[Any], str]) -> str:
        result = sections.get(name)
        if result is None:
            return str(results["sections"].get(name, {}).get("failed", "Not measured yet."))
        return draw(result)

    tables = {
        "machine": _machine(results),
        "peers": whole("peers", _peers),
        "accuracy": whole("accuracy", _accuracy),
        "latency": whole("latency", _latency),
        "precision": whole("precision", _precision),
        "steps": whole("steps", _steps),
        "optimise": whole("optimise", _optimise),
        "margins": whole("margins", _margins),
        "replay": whole("replay", _replay),
        "campaigns": whole("campaigns", _campaigns),
        "cluster": whole("cluster", _cluster),
    }
    for name, table in tables.items():
        pattern = re.compile(rf"(<!-- bench:{name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not pattern.search(text):
            raise ValueError(f"the page has no marker bench:{name}")
        text = pattern.sub(lambda match, table=table: f"{match[1]}{table}\n{match[2]}", text)  # type: ignore[misc]  # mypy infers no type for a lambda's default
    return text
