"""The export of channels as tables, for a flight and for its log."""

from __future__ import annotations

import difflib
import html
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.files import whole_file
from maxq.sim.flight.channels import ChannelTable

if TYPE_CHECKING:
    import pandas as pd


class Tabular(ABC):
    """A source of channels by name, such as a flight or its log, with exports to tables and files.

    In its methods, `names` are channels or topics ("/truth"); without names, all channels are exported. Raises KeyError
    for an unknown name.
    """

    table: ChannelTable

    @abstractmethod
    def __getitem__(self, channel: str) -> Array: ...

    @abstractmethod
    def time_s(self, channel: str) -> Array: ...

    @property
    def topics(self) -> tuple[str, ...]:
        """Return the names of the topics, such as "/truth"."""
        return tuple(topic.name for topic in self.table.topics)

    @property
    def channels(self) -> tuple[str, ...]:
        """Return the names of all channels, topic by topic."""
        return self.table.names

    def topic(self, name: str) -> Mapping[str, Array]:
        """Return the values (n,) of all channels of a topic, by name; raise KeyError for an unknown topic."""
        return {channel: self[channel] for channel in self.channels_in((name,))}

    def to_pandas(self, *names: str) -> pd.DataFrame:
        """Return a data frame with a column for each channel over `time_s`.

        Channels of a slower rate are NaN between their times. Requires pandas.
        """
        import pandas as pd  # noqa: PLC0415  # optional: nothing here needs it

        frames = []
        for group in self._groups(names):
            index = pd.Index(self.time_s(group[0]), name="time_s")
            frames.append(pd.DataFrame({name: self[name] for name in group}, index=index))
        return frames[0] if len(frames) == 1 else pd.concat(frames, axis=1)

    def to_xarray(self, *names: str) -> Any:
        """Return the table of `to_pandas` as an `xarray.Dataset`, with the unit and description of each channel.

        Requires pandas and xarray.
        """
        data = self.to_pandas(*names).to_xarray()
        for name in data:
            channel = self.table.channel(str(name))
            data[name].attrs = {"units": channel.unit, "long_name": channel.description}
        return data

    def to_csv(self, path: str | Path, *names: str) -> Path:
        """Write a CSV file with `time_s` and a column for each channel, with all digits, and return its path.

        Cells are empty where a slower channel has no value. Raises FileError if the file cannot be written.
        """
        groups = self._groups(names)
        times = np.unique(np.concatenate([self.time_s(group[0]) for group in groups]))
        columns = [[repr(float(t)) for t in times]]
        for group in groups:
            rows = np.searchsorted(times, self.time_s(group[0]))
            for name in group:
                column = np.full(len(times), "", object)
                column[rows] = [repr(value) for value in self[name].tolist()]
                columns.append(column.tolist())
        head = ["time_s", *(name for group in groups for name in group)]
        with whole_file(Path(path)) as part, part.open("w", encoding="utf-8", newline="\n") as file:
            file.writelines(",".join(row) + "\n" for row in (head, *zip(*columns, strict=True)))
        return Path(path)

    def to_mat(self, path: str | Path, *names: str) -> Path:
        """Write a MATLAB file (.mat, version 5), and return its path.

        It contains a struct for each rate group (`fast`, `slow`) with columns (n, 1): `time_s` and the channels. The
        structs `units` and `descriptions` contain the texts of each channel. Names have at most 63 characters. Raises
        FileError if the file cannot be written, and ValueError for a longer name.
        """
        from scipy.io import savemat  # noqa: PLC0415  # lazy: rarely needed

        groups = self._groups(names)
        exported = [self.table.channel(name) for group in groups for name in group]
        content: dict[str, Any] = {
            self.table.topic(group[0]).group: {"time_s": self.time_s(group[0])} | {name: self[name] for name in group}
            for group in groups
        }
        content["units"] = {channel.name: channel.unit for channel in exported}
        content["descriptions"] = {channel.name: channel.description for channel in exported}
        with whole_file(Path(path)) as part:
            savemat(str(part), content, appendmat=False, long_field_names=True, oned_as="column")
        return Path(path)

    def to_hdf5(self, path: str | Path, *names: str) -> Path:
        """Write an HDF5 file, and return its path. Requires h5py (`maxq[hdf5]`).

        It contains a group for each rate (`fast`, `slow`) with the dataset `time_s` and one for each channel, all
        float64 (n,). Their attributes are `units`, `long_name` and, for channels, `topic`. Raises FileError if the file
        cannot be written, and ImportError without h5py.
        """
        import h5py  # noqa: PLC0415  # an extra

        groups = self._groups(names)
        with whole_file(Path(path)) as part, h5py.File(part, "w") as file:
            for group in groups:
                place = file.create_group(self.table.topic(group[0]).group)
                time_s = place.create_dataset("time_s", data=self.time_s(group[0]), compression="gzip", shuffle=True)
                time_s.attrs.update({"units": "s", "long_name": "time on the vehicle clock"})
                for name in group:
                    channel, data = self.table.channel(name), np.asarray(self[name], np.float64)
                    column = place.create_dataset(name, data=data, compression="gzip", shuffle=True)
                    about = {"units": channel.unit, "long_name": channel.description}
                    column.attrs.update(about | {"topic": self.table.topic(name).name})
        return Path(path)

    def channels_in(self, names: Sequence[str]) -> list[str]:
        """Return the names of channels for names of channels and topics, without repetition. Raises KeyError."""
        known = {topic.name: [channel.name for channel in topic.channels] for topic in self.table.topics}
        for name in names:
            if name not in known and name not in self.table:
                raise self._unknown(name)
        return list(dict.fromkeys(c for name in names for c in known.get(name, [name])))

    def _unknown(self, name: str) -> KeyError:
        near = difflib.get_close_matches(name, [*self.channels, *self.topics], 1)
        hint = f"did you mean {near[0]}?" if near else f"topics: {', '.join(self.topics)}"
        return KeyError(f"no channel or topic {name}; {hint}")

    def _groups(self, names: Sequence[str]) -> list[list[str]]:
        """Return the names of the channels (default: all), grouped by rate."""
        wanted, groups = self.channels_in(names) if names else list(self.table.names), dict[str, list[str]]()
        for name in wanted:
            groups.setdefault(self.table.topic(name).group, []).append(name)
        return list(groups.values())


def html_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return an HTML table with a title for a notebook."""
    cells = [[html.escape(cell) for cell in row] for row in (head, *rows)]
    lines = [
        "".join(f"<{tag}>{cell}</{tag}>" for cell in row)
        for row, tag in zip(cells, ["th", *["td"] * len(rows)], strict=True)
    ]
    return f"<b>{html.escape(title)}</b><table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"
