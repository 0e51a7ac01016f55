"""Tables and pictures of the flown campaigns in docs/case-study.md, from docs/case-study-campaigns.json alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from maxq.sim.campaign.statistics import MET, NOT_MET
from maxq.tools.dev.studies.case_study.dispersed import DESIGNS, ENVELOPES, Case
from maxq.tools.plots.palette import BLUE, ORANGE, RED
from maxq.tools.plots.style import label, plain_numbers, save, sheet

SHOWN = (
    "slosh angle",
    "gimbal rate",
    "gimbal angle",
    "attitude error",
    "bending moment of the structure",
    "lateral load",
)
LOOKS = {"ksr3-two-phase": (ORANGE, "--"), "ksr3-robust": (BLUE, "-")}
WIDTHS = {"moderate": 1.8, "light": 1.1, "smooth": 0.6}  # of lines, points
Results = Mapping[str, Any]


def verdicts_table(results: Results, air: str) -> list[str]:
    """A row for each requirement and design."""
    cases = {design: results[Case(design, air).name] for design in DESIGNS}
    one = next(iter(cases.values()))
    share, sure = f"{100 * one['success']:g} %", f"{100 * one['confidence']:g} %"
    head = (
        "requirement", "limit", "design", "median", f"{share} of flights stay within, at {sure} confidence", "worst",
        "in run", "failed", f"met by, % of flights (each bound at {sure})", "verdict",
    )  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|---|---:|---|---:|---:|---:|---:|---:|---:|---|"]
    for number, requirement in enumerate(one["requirements"]):
        for design, case in cases.items():
            r = case["requirements"][number]
            shown, worst = r["shown"], r["worst"]
            met = [100.0 * shown[key] for key in ("success", "success_least", "success_most")]
            unit = "" if r["unit"] in ("", "1") else f" {r['unit']}"
            cells = [
                requirement["name"] if design == DESIGNS[0] else "",
                f"{r['bound']:g}{unit}" if r["metric"] and design == DESIGNS[0] else "",
                design.removeprefix("ksr3-"),
                _number(r["median"]),
                _number(r["tolerance"]),
                _number(worst["value"]) if worst else "",
                str(worst["run"]) if worst else "",
                f"{shown['failures']} of {shown['runs']}",
                "{:.2f} ({:.2f} to {:.2f})".format(*met),
                _verdict(shown),
            ]
            lines.append("| " + " | ".join(cells) + " |")
    return [*lines, "", *[f"    {case['command']}" for case in cases.values()]]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def _verdict(shown: Mapping[str, Any]) -> str:
    if shown["judgement"] in (MET, NOT_MET):
        return f"**{shown['judgement']}**"
    return f"open: {shown['more']} more without failure"


def exceedance_picture(results: Results, stem: Path) -> None:
    """The share of flights in which a metric reaches a value, both designs, all kinds of air."""
    figure, places = sheet(2, 3, height_in=2.3)
    for place, name in zip(places, SHOWN, strict=True):
        for air, width in WIDTHS.items():
            for design in DESIGNS:
                if Case(design, air).name not in results:
                    continue
                case = results[Case(design, air).name]
                r = next(r for r in case["requirements"] if r["name"] == name)
                colour, dashes = LOOKS[design]
                scale = 1e-3 if r["unit"].startswith("Pa") else 1.0
                place.plot(
                    [scale * value for _, value in r["exceedance"]], [100.0 * share for share, _ in r["exceedance"]],
                    color=colour, linestyle=dashes, linewidth=width, label=f"{design.removeprefix('ksr3-')}, {air}",
                )  # fmt: skip
        place.axvline(scale * r["bound"], color=RED, linewidth=1.0)
        place.axhline(100.0 * (1.0 - case["success"]), color=RED, linewidth=0.7, linestyle=":")
        place.set_yscale("log")
        plain_numbers(place.yaxis)
        place.set_ylim(0.04, 120.0)
        label(place, f"k{r['unit']}" if scale != 1.0 else r["unit"], "% of flights", name)
    places[1].legend(loc="lower center", fontsize=6)
    save(figure, stem)


def envelopes_picture(results: Results, stem: Path) -> None:
    """Percentiles over time in moderate air: 99.73 % of the flights at each time, and the middle one."""
    figure, places = sheet(2, 2, height_in=2.2)
    for place, channel in zip(places, ENVELOPES, strict=True):
        for design in DESIGNS:
            case = results[Case(design, "moderate").name]
            band = next(b for b in case["envelopes"] if b["channel"] == channel)
            low, *_, high = band["lines"]
            middle = band["lines"][len(band["lines"]) // 2]
            scale = 1e-3 if channel.endswith("_Padeg") else 1.0
            colour, dashes = LOOKS[design]
            for line, width in ((low, 0.8), (middle, 1.6), (high, 0.8)):
                place.plot(band["time_s"], [scale * v for v in line], color=colour, linestyle=dashes, linewidth=width,
                           label=design.removeprefix("ksr3-") if line is middle else None)  # fmt: skip
        name = channel.rpartition("_")[0].replace("_", " ")
        label(place, "time, s", "kPa deg" if scale != 1.0 else "deg", name)
    places[0].legend(loc="upper left")
    save(figure, stem)


def drivers_picture(results: Results, stem: Path) -> None:
    """Rank correlations of the robust design's strongest inputs."""
    drivers = results[Case("ksr3-robust", "moderate").name]["drivers"]
    names = [name for name in SHOWN if name in drivers][:4]
    figure, places = sheet(2, 2, height_in=1.7)
    for place, name in zip(places, names, strict=False):
        found = drivers[name][::-1]
        place.barh(range(len(found)), [d["rank"] for d in found], color=BLUE, height=0.7)
        place.set_yticks(range(len(found)), [_short(d["input"]) for d in found])
        place.axvspan(-found[0]["noise"], found[0]["noise"], color="#777777", alpha=0.3, linewidth=0)
        place.set_xlim(-1.0, 1.0)
        label(place, "rank correlation", "", name)
    save(figure, stem)


def _short(name: str) -> str:
    """An input as it fits beside a bar: a wind's component and altitude without the key."""
    return name.removeprefix("wind.profile.").replace("_mps[", " ").removesuffix("]")
