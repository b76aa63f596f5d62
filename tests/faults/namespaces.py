"""Machines of one network as network namespaces of this machine, whose cables can be pulled; needs root and `ip`."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Iterator


class Network:
    """A bridge, at which this machine has the address `host`; see `network`."""

    def __init__(self) -> None:
        # Two runs at once have two networks.
        self._subnet = f"10.213.{os.getpid() % 256}"
        self.host = f"{self._subnet}.1"
        # Names of links have 15 characters at most.
        self._mark = f"tj{os.getpid() % 100_000}"
        self.bridge = f"{self._mark}b"
        self._names: list[str] = []

    def add(self) -> int:
        """Add a machine; return its number."""
        number = len(self._names) + 1
        name, ours, theirs = f"{self._mark}n{number}", self._cable(number), f"{self._mark}t{number}"
        self._names.append(name)
        _ip("netns", "add", name)
        _ip("link", "add", ours, "type", "veth", "peer", "name", theirs, "netns", name)
        _ip("link", "set", ours, "master", self.bridge, "up")
        _ip("-n", name, "addr", "add", f"{self.host_of(number)}/24", "dev", theirs)
        _ip("-n", name, "link", "set", theirs, "up")
        _ip("-n", name, "link", "set", "lo", "up")
        return number

    def host_of(self, number: int) -> str:
        """The address of a machine."""
        return f"{self._subnet}.{number + 1}"

    def prefix(self, number: int) -> tuple[str, ...]:
        """The command that runs the rest of its arguments on a machine."""
        return ("ip", "netns", "exec", self._names[number - 1])

    @contextlib.contextmanager
    def cut(self, number: int) -> Iterator[None]:
        """Pull a machine's cable for the block: what is sent is lost, and nobody is told."""
        _ip("link", "set", self._cable(number), "nomaster")
        try:
            yield
        finally:
            _ip("link", "set", self._cable(number), "master", self.bridge)

    def _cable(self, number: int) -> str:
        return f"{self._mark}c{number}"

    def remove(self) -> None:
        """Take it all down."""
        for number, name in enumerate(self._names, start=1):
            _ip("link", "del", self._cable(number))
            _ip("netns", "del", name)
        _ip("link", "del", self.bridge)


@contextlib.contextmanager
def network() -> Iterator[Network]:
    """Have a network for the block.

    Raises:
        subprocess.CalledProcessError: This is not root, or `ip` can't make namespaces here.
    """
    found = Network()
    _ip("link", "add", found.bridge, "type", "bridge")
    try:
        _ip("addr", "add", f"{found.host}/24", "dev", found.bridge)
        _ip("link", "set", found.bridge, "up")
        yield found
    finally:
        found.remove()


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)
