"""The results of a verification without its campaigns: all data from which its verdict and report follow.

A review pack contains them as a file. `simverify --check` derives every requirement from them again.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self, get_type_hints

from maxq.design.certificate.certificate import NodeCertificate
from maxq.design.certificate.in_flight import InFlightResponse
from maxq.design.certificate.measured_only import MeasuredNode
from maxq.design.verify.flown import FlownResult
from maxq.design.verify.linear import Authority, MarginStudy
from maxq.design.verify.memory import from_plain, text_of
from maxq.design.verify.slosh import SloshAdvice
from maxq.design.verify.uncovered import Uncovered
from maxq.design.verify.worst import WorstVehicle

MOST_BYTES = 2_000_000_000
"""The largest accepted size of the decompressed text."""


@dataclass(frozen=True)
class Results:
    """The results of flights, linear measures and measurements in flight.

    Parts that the suite does not require are empty.
    """

    flights: tuple[FlownResult, ...]
    margins: tuple[MarginStudy, ...]
    authority: tuple[Authority, ...]
    slosh: tuple[SloshAdvice, ...]
    worst: tuple[WorstVehicle, ...]
    certificates: tuple[NodeCertificate, ...]
    measured: tuple[MeasuredNode, ...]  # measurements of flight code without a linear model
    in_flight: tuple[InFlightResponse, ...]
    uncovered: tuple[Uncovered, ...]  # intervals without operating points

    def to_bytes(self) -> bytes:
        """Return all values, bit by bit, as compressed JSON."""
        return gzip.compress(text_of({f.name: list(getattr(self, f.name)) for f in fields(self)}), 1, mtime=0)

    @classmethod
    def from_bytes(cls, content: bytes) -> Self:
        """Return the results from the output of `to_bytes`. Raises ValueError for other content."""
        hints, out = get_type_hints(cls), dict[str, Any]()
        try:
            decompress = zlib.decompressobj(wbits=31)
            text = decompress.decompress(content, MOST_BYTES)
            parts: Mapping[str, Any] = from_plain(json.loads(text))
            for f in fields(cls):
                kind = hints[f.name].__args__[0]
                out[f.name] = tuple(parts[f.name])
                if not all(isinstance(item, kind) for item in out[f.name]):
                    raise ValueError(f"{f.name} has an item that is no {kind.__name__}")
        except (zlib.error, TypeError, KeyError, AttributeError, ImportError, RecursionError) as error:
            raise ValueError(f"no results of this version of simverify ({error!r})") from error
        return cls(**out)
