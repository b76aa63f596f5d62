"""Starts Ray clusters of several nodes on this machine, each node a child process that is ended by its own id."""

import contextlib
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.kills.processes import end_with_parent

BIN = Path(sys.executable).parent
START_TIMEOUT_S = 180
STOP_TIMEOUT_S = 60
_MOST_STARTS = 4
# The least Ray takes; the weights of these trials are a few kilobytes.
OBJECT_STORE_BYTES = 100_000_000


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def _take_leave_with_parent() -> None:
    # `ray start` ends what it has started, at this signal.
    end_with_parent(signal.SIGTERM)


def kill_group(process: subprocess.Popen[Any]) -> None:
    """End a child, which leads a process group of its own, and its children, at once."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait(STOP_TIMEOUT_S)


def processes_naming(text: str) -> list[int]:
    """Ids of the running processes whose command line holds this text."""
    found = []
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if folder.name.isdigit() and text.encode() in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
    return found


@dataclass
class Node:
    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def wait_until_started(self) -> None:
        deadline = time.monotonic() + START_TIMEOUT_S
        while "Ray runtime started" not in self.log.read_text():
            assert self.process.poll() is None, f"node {self.name} ended:\n{self.log.read_text()}"
            assert time.monotonic() < deadline, f"node {self.name} did not start:\n{self.log.read_text()}"
            time.sleep(0.1)

    @property
    def node_id(self) -> str:
        """Ray's id of it, which its raylet, a child of `ray start`, was started with."""
        for listing in Path(f"/proc/{self.process.pid}/task").glob("*/children"):
            for child in listing.read_text().split():
                words = Path(f"/proc/{child}/cmdline").read_text().split("\0")
                found = [word.partition("=")[2] for word in words if word.startswith("--node_id=")]
                if found:
                    return found[0]
        raise AssertionError(f"node {self.name} has no raylet:\n{self.log.read_text()}")

    def stop(self) -> None:
        """As `ray stop` would: the node takes its leave of the cluster."""
        self.process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(STOP_TIMEOUT_S)
        kill_group(self.process)

    def crash(self) -> None:
        """As if its power failed."""
        kill_group(self.process)


class Cluster:
    """A head, and as many other nodes as a test starts; with Ray's token authentication on.

    Args:
        folder: For logs; the token and Ray's own files lie in a folder with a short name, as sockets' names are.
        host: The head's address.
    """

    def __init__(self, folder: Path, host: str = "127.0.0.1") -> None:
        self.folder, self.host = folder, host
        self.temporary = Path(tempfile.mkdtemp(prefix="tj", dir="/tmp"))
        token = self.temporary / "token"
        token.touch(mode=0o600)
        token.write_text(secrets.token_hex(32))
        self.port, self.client_port = free_port(), free_port()
        self.address = f"{host}:{self.port}"
        self.client_address = f"ray://{host}:{self.client_port}"
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("RAY_")},
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN_PATH": str(token),
            # Where Ray keeps its files, and the address of the cluster that `auto` means.
            "RAY_TMPDIR": str(self.temporary),
            # Where it is kept to which addresses jobs were sent with the token.
            "XDG_STATE_HOME": str(self.temporary / "state"),
            "RAY_USAGE_STATS_ENABLED": "0",
            # Else one `ray://` client in twenty is refused, half a minute after it asked (ray issue 63202).
            "GRPC_ENABLE_FORK_SUPPORT": "0",
            # A node that is gone is noticed in a few seconds instead of half a minute.
            "RAY_health_check_initial_delay_ms": "2000",
            "RAY_health_check_period_ms": "1000",
            "RAY_health_check_timeout_ms": "8000",
        }
        self.nodes: dict[str, Node] = {}

    def start_head(
        self,
        dashboard_port: int | None = None,
        *,
        num_cpus: int = 1,
        prefix: Sequence[str] = (),
        options: Sequence[str] = (),
        environment: dict[str, str] | None = None,
    ) -> Node:
        """Start the head; with a port, the dashboard answers there, and takes jobs.

        `prefix` and `environment` are as for a worker, `options` further ones of `ray start`.
        """
        self.jobs_address = f"http://127.0.0.1:{dashboard_port}"
        words = [
            "--head", f"--port={self.port}", f"--ray-client-server-port={self.client_port}",
            f"--dashboard-port={dashboard_port or free_port()}",
            f"--include-dashboard={'true' if dashboard_port else 'false'}",
            *self._at(self.host), *options,
        ]  # fmt: skip
        return self._start("head", words, num_cpus, prefix, environment or {})

    def start_worker(
        self,
        name: str,
        *,
        num_cpus: int = 1,
        prefix: Sequence[str] = (),
        environment: dict[str, str] | None = None,
        host: str = "127.0.0.1",
    ) -> Node:
        """Start a node; `prefix` is a command that runs the rest of its arguments, `host` the node's address."""
        options = [f"--address={self.address}", *self._at(host)]
        return self._start(name, options, num_cpus, prefix, environment or {})

    def _at(self, host: str) -> list[str]:
        # Ray takes 127.0.0.1 for no address that was given.
        return [] if host == "127.0.0.1" else [f"--node-ip-address={host}"]

    def _start(
        self, name: str, options: Sequence[str], num_cpus: int, prefix: Sequence[str], environment: dict[str, str]
    ) -> Node:
        log = self.folder / f"{name}.log"
        command = [
            *prefix, str(BIN / "ray"), "start", *options, f"--num-cpus={num_cpus}", "--num-gpus=0",
            f"--resources={json.dumps({name: 1})}", f"--object-store-memory={OBJECT_STORE_BYTES}",
            f"--dashboard-agent-listen-port={free_port()}", "--disable-usage-stats", "--block",
        ]  # fmt: skip
        for _ in range(_MOST_STARTS):
            with log.open("wb") as file:
                process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                    env={**self.environment, **environment}, start_new_session=True,
                    preexec_fn=_take_leave_with_parent,  # noqa: PLW1509 (it makes one system call)
                )  # fmt: skip
            node = self.nodes[name] = Node(name, process, log)
            try:
                node.wait_until_started()
                return node
            except AssertionError:
                # Ray gives up after 30 s, which a machine that does much else may take.
                if "timed out during startup" not in log.read_text():
                    raise
                kill_group(process)
        raise AssertionError(f"node {name} did not start:\n{log.read_text()}")

    def drain(self, node: Node, within_s: int = 60) -> None:
        """Tell Ray that a node is about to be taken away, as the notice of a spot machine does."""
        command: list[str | Path] = [
            BIN / "ray", "drain-node", "--address", self.address, "--node-id", node.node_id,
            "--reason", "DRAIN_NODE_REASON_PREEMPTION", "--reason-message", "a test",
            "--deadline-remaining-seconds", str(within_s),
        ]  # fmt: skip
        done = self.run(command)
        assert done.returncode == 0, done.stderr

    def run(
        self, command: Sequence[str | Path], *, timeout_s: float = 400, **environment: str
    ) -> subprocess.CompletedProcess[str]:
        process = self.begin(command, **environment)
        try:
            out, err = process.communicate(timeout=timeout_s)
        finally:
            kill_group(process)
        return subprocess.CompletedProcess(command, process.returncode, out, err)

    def begin(self, command: Sequence[str | Path], **environment: str) -> subprocess.Popen[str]:
        """Start a command with the cluster's environment, in a folder that holds none of our code."""
        return subprocess.Popen(
            [str(part) for part in command], env={**self.environment, **environment}, cwd=self.folder,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip

    def stop(self) -> None:
        """End every node, the head last, and whatever else still names the cluster's folder."""
        for node in reversed(self.nodes.values()):
            node.stop()
        deadline = time.monotonic() + STOP_TIMEOUT_S
        while (left := processes_naming(str(self.temporary))) and time.monotonic() < deadline:
            time.sleep(0.2)
        for pid in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        shutil.rmtree(self.temporary, ignore_errors=True)
        assert not left, f"processes outlived their node and had to be ended: {left}"
