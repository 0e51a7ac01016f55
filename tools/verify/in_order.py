"""Candidates verified in order of merit until one is accepted: so design and verification close the loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from maxq.design.case.design_file import design_path
from maxq.design.verify.memory import default_folder
from maxq.design.verify.suite import ACCEPTED, read_suite
from maxq.design.verify.verify import Verification, Watch, verify
from maxq.tools.verify import text


def try_in_order(
    designs: Sequence[str],
    suite: str = "standard",
    overrides: Iterable[str] = (),
    *,
    tell: Callable[[str], None] = print,
    keep: Callable[[str, Verification], None] = lambda design, found: None,
    watch: Watch = lambda what, done, of: None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[str | None, list[Verification]]:
    """Verify one design after the other, and end with the first that is accepted.

    `designs` as for `simverify`, the most wanted first. `tell` gets, line by line, the verdict on each and what it
    failed; `keep` each verification as soon as it is there. An undecided design is not accepted: the next one is
    tried. Returns the accepted design, or None, and all that was found. Raises ScenarioError before anything is flown,
    KeyboardInterrupt soon after `stop` says True.
    """
    loaded, paths = read_suite(suite, overrides), [design_path(design) for design in designs]
    every: list[Verification] = []
    for design, path in zip(designs, paths, strict=True):
        found = verify(path, loaded, memory=default_folder(), watch=watch, stop=stop)
        every.append(found)
        keep(design, found)
        for line in (text.headline(found, design), *text.reasons(found)):
            tell(line)
        if found.judgement == ACCEPTED:
            return design, every
    return None, every
