"""An S3 server on this machine, for the tests of the object store: moto's, which has conditional writes."""

import atexit
import functools
import logging
import os
import threading
import urllib.request
from collections.abc import Callable, Iterable
from typing import Any

BUCKET = "sweeps"


@functools.cache
def s3_endpoint() -> str:
    """Start the server in this process, with one bucket, and return its address; it ends with the process."""
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
    from werkzeug.serving import make_server

    os.environ |= {"AWS_ACCESS_KEY_ID": "tests", "AWS_SECRET_ACCESS_KEY": "tests"}
    # Its server says each request.
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    app = _one_write_at_a_time(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, app, threaded=True, request_handler=MotoRequestHandler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    atexit.register(server.shutdown)
    endpoint = f"http://127.0.0.1:{server.server_port}"
    request = urllib.request.Request(f"{endpoint}/{BUCKET}", method="PUT")
    with urllib.request.urlopen(request, timeout=60):
        return endpoint


def _one_write_at_a_time(app: Callable[..., Iterable[bytes]]) -> Callable[..., Iterable[bytes]]:
    """Return the server's app with writes that are done as a whole, as a store's are.

    moto looks whether a condition holds and writes later: of several threads that want to be the first, each may be.
    """
    lock = threading.Lock()

    def call(environ: dict[str, Any], start_response: Callable[..., object]) -> Iterable[bytes]:
        if environ["REQUEST_METHOD"] in ("GET", "HEAD"):
            return app(environ, start_response)
        with lock:
            return app(environ, start_response)

    return call
