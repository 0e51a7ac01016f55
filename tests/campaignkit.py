"""Build small campaigns: KSR-III ascents of a fraction of a second with a few dispersions."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

import maxq
from maxq import LoadedCampaign

HEAD = """\
schema = 1
extends = "nominal.toml"
unset = ["requirement"]
[run]
duration_s = 0.3
[campaign]
runs = {runs}
seed = 5
batch = 8
{campaign}
[campaign.envelope]
runs = 0
"""

INPUTS = """\
[[disperse]]
key = "vehicle.stage.0.engine.thrust_factor"
distribution = "normal"
three_sigma = 0.03
[[disperse]]
key = "vehicle.stage.0.mass.table.x_cg_m"
apply = "add"
distribution = "uniform"
low = -0.05
high = 0.05
[[disperse]]
keys = ["vehicle.stage.0.bending.frequency_factor.0", "vehicle.stage.0.bending.frequency_factor.1"]
distribution = "normal"
covariance = [[4e-4, 1e-4], [1e-4, 9e-4]]
[[disperse]]
key = "vehicle.stage.0.tank.1.damping_ratio"
apply = "scale"
distribution = "log-normal"
sigma = 0.3
[[disperse]]
key = "vehicle.computer.delay_s"
distribution = "triangular"
low = 0.0
mode = 0.003
high = 0.005
"""


def campaign_text(runs: int = 20, campaign: str = "", inputs: str = INPUTS, rest: str = "") -> str:
    return HEAD.format(runs=runs, campaign=campaign) + rest + inputs


def write_campaign(folder: Path, name: str = "small", **parts: object) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(campaign_text(**parts))  # type: ignore[arg-type]  # the keywords are those of campaign_text
    return path


def small(folder: Path, name: str = "small", **parts: object) -> LoadedCampaign:
    return maxq.load(write_campaign(folder, name, **parts))


def data_set(folder: Path) -> pa.Table:
    """Return all recorded data, in the order of the runs."""
    return pq.read_table(folder / "runs").sort_by("run").combine_chunks()


def data_set_of(folder: Path) -> pa.Table:
    """Return the data as `data_set` does, from a folder that also contains files that were set aside."""
    parts = [pq.read_table(part) for part in sorted((folder / "runs").glob("*.parquet"))]
    return pa.concat_tables(parts).sort_by("run").combine_chunks()


def same(a: pa.Table, b: pa.Table) -> bool:
    """Return True if both tables are bitwise equal; nan equals nan."""
    if a.schema != b.schema or len(a) != len(b):
        return False
    return all(
        x.view("i8").tolist() == y.view("i8").tolist() if x.dtype.kind == "f" else x.tolist() == y.tolist()
        for x, y in ((p.to_numpy(), q.to_numpy()) for p, q in zip(a.columns, b.columns, strict=True))
    )
