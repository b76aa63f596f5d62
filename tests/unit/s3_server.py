"""An S3 server on this machine, for the tests of the object store: moto's, which has conditional writes."""

import atexit
import functools
import logging
import os
import urllib.request

BUCKET = "sweeps"


@functools.cache
def s3_endpoint() -> str:
    """Start the server in this process, with one bucket, and return its address; it ends with the process."""
    from moto.server import ThreadedMotoServer

    os.environ |= {"AWS_ACCESS_KEY_ID": "tests", "AWS_SECRET_ACCESS_KEY": "tests"}
    # Its server says each request.
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    atexit.register(server.stop)
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    request = urllib.request.Request(f"{endpoint}/{BUCKET}", method="PUT")
    with urllib.request.urlopen(request, timeout=60):
        return endpoint
