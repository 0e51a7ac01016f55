"""The command `simdesign open DESIGN`: a workbench served to a browser on this machine.

The server listens on 127.0.0.1 only. Its address contains a random token, and requests with another token, host or
origin are rejected, so that neither other users nor other web pages reach it. The page uses nothing from elsewhere.
"""

from __future__ import annotations

import contextlib
import json
import secrets
import threading
from collections.abc import Iterator, Mapping
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from maxq.design import operating_points
from maxq.design.laws.design_file import DESIGN_NAME, design_path, load_design
from maxq.design.model.instruments import Plane
from maxq.design.model.operating_point import OperatingPoint
from maxq.sim.files import check_writable
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.files import builtin_files
from maxq.sim.scenario.loader import read_design
from maxq.sim.scenario.schema_design import Design
from maxq.tools.cli.frame import CommandError, Exit
from maxq.tools.cli.terminal import Progress, tell
from maxq.tools.design.analyse import bases_of, by_basis, designed_along, load, operating_points_s
from maxq.tools.design.points import kind_of_points, points_of
from maxq.tools.design.report import AnalysisOrder
from maxq.tools.design.workbench import RequestError, Workbench
from maxq.tools.plots.figures import plain

LOCAL = "127.0.0.1"
_MOST_BYTES = 1 << 20  # of a request
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; connect-src 'self'; "
    "form-action 'none'; base-uri 'none'"
)


class WorkbenchServer:
    """A workbench that a browser on this machine can use while the object is open.

    `url` is its address with the token. In a notebook, the object is shown as the page, if the notebook's browser runs
    on the machine of its kernel.
    """

    def __init__(self, workbench: Workbench, port: int = 0) -> None:
        """Start the server at a port, or at a free one for 0. Raises CommandError for a port that is in use."""
        self.workbench, self._lock, self._token = workbench, threading.Lock(), secrets.token_urlsafe(24)
        self.latest: dict[str, float] = {}  # edits of the last request
        try:
            self._server = ThreadingHTTPServer((LOCAL, port), self._handler())
        except (OSError, OverflowError) as problem:
            raise CommandError(
                f"--port {port}: cannot be used ({problem}); allowed is a free port, 1024 to 65535"
            ) from None
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        threading.Thread(target=self._server.serve_forever, name="workbench", daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://{LOCAL}:{self.port}/{self._token}/"

    @property
    def trial(self) -> Design:
        """Return the design with the values last shown on the page."""
        return self.workbench.trial(self.latest)

    def save(self, path: str | Path) -> Path:
        """Save the trial last shown on the page as a design file. Return the path. Raises RequestError."""
        return self.workbench.save(self.latest, str(path))

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" title="workbench" style="width: 100%; height: 60rem; border: 0"></iframe>'

    def answer(self, path: str, body: bytes = b"") -> tuple[int, str, bytes]:
        """Return status, content type and content for a path below the token; `body` is the body of a POST."""
        try:
            with self._lock:  # one computation at a time
                if path == "":
                    return 200, "text/html; charset=utf-8", self._page().encode()
                request = json.loads(body)
                if not isinstance(request, dict):
                    raise RequestError("allowed is a JSON object")
                if path == "show":
                    found = self.workbench.show(request)
                    self.latest = dict(request.get("edits", {}))
                    return _as_json(200, found)
                if path == "save":
                    saved = self.workbench.save(request.get("edits", {}), str(request.get("name", "")))
                    return _as_json(200, {"saved": str(saved)})
        except (RequestError, json.JSONDecodeError, UnicodeDecodeError) as problem:
            return _as_json(400, {"error": str(problem)})
        return _as_json(404, {"error": "no such page"})

    def _page(self) -> str:
        from maxq.tools.pages.render import render, script_file  # noqa: PLC0415  # lazy: Jinja

        setting = self.workbench.setting()
        begin = {"point": setting["first"], "plane": setting["planes"][0], "kind": setting["kind"], "reference": True}
        shown = self.workbench.show(begin)
        return render(
            "workbench.html.j2",
            self.workbench.plots(shown),
            name=self.workbench.name,
            setting=json.dumps(plain(setting)).replace("<", "\\u003c"),
            shown=json.dumps(plain(shown)).replace("<", "\\u003c"),
            workbench_script=script_file("workbench.js"),
        )

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        owner = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"  # one connection for all requests
            disable_nagle_algorithm = True
            wbufsize = -1

            def do_GET(self) -> None:
                self._respond(b"")

            def do_POST(self) -> None:
                length = self.headers.get("Content-Length", "")
                if not length.isdecimal() or int(length) > _MOST_BYTES:
                    self.close_connection = True
                    self._write(413, "text/plain", b"too large")
                    return
                self._respond(self.rfile.read(int(length)))

            def _respond(self, body: bytes) -> None:
                start, hosts = f"/{owner._token}/", {f"{LOCAL}:{owner.port}", f"localhost:{owner.port}"}
                origin = self.headers.get("Origin")
                local = self.headers.get("Host") in hosts and (
                    origin is None or origin.removeprefix("http://") in hosts
                )
                if not local or not secrets.compare_digest(self.path[: len(start)].encode(), start.encode()):
                    self._write(403, "text/plain", b"forbidden")
                    return
                self._write(*owner.answer(self.path[len(start) :], body))

            def _write(self, status: int, kind: str, content: bytes) -> None:
                self.send_response(status)
                for name, value in (
                    ("Content-Type", kind),
                    ("Content-Length", str(len(content))),
                    ("Content-Security-Policy", _POLICY),
                    ("Referrer-Policy", "no-referrer"),
                    ("X-Content-Type-Options", "nosniff"),
                    ("Cache-Control", "no-store"),
                ):
                    self.send_header(name, value)
                self.end_headers()
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the page was closed
                    self.wfile.write(content)
                    self.wfile.flush()

            def log_message(self, format: str, *args: Any) -> None:  # its name in the base class
                """Suppress the message."""

        return Handler


def _as_json(status: int, value: Any) -> tuple[int, str, bytes]:
    return status, "application/json", json.dumps(plain(value), separators=(",", ":")).encode()


def workbench_of(order: AnalysisOrder, also: tuple[str, ...] = (), folder: str | None = None) -> Workbench:
    """Return the workbench of a design at the operating points that `simdesign analyse` would use.

    `also` are designs to compare with, and `folder` is where trials are saved. Raises ScenarioError and CommandError.
    """
    path, points = Path(order.design), points_of(order)
    name = path.parent.name if path.name == DESIGN_NAME and path.parent.name else path.name.removesuffix(".toml")
    place = Path(folder or ".")
    check_writable(place)
    opened = Path(design_path(order.design))
    opened = builtin_files("design").get(order.design, opened)
    nodes: Mapping[Plane, list[OperatingPoint]]
    if points is not None:
        from maxq.design.model.given_file import read_points  # noqa: PLC0415  # lazy: with points only

        read, design = read_points(points), read_design(_found(order.design))
        kind = kind_of_points(order, read, design)
        times = order.times_s or read.times_s
        try:
            nodes = {read.plane: [read.point(t) for t in dict.fromkeys(times)]}
        except ValueError as problem:
            raise ScenarioError(points, str(problem)) from None
        others = {one: read_design(_found(one)) for one in also}
    else:
        if "scenario" not in order.given:
            order = replace(order, scenario=designed_along(order.design))
        scenario, design = load(order.scenario, order.vehicle, order.design)
        bases = bases_of(scenario, design, path.name)
        order = by_basis(order, bases)
        kind = order.kind
        times_s = operating_points_s(scenario, design, order, bases)
        planes: tuple[Plane, ...] = (order.axis, "yaw" if order.axis == "pitch" else "pitch")
        try:
            nodes = {
                plane: list[OperatingPoint](
                    operating_points.nodes(scenario, times_s, plane=plane, errata=order.errata, plant=order.plant)
                )
                for plane in planes
            }
        except ValueError as problem:
            raise ScenarioError(scenario.label, str(problem)) from None
        others = {one: load_design(design_path(one), scenario) for one in also}
    return Workbench(name, design, nodes, kind, others, place, opened)


def _found(name: str) -> str:
    """Return the name of a design, or the path of its file. Raises ScenarioError if there is none."""
    path = design_path(name)
    return name if name in builtin_files("design") else path


def execute(
    order: AnalysisOrder, also: tuple[str, ...] = (), folder: str | None = None, port: int = 0, browser: bool = True
) -> int:
    """Serve a workbench until Ctrl-C. Return the exit code."""
    with Progress() as progress:
        progress.show("linearising at the operating points", 0, 0)
        workbench = workbench_of(order, also, folder)
        server = WorkbenchServer(workbench, port)
    tell(f"open {server.url}", "Ctrl-C ends it")
    if browser:
        import webbrowser  # noqa: PLC0415  # lazy

        threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt), _closing(server):
        threading.Event().wait()
    tell(f"closed; {len(workbench.saved)} design{'s' * (len(workbench.saved) != 1)} saved", *map(str, workbench.saved))
    return Exit.OK


@contextlib.contextmanager
def _closing(server: WorkbenchServer) -> Iterator[None]:
    try:
        yield
    finally:
        server.close()
