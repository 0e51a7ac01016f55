"""The subcommand `simrun calibrate CAMPAIGN FILE`: the dispersed numbers of a campaign fitted to measured series."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from maxq.control.kernel.machine import cores
from maxq.sim.campaign.calibration import (
    OBSERVED,
    Calibration,
    CalibrationOptions,
    CalibrationStopped,
    Parameter,
    calibrate,
    with_noise,
)
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.sim.files import check_writable, plain_name, write_whole
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import logged_channels, refuse_unstable_steps
from maxq.sim.run.measured import MeasuredSeries, read_measured
from maxq.sim.run.quantities import number_text, quantity
from maxq.tools.cli.frame import Exit, Interruption
from maxq.tools.cli.terminal import Progress, aligned, announce, printable, tell
from maxq.tools.pages.render import render
from maxq.tools.plots.residuals import residual_plots
from maxq.tools.simrun_compare import residual_rows, residual_table

SCENARIO_NAME, RECORD_NAME, TABLE_NAME, PAGE_NAME = (
    "calibrated.toml",
    "calibration.json",
    "residuals.csv",
    "calibration.html",
)
_FLIGHTS, _CLOSE, _UNEXPLAINED = "flights", 0.9, 1.5
"""The folder of stored flights; the correlation of values that only occur together; RMS over the noise that is too
large."""


def execute(
    campaign: str,
    measured: str,
    *,
    columns: str | None = None,
    alias: tuple[tuple[str, str], ...] = (),
    sigma: tuple[tuple[str, float], ...] = (),
    fit: tuple[str, ...] = (),
    shift: float = 0.0,
    shift_sigma: float = 0.0,
    overrides: tuple[str, ...] = (),
    workers: int | None = None,
    out: str | None = None,
) -> int:
    """Calibrate, write the scenario, the record and the page, print the parameters, and return the exit code."""
    announce(f"reading {campaign}")
    loaded = load_campaign(campaign, overrides)
    refuse_unstable_steps(loaded.base)
    folder = Path(out) if out is not None else Path("runs") / f"{plain_name(loaded.name, 'campaign')}-calibrated"
    table = logged_channels(loaded.base.scenario, pack_flight(loaded.base.scenario).sizes)
    series = with_noise(read_measured(measured, table, columns, dict(alias), dict(sigma)))
    check_writable(folder)
    with Interruption() as stop, Progress() as progress:

        def watch(iteration: int, cost: float, flights: int) -> None:
            note = f"sum of squares {cost:.4g} per value; {flights} flights"
            progress.show("calibrating", 0.0, 0.0, note, count=f"iteration {iteration}")

        progress.show("calibrating", 0.0, 0.0, count="first flights")
        options = CalibrationOptions(fit, shift, shift_sigma)
        try:
            found = calibrate(
                loaded, series, folder / _FLIGHTS, options, workers=workers or cores(), watch=watch, stop=stop
            )
        except CalibrationStopped:
            tell(f"INTERRUPTED: the flights so far are in {folder / _FLIGHTS}; the same command continues")
            return Exit.INTERRUPTED
    return _tell(loaded, series, found, folder, measured)


def _tell(loaded: LoadedCampaign, series: MeasuredSeries, found: Calibration, folder: Path, measured: str) -> int:
    """Write the files, print the result, and return the exit code."""
    outcome = _outcome(found)
    rows, others, fits = parameter_rows(found), nuisance_rows(found), _fit_rows(found)
    notes = notes_of(found)
    write_whole(folder / SCENARIO_NAME, found.scenario.as_flown, CampaignError)
    write_whole(folder / RECORD_NAME, json.dumps(_record(series, found, outcome), indent=1) + "\n", CampaignError)
    write_whole(folder / TABLE_NAME, residual_table(found.after), CampaignError)
    tables: list[tuple[Any, ...]] = [("Parameters", _meaning(), rows, (1, 2, 3, 4), "Estimates from the measurements.")]
    tables += [("Time shift and constant errors", "", others, (1, 2), "Errors of the measurement.")] * (len(others) > 1)
    tables += [("Correlations", "", _correlation_rows(found), tuple(range(1, 99)), "Posterior correlation.")]
    tables += [
        ("Fit", "", fits, (1, 2, 3), "RMS of the residuals."),
        ("Channels", "", residual_rows(found.after), (1, 2, 3, 4, 5, 6), "Residuals after the calibration."),
    ]
    page = render(
        "comparison.html.j2",
        residual_plots(found.after, found.before),
        kind="Campaign calibrated to measurements",
        title=str(loaded.name),
        facts=(("campaign", loaded.base.label), ("measured", measured), ("flights", str(found.flights))),
        outcome_line=outcome,
        tone="good" if found.converged else "bad",
        tables=tables,
    )
    files = [folder / name for name in (SCENARIO_NAME, RECORD_NAME, TABLE_NAME)]
    files.append(write_whole(folder / PAGE_NAME, page, CampaignError))
    shutil.rmtree(folder / _FLIGHTS, ignore_errors=True)
    tell(f"{loaded.name}, calibrated to {measured}", "", *aligned(rows, "  ", right=(1, 2, 3, 4), drop=(1,)))
    if len(others) > 1:
        tell("", *aligned(others, "  ", right=(1, 2)))
    tell("", *aligned(fits, "  ", right=(1, 2, 3)))
    for note in notes:
        tell(printable(note))
    tell("", *files, f"next: simrun {shlex.quote(str(folder / SCENARIO_NAME))}", "", outcome)
    return Exit.OK if found.converged else Exit.FAILED


def _outcome(found: Calibration) -> str:
    count, seen = len(found.parameters), sum(p.observed for p in found.parameters)
    spent = f"{found.iterations} iterations, {found.flights} new flights"
    if not found.converged:
        return f"FAILED: no convergence in {spent}; fewer parameters (--fit) or more noise (--sigma) may help"
    return f"CALIBRATED: {count} parameter{'s' * (count != 1)}, {seen} observable; {spent}"


def _meaning() -> str:
    return (
        "Estimates and standard deviations are those of the posterior distribution, with the dispersions of the "
        f"campaign as prior. A parameter that keeps more than {100 * OBSERVED:.0f} % of its prior standard deviation "
        "is not observable."
    )


def parameter_rows(found: Calibration) -> list[tuple[str, ...]]:
    """Return the table of parameters, with its heads first."""
    rows: list[tuple[str, ...]] = [("parameter", "prior", "estimate", "1 sigma", "of prior", "")]
    for p in found.parameters:
        sigma = f"{0.5 * (p.high - p.low):.3g}"
        seen = "" if p.observed else "not observable"
        cells = number_text(p.prior, 5), number_text(p.value, 5), sigma, f"{100.0 * p.share:.2g} %"
        rows.append((printable(p.label), *cells, seen))
    return rows


def nuisance_rows(found: Calibration) -> list[tuple[str, ...]]:
    """Return the table of time shift and constant errors, with its heads first."""
    rows: list[tuple[str, ...]] = [("measurement", "estimate", "1 sigma")]
    for name, unit, value, sigma in found.nuisances:
        rows.append((name, *(" ".join(quantity(x, unit)) for x in (value, sigma))))
    return rows


def _fit_rows(found: Calibration) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("channel", "noise, 1 sigma", "RMS before", "RMS after")]
    for after in found.after:
        before = next(each for each in found.before if each.name == after.name)
        values = after.measured.sigma, before.rms, after.rms
        rows.append((after.name, *(" ".join(quantity(x, after.measured.unit)).rstrip() for x in values)))
    return rows


def _correlation_rows(found: Calibration) -> list[tuple[str, ...]]:
    labels = [printable(p.label) for p in found.parameters]
    rows: list[tuple[str, ...]] = [("", *labels)]
    for label, row in zip(labels, found.correlation.tolist(), strict=True):
        rows.append((label, *(f"{x + 0.0:.2f}" for x in row)))
    return rows


def notes_of(found: Calibration) -> list[str]:
    """Return notes on parameters that only occur together, and on channels that the model does not explain."""
    notes = []
    labels = [p.label for p in found.parameters]
    for i, j in zip(*np.nonzero(np.triu(np.abs(found.correlation) > _CLOSE, 1)), strict=True):
        notes.append(f"{labels[i]} and {labels[j]}: correlation {found.correlation[i, j]:+.2f}, hardly separable")
    for each in found.after:
        ratio = each.rms / each.measured.sigma
        if ratio > _UNEXPLAINED:
            notes.append(
                f"warning: {each.name}: the RMS is {ratio:.3g} times the noise; the model does not explain the "
                "measurement, and the standard deviations are too small"
            )
    return notes


def _record(series: MeasuredSeries, found: Calibration, outcome: str) -> dict[str, Any]:
    def parameter(p: Parameter) -> dict[str, Any]:
        return {**vars(p), "observed": p.observed}

    return {
        "measured": series.file,
        "outcome": outcome.partition(":")[0],
        "iterations": found.iterations,
        "parameters": [parameter(p) for p in found.parameters],
        "correlation": found.correlation.tolist(),
        "measurement": [dict(zip(("name", "unit", "value", "sigma"), each, strict=True)) for each in found.nuisances],
        "before": [each.as_json() for each in found.before],
        "after": [each.as_json() | {"sigma": each.measured.sigma} for each in found.after],
        "notes": notes_of(found),
    }
