"""In the place of the dashboard's agent, which a Ray that is started for a local sweep has no use for.

A raylet (Ray 2.60) starts no worker until its agent has said in files at which ports it listens, and ends when the
agent does. The real one takes most of a second for that, to serve a dashboard that is not there. This one says that it
listens nowhere, as the real one does where Ray was installed without what the dashboard needs, and then only waits.

It is run by its path, so that it loads nothing else of this package.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

_PORTS = ("metrics_agent_port", "metrics_export_port", "dashboard_agent_listen_port")
_NOWHERE = "-1"
_INTERVAL_S = 1.0


def main() -> None:
    """Say that this listens nowhere, and end with the raylet."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    parser.add_argument("--session-dir", type=Path, required=True)
    parser.add_argument("--node-id", required=True)
    options, _ = parser.parse_known_args()
    raylet = os.getppid()
    for name in _PORTS:
        told = options.session_dir / f"{name}_{options.node_id}"
        # The raylet looks for it continually, and must not see it empty.
        unfinished = told.with_suffix(".new")
        unfinished.write_text(_NOWHERE, encoding="ascii")
        unfinished.replace(told)
    while os.getppid() == raylet:
        time.sleep(_INTERVAL_S)


if __name__ == "__main__":
    main()
