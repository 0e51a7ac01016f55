"""Is a flight the same as the one in a log? Judged by the hash of state, time, metrics and events."""

from __future__ import annotations

from maxq.sim.log.head import VERSION_KEY, LogError, maxq_version
from maxq.sim.log.reader import LoggedRun
from maxq.sim.run.fly import Flight, FlightRun
from maxq.sim.run.record import END_KEY, SCENARIO_ATTACHMENT, STATE_HASH_KEY


def scenario_text(logged: LoggedRun) -> str:
    """The scenario as flown that a log holds. Raises LogError where it holds none."""
    attachment = logged.attachments.get(SCENARIO_ATTACHMENT)
    if attachment is None:
        raise LogError(f"{logged.path}: the log holds no scenario ({SCENARIO_ATTACHMENT})")
    return attachment.data.decode(errors="replace")


class Comparison:
    """Takes the state hash at the instant at which the log ends, then says whether it is the log's."""

    def __init__(self, logged: LoggedRun | None, changed: bool = False) -> None:
        self._logged = logged
        self._changed = changed
        end = logged.end.get(END_KEY, "") if logged else ""
        self._end_ns = int(end) if end.isdecimal() else -1
        self._hash = ""

    def look(self, run: FlightRun) -> None:
        """Call before the flight and after every segment."""
        if int(run.memory.clock.now_ns) == self._end_ns:
            self._hash = run.state_hash()

    def verdict(self, flight: Flight) -> bool:
        """Print how the flight compares. False where it differs, or cannot be compared though it should."""
        if self._logged is None:
            return True
        path = self._logged.path
        if self._changed:
            print(f"not compared with {path}: --set changes the scenario")
            return True
        logged = self._logged.end.get(STATE_HASH_KEY)
        if logged is None or self._end_ns < 0:
            print(f"not compared with {path}: it was cut off and holds no final state")
            return False
        if flight.outcome == "interrupted" and not self._hash:
            print(f"not compared with {path}: interrupted before its end at {self._end_ns / 1e9:.3f} s")
            return False
        if self._hash == logged:
            early = "" if flight.end_ns == self._end_ns else f" at {self._end_ns / 1e9:.3f} s, where that ends"
            print(f"SAME as {path}: equal state, bit by bit{early} ({logged[:16]})")
            return True
        written_by = self._logged.metadata.get(VERSION_KEY, "")
        other = f"; that was flown by maxq {written_by}" if written_by != maxq_version() else ""
        mine = self._hash[:16] or f"none at {self._end_ns / 1e9:.3f} s"
        print(f"DIFFERENT from {path}: state hash {mine}, there {logged[:16]}{other}")
        return False
