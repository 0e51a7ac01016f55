"""Operating points from systems of python-control and SciPy, and from MATLAB files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.given import DELTA, GivenPoint, point_of_matrices
from maxq.design.model.held import OUTPUTS, WIND
from maxq.design.model.instruments import ACCELERATION


def point_of_system(system: Any, *, variable: str | None = None, **more: Any) -> GivenPoint:
    """Return an operating point of a system of python-control or SciPy, or of a MATLAB file.

    `system` is a continuous system with attributes A, B, C and D, a transfer function, or the path of a file (.mat)
    with these variables. `variable` names a struct of the file that contains them. `state_names`, `input_names` and
    `output_names` of a file, and the labels of a python-control system, name states and signals if they are names of
    `point_of_matrices`. `more` contains its other arguments. Raises FileNotFoundError, and ValueError for a discrete
    system and for a file without these variables.
    """
    if isinstance(system, str | Path):
        given, names = _of_file(Path(system), variable)
    else:
        period = getattr(system, "dt", 0)
        if period not in (0, None):
            raise ValueError(f"dt = {period}: allowed is a continuous system; sample_s is the period of the computer")
        if not hasattr(system, "A"):
            import control  # noqa: PLC0415  # optional: only a transfer function needs it

            system = control.ss(system)
        given = [np.asarray(getattr(system, name), float) for name in "ABCD"]
        names = {key: getattr(system, f"{key[:-1]}_labels", None) for key in ("states", "inputs", "outputs")}
    for key, allowed in (("inputs", {DELTA, WIND}), ("outputs", {*OUTPUTS, ACCELERATION}), ("states", None)):
        found = names.get(key)
        if found is not None and key not in more and (allowed is None or set(found) <= allowed):
            more[key] = tuple(found)
    return point_of_matrices(*given, **more)


def _of_file(path: Path, variable: str | None) -> tuple[list[Array], dict[str, Any]]:
    from scipy.io import loadmat  # noqa: PLC0415  # lazy: 0.1 s

    with path.open("rb"):  # raises FileNotFoundError, which loadmat hides
        pass
    try:
        held = loadmat(str(path), appendmat=False, simplify_cells=True)
    except (ValueError, NotImplementedError, TypeError) as problem:
        raise ValueError(f"{path}: not a MATLAB file up to version 7.2 ({problem})") from None
    if variable is not None:
        if not isinstance(held.get(variable), dict):
            known = ", ".join(k for k, v in held.items() if isinstance(v, dict)) or "none"
            raise ValueError(f"{path}: variable = {variable!r} is no struct; in the file: {known}")
        held = held[variable]
    missing = [name for name in "ABCD" if name not in held]
    if missing:
        raise ValueError(f"{path}: has no {', '.join(missing)}; allowed are A, B, C, D, or a struct of them")
    n = round(np.size(held["A"]) ** 0.5)
    a, b, c = (np.asarray(held[name], float) for name in "ABC")
    d = np.asarray(held["D"], float)
    b, c = b.reshape(n, -1), c.reshape(-1, n)
    matrices = [a.reshape(n, n), b, c, d.reshape(c.shape[0], b.shape[1])]
    names = {f"{key}s": held.get(f"{key}_names") for key in ("state", "input", "output")}
    return matrices, {key: None if value is None else list(np.atleast_1d(value)) for key, value in names.items()}
