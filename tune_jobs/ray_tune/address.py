"""Check a cluster's address before Ray is imported, because Ray would retry a dead one for minutes."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path
from urllib.parse import urlsplit

from policies.errors import CannotRunError, SpecError

_CLIENT_SCHEME = "ray"
_DEFAULT_CLIENT_PORT = 10001
_CONNECT_TIMEOUT_S = 10.0
_FORMS = "Give `auto`, HOST:PORT (`ray start` prints it) or ray://HOST:PORT, or leave --address out to run here."


def check_address(address: str) -> None:
    """Check the form of an address, and that something listens there.

    Args:
        address: `auto`, `host:port` or `ray://host:port`.

    Raises:
        SpecError: The address has another form.
        CannotRunError: Nothing listens there; with `auto`, no cluster is known on this machine.
    """
    where = ""
    if address == "auto":
        address, where = _find_cluster()
    host, port = _host_and_port(address, where)
    try:
        socket.create_connection((host, port), timeout=_CONNECT_TIMEOUT_S).close()
    except OSError as error:
        reason = error.strerror or str(error)
        raise CannotRunError(
            f"No Ray cluster answers at {address}{where}: {reason}.",
            "Check that it runs (`ray status` on its head), that the address is right, and that the port is open.",
        ) from error


def check_form(address: str) -> None:
    """Check only the form of an address, because the cluster may not be there yet.

    Raises:
        SpecError: The address has another form than `auto`, `host:port` or `ray://host:port`.
    """
    if address != "auto":
        _host_and_port(address, "")


def place_of(address: str) -> tuple[str, int]:
    """Return the host and the port of an address; those of `auto` are the known cluster's.

    Raises:
        SpecError: The address has another form than `auto`, `host:port` or `ray://host:port`.
        CannotRunError: With `auto`, no cluster is known on this machine.
    """
    where = ""
    if address == "auto":
        address, where = _find_cluster()
    return _host_and_port(address, where)


def is_for_clients(address: str) -> bool:
    """Whether an address is that of the port for Ray clients; that of `auto` may be, as RAY_ADDRESS says.

    Raises:
        CannotRunError: With `auto`, no cluster is known on this machine.
    """
    if address == "auto":
        address, _ = _find_cluster()
    return address.startswith(f"{_CLIENT_SCHEME}://")


def recorded_cluster() -> str | None:
    """Return the address of the cluster that `ray start` last started or joined on this machine, if it is recorded."""
    try:
        return _record_path().read_text(encoding="utf-8").strip() or None
    except OSError:
        return None


def named_cluster() -> str | None:
    """Return the address of a cluster that RAY_ADDRESS names; `auto` is none, which Ray looks for as without it."""
    address = os.environ.get("RAY_ADDRESS")
    return None if address == "auto" else address or None


def rays_folder() -> Path:
    """Return the folder where a Ray that is started on this machine has its sockets and logs."""
    # As Ray 2.60 finds it (ray._common.utils.get_default_ray_temp_dir), without importing ray.
    its_own = os.environ.get("TMPDIR") if sys.platform == "linux" else None
    return Path(os.environ.get("RAY_TMPDIR") or its_own or "/tmp", "ray")  # noqa: S108 (Ray's own default)


def _record_path() -> Path:
    # The file where Ray 2.60 keeps it (ray._common.utils.get_ray_address_file).
    return rays_folder() / "ray_current_cluster"


def _find_cluster() -> tuple[str, str]:
    """Return the address that `auto` means, and words for messages that say where it comes from."""
    address = named_cluster()
    if address is not None:
        return address, " (from RAY_ADDRESS)"
    address = recorded_cluster()
    if address is None:
        # Ray would now join any Ray among this machine's processes, such as that of another sweep, which ends with it.
        raise CannotRunError(
            "No Ray cluster is known on this machine: RAY_ADDRESS names none, and `ray start` left no address in "
            f"{_record_path()}.",
            "Start one (`ray start --head`), name it with --address HOST:PORT or ray://HOST:PORT, or leave --address "
            "out to run on this machine alone.",
        )
    return address, f" (from {_record_path()})"


def _host_and_port(address: str, where: str) -> tuple[str, int]:
    scheme, _, rest = address.rpartition("://")
    try:
        parts = urlsplit(f"//{rest}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if scheme == _CLIENT_SCHEME and port is None:
        port = _DEFAULT_CLIENT_PORT
    if scheme not in ("", _CLIENT_SCHEME) or not host or port is None:
        raise SpecError(f"{address!r}{where} is not the address of a Ray cluster.", _FORMS)
    return host, port
