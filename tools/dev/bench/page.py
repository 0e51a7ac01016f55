"""Tables of docs/performance.md from the results: everything between `<!-- bench:NAME -->` and `<!-- end
-->`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

BROKEN_DB = 30.0  # a penalised objective above this stands for missed limits


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _peers(result: dict[str, Any]) -> str:
    ours = result["maxq"]
    rows = []
    for case in result.values():
        name = case.get("program", "?")
        if "skipped" in case:
            rows.append([name, case["what"], "skipped: " + case["skipped"], "", "", "", "", ""])
            continue
        ratio = low = ""
        if case is not ours and "skipped" not in ours:
            ratio = f"{case['cpu_s_median'] / ours['cpu_s_median']:.1f}"
            low = f"{case['cpu_s_min'] / ours['cpu_s_min']:.1f}"
        rows.append(
            [
                f"{name} {case['version']}",
                case["what"],
                f"{case['cpu_s_median']:.3f} / {case['cpu_s_min']:.3f}",
                f"{case['wall_s_median']:.3f} / {case['wall_s_min']:.3f}",
                f"{case['steps'] / case['cpu_s_median']:,.0f}",
                ratio,
                low,
                f"{case['needed']:g}" if case["needed"] else "",
            ]
        )
    head = (
        "program",
        "flight",
        "CPU, s (median / min)",
        "wall, s (median / min)",
        "steps/s",
        "ratio to maxq (medians)",
        "(minima)",
        "needed",
    )
    return _table(head, rows)


def _accuracy(result: list[dict[str, Any]]) -> str:
    ours = [row for row in result if row["program"] == "maxq" and "skipped" not in row]
    rows = []
    for row in result:
        if "skipped" in row:
            rows.append([row["program"], row["method"], "skipped: " + row["skipped"], "", "", ""])
            continue
        as_exact = [
            each["cpu_s"] for each in ours if all(each[error] <= row[error] for error in ("position_m", "attitude_deg"))
        ]
        ratio = f"{row['cpu_s'] / min(as_exact):.1f}" if as_exact and row not in ours else ""
        errors = (f"{row['position_m']:.1e}", f"{row['attitude_deg']:.1e}")
        rows.append([row["program"], row["method"], f"{row['cpu_s']:.3f}", *errors, ratio])
    head = ("program", "steps", "CPU, s", "position, m", "attitude, deg", "ratio to the fastest maxq as exact in both")
    return _table(head, rows)


LATENCY = (
    ("help", "`simrun --help`", "wall_s", 0.1),
    ("list", "`simrun --list`", "wall_s", 0.1),
    ("api", "`import maxq`, Python's start included", "wall_s", 0.3),
    ("first", "`simrun nominal`, no kernel compiled yet", "wall_s", 20.0),
    ("second", "`simrun nominal`, log included", "wall_s", 1.2),
    ("no_log", "`simrun nominal --no-log`", "wall_s", None),
    ("orbit", "`simrun checkcases/exo-06a`: eight hours of orbit by steps of 1 s, log included", "wall_s", None),
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
    return _table(("what", "measured", "at most", "met"), rows)


def _errors(row: dict[str, Any]) -> list[str]:
    return [f"{row[when][key]:.1e}" for when in ("burnout", "largest") for key in row["burnout"]]


def _precision(result: dict[str, Any]) -> str:
    rows = [
        [f"RK4, {row['step_ms']:g} ms", f"{row['evaluations_per_s']:,}", f"{row['cpu_s']:.3f}", *_errors(row)]
        for row in [*result["steps"], result["agreement"]]
    ]
    rows += [
        [f"DOP853, rtol {row['relative']:.0e}", f"{row['evaluations_per_s']:,}", "", *_errors(row)]
        for row in result["adaptive"]
    ]
    quantities = ("attitude, deg", "bending, m", "slosh, deg", "position, m")
    head = ["method", "derivatives per s", "CPU, s"]
    head += [f"{q} ({when})" for when in ("burn-out", "largest") for q in quantities]
    reference, motion = result["reference"], result["reference"]["motion"]
    return (
        _table(head, rows)
        + f"\n\nReference: DOP853 at rtol {reference['relative']:.0e}, {reference['evaluations_per_s']:,}"
        f" derivatives per second of flight. In this flight the bending coordinates reach"
        f" {motion['bending_m']:.1e} m, the pendulums {motion['slosh_deg']:.1f} deg."
    )


def _steps(result: dict[str, Any]) -> str:
    head = (
        "flight",
        "",
        "longest step, ms",
        "steps/s",
        "CPU, s",
        "attitude, deg",
        "bending, m",
        "slosh, deg",
        "position, m",
        "worst metric: error as a share of its requirement",
    )
    rows = []
    for flight, methods in result.items():
        for n, (method, row) in enumerate(methods.items()):
            name = f"RK4, {1e3 * float(method[7:]):g} ms" if method.startswith("step_s") else method.replace("=", " ")
            rows.append(
                [
                    "" if n else flight,
                    name,
                    " / ".join(f"{ms:g}" for ms in row["longest_ms"]),
                    f"{row['steps_per_s']:,}",
                    f"{row['cpu_s']:.3f}",
                    *(f"{row[q]:.1e}" for q in ("attitude_deg", "bending_m", "slosh_deg")),
                    f"{row['position_m']:.1e}",
                    f"{row['worst_metric']}: {row['share']:.1e}",
                ]
            )
    return _table(head, rows)


def _campaigns(result: dict[str, Any]) -> str:
    local, memory, dask = result["local"], result["memory"], result["dask"]
    rows = [
        ("flights a second, one worker", f"{local['one_per_s']:.1f}", ""),
        (f"flights a second, {local['workers']} workers", f"{local['all_per_s']:.1f}", "at least 45 on two cores"),
        ("efficiency", f"{local['efficiency_percent']:.0f} %", "at least 90 %"),
        ("CPU in the kernel, s a flight", f"{local['kernel_cpu_s']:.3f}", ""),
        ("CPU of the campaign, s a flight", f"{local['campaign_cpu_s']:.3f}", ""),
        ("campaign above kernel", f"{local['overhead_percent']:.1f} %", "at most 10 %"),
        (
            "a command that flies 200 runs, kernels compiled before, flights a second",
            f"{result['cold']['per_s']:.1f}" if "cold" in result else "not measured",
            "at least 25 on two cores",
        ),
        ("Dask (worker processes) above threads", f"{dask['overhead_percent']:.1f} %", "at most 10 %"),
        (f"peak memory, {memory['runs'] // 2:,} short flights", f"{memory['half_MB']} MB", ""),
        (f"peak memory, {memory['runs']:,} short flights", f"{memory['flown_MB']} MB", ""),
        ("growth of it, MB in a thousand flights", f"{memory.get('growth_MB', float('nan')):.2f}", "none"),
        (f"peak memory, verdicts and report of {memory['rows']:,} runs", f"{memory['judged_MB']} MB", "at most 500 MB"),
    ]
    text = _table(("what", "measured", "to reach"), rows)
    parts = [(name, f"{ms:.2f}") for name, ms in result["profile"].items()]
    return text + "\n\n" + _table(("part of a campaign", "CPU, ms a flight"), parts)


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
        "killed under way",
        "runs",
        "batches",
        "runs a second",
        "client's CPU, ms a run",
        "scheduler's CPU, ms a batch",
        "the client's limit, runs a second",
    )
    return _table(head, rows)


def _optimise(result: dict[str, Any]) -> str:
    one, optima = result["single"], result["table"]
    rows = [
        ["F6, free gains, CPU", f"{one['seconds']:.1f} s", "3 s", _met(one["seconds"], 3.0)],
        ["its nodes, flown and sampled, CPU", f"{one['seconds_plants']:.1f} s", "", ""],
        ["the same at 44 nodes over at 11, CPU", f"{one['nodes_ratio']:.1f}", "4.5", _met(one["nodes_ratio"], 4.5)],
        [
            f"the {len(optima)} optima of one table, all cores, by the clock",
            f"{one['table_s']:.1f} s",
            "12 s",
            _met(one["table_s"], 12.0),
        ],
        [
            "robust design with the worst-case search, by the clock",
            f"{one['robust_s']:.1f} s",
            "60 s",
            _met(one["robust_s"], 60.0),
        ],
    ]
    text = _table(("what", "measured", "at most", "met"), rows)
    rows = [
        [
            f"{o['structure']}, {o['schedule']}",
            f"{o['objective_db']:.3f}",
            f"{o['near_best']} of {o['starts']}",
            f"{o['leaps_back']} of {o['leaps']}",
            f"{o['kkt_residual']:.0e}",
            f"{o['seconds']:.1f}",
        ]
        for o in optima
    ]
    head = ("optimum", "peak of mode 1, dB", "starts at the best", "leaps back at it", "KKT residual", "s")
    text += "\n\n" + _table(head, rows)
    rows = [
        [
            f"{r['structure']}, {r['schedule']}",
            r["method"],
            f"{r['ours_db']:.3f}",
            f"{r['ours_s']:.1f}",
            f"{r['found_db']:.3f}" if r["found_db"] < BROKEN_DB else "none",
            f"{r['found_violation_db']:.3f}",
            "none" if r["exact_db"] is None else f"{r['exact_db']:.3f}",
            f"{r['seconds']:.0f}",
            f"{r['evaluations']:,}",
        ]
        for r in result["searches"]
    ]
    columns = (
        "problem",
        "search",
        "ours, dB",
        "CPU, s",
        "its best, dB",
        "which misses limits by, dB",
        "limits met, dB",
        "CPU, s ",
        "evaluations",
    )
    ahead = min(r["exact_db"] - r["ours_db"] for r in result["searches"] if r["exact_db"] is not None)
    told = f"The best of these with all limits met lies {abs(ahead):.3f} dB {'above' if ahead >= 0 else 'below'} ours."
    return "\n\n".join([text, _table(columns, rows), told])


def _met(value: float, limit: float) -> str:
    return "yes" if value <= limit else "no"


def _machine(results: dict[str, Any]) -> str:
    m = results["machine"]
    loads = ", ".join(f"{name} {s['load']:.1f}" for name, s in results["sections"].items())
    return (
        f"Measured with maxq {m['maxq']} on {m['processor']} ({m['cores']} cores), Python {m['python']},"
        f" NumPy {m['numpy']}, Numba {m['numba']}. Load of the machine when each part began"
        f" (1 minute's average): {loads}."
    )


REPLAY = (
    ("conversion", "read_s", "reading the log", "s", None),
    ("conversion", "convert_s", "conversion", "s", 1.5),
    ("conversion", "rrd_MB", "size of the `.rrd`", "MB", 40.0),
    ("screenshot", "wall_s", "`simreplay LOG --screenshot`: from command to settled picture", "s", 6.0),
    ("screenshot", "cpu_s", "processor time of it, viewer included, over two cores", "s", None),
    ("screenshot", "peak_MB", "peak memory of it, viewer included", "MB", 1000.0),
    ("help", "wall_s", "`simreplay --help`", "s", None),
    ("save", "wall_s", "`simreplay LOG --save`", "s", None),
    ("summary", "wall_s", "`simreplay LOG --summary`", "s", None),
    ("plots", "wall_s", "`simreplay LOG --plots`: 14 sheets, SVG and PNG", "s", None),
    ("many", "save_s", "100 dispersed ascents, logs of 100 Hz, 20 samples a second: `--save`", "s", None),
    ("many", "save_peak_MB", "100 flights: peak memory of it", "MB", None),
    ("many", "rrd_MB", "100 flights: size", "MB", None),
    ("many", "picture_s", "100 flights: opened, settled picture", "s", None),
    ("many", "viewer_MB", "100 flights: memory of the viewer", "MB", None),
    ("many", "layout_s", "100 flights: another time, laid out (a graphics card does the rest)", "s", None),
    ("many", "move_s", "100 flights: another time, drawn in software, twice", "s", None),
)


def _replay(result: dict[str, Any]) -> str:
    rows = []
    for part, key, what, unit, limit in REPLAY:
        if part not in result:
            rows.append([what, f"skipped: {result.get('skipped', 'no reason given')}", ""])
            continue
        rows.append([what, f"{result[part][key]:.2f} {unit}", f"{limit:g} {unit}" if limit else ""])
    return _table(("nominal, 233 s at 1 kHz", "measured", "at most"), rows)


def filled(text: str, results: dict[str, Any]) -> str:
    """The page with its tables renewed. Raises ValueError where a marker is missing."""
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
