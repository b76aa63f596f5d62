"""The clusters that a user has named, and so may be shown Ray's token; this module imports no ray.

A sweep's record names the address of the job that drove it, and somebody else may have written that record: whoever
only looks at the sweep would send the token of their own cluster there.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterable
from pathlib import Path

from policies.files import read_regular

_NAMING = ("RAY_API_SERVER_ADDRESS", "RAY_ADDRESS")
"""The variables by which Ray is told of a Jobs API; of other forms of RAY_ADDRESS the dashboard's port is not known."""
_PORTS = {"http": 80, "https": 443}
_MAX_BYTES = 2**20

_noted: set[str] = set()
"""Those that this process has noted, as the file may be one that it can't write."""


def origin_of(address: str) -> str | None:
    """Return scheme, host and port of an http:// or https:// address, as the client reads it that sends to it."""
    import httpx2

    try:
        url = httpx2.URL(address)
    except httpx2.InvalidURL:
        return None
    if url.scheme not in _PORTS or not url.host:
        return None
    return f"{url.scheme}://{url.host}:{url.port or _PORTS[url.scheme]}"


def is_named(address: str, named: Iterable[str] = ()) -> bool:
    """Whether this user has named the origin of an address, now or when a job was sent there.

    Args:
        address: That of a Jobs API, from a record.
        named: What the user has named it by, besides Ray's variables.
    """
    origin = origin_of(address)
    if origin is None:
        return False
    told = [*named, *(os.environ.get(name, "") for name in _NAMING)]
    return origin in _noted or origin in map(origin_of, told) or origin in _kept()


def note(address: str) -> None:
    """Keep for later commands of this user that the token was shown to an address which the user had named."""
    origin = origin_of(address)
    if origin is None:
        return
    _noted.add(origin)
    # A home folder that can't be written makes no error of a job that was sent: it has to be named again then.
    with contextlib.suppress(OSError, RuntimeError):
        if origin in _kept():
            return
        path = _path()
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        with os.fdopen(os.open(path, flags, 0o600), "ab") as file:
            # At once, as several processes may add to it.
            file.write(f"{origin}\n".encode())


def _kept() -> frozenset[str]:
    with contextlib.suppress(OSError, RuntimeError, ValueError):
        path = _path()
        found = path.lstat()
        # Somebody else's file, or one that others may write, says nothing of what this user has named.
        if stat.S_ISREG(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
            return frozenset(read_regular(path, _MAX_BYTES).decode().splitlines())
    return frozenset()


def _path() -> Path:
    given = os.environ.get("XDG_STATE_HOME", "")
    # As the XDG Base Directory Specification has it, a relative path counts as none.
    folder = Path(given) if Path(given).is_absolute() else Path.home() / ".local" / "state"
    return folder / "tune-jobs" / "clusters"
