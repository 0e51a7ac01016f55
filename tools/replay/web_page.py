"""The viewer's page for the browser, from this machine alone.

The viewer's own server sends a page that asks other machines for a font and tells its makers that it was opened. Here
the same page is passed on with a content security policy: the browser then talks to this machine and to no other.
"""

from __future__ import annotations

import http.client
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

LOCAL = "127.0.0.1"
_KEPT = ("content-type", "content-encoding", "cache-control", "etag")


def policy(grpc_port: int) -> str:
    """What the page may do: run the viewer it came with, and fetch the flight from its server."""
    here = "'self' data: blob:"
    return "; ".join(
        (
            f"default-src {here}",
            f"script-src {here} 'unsafe-inline' 'wasm-unsafe-eval'",
            f"style-src {here} 'unsafe-inline'",
            f"connect-src {here} http://{LOCAL}:{grpc_port}",
        )
    )


class LocalPage:
    """A server on `port` that passes on the page of the viewer's server on `inner_port`; ends with `close`."""

    def __init__(self, port: int, inner_port: int, grpc_port: int) -> None:
        rules = policy(grpc_port)

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                connection = http.client.HTTPConnection(LOCAL, inner_port, timeout=30)
                try:
                    connection.request("GET", self.path, headers={"Accept-Encoding": "identity"})
                    answer = connection.getresponse()
                    body = answer.read()
                except OSError:
                    self.send_error(502, "the viewer's server does not answer")
                    return
                finally:
                    connection.close()
                self.send_response(answer.status)
                for name, value in answer.getheaders():
                    if name.lower() in _KEPT:
                        self.send_header(name, value)
                self.send_header("Content-Length", str(len(body)))
                self.send_header("Content-Security-Policy", rules)
                self.send_header("Referrer-Policy", "no-referrer")
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: Any) -> None:  # its name in the base class
                """Say nothing."""

        self._server = ThreadingHTTPServer((LOCAL, port), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
