"""Runs a Dockerfile and the services of a compose file without a Docker engine.

The root file system of the "image" is this machine's own, seen through an overlay: what the commands write is kept in
memory and is gone at the end. The commands are run as they stand, in namespaces of their own (mounts and processes; the
services' network too), by the user the Dockerfile names. It takes root, and a Debian-like machine with Python.
"""

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import yaml

from tests.narrowing import present

TIMEOUT_S = 1800
# What a RUN may need to reach the package index of this machine.
_PASSED_ON = ("PIP_", "SSL_CERT_FILE", "REQUESTS_CA_BUNDLE", "HTTP_PROXY", "HTTPS_PROXY", "http_proxy", "https_proxy")
_NEEDED = ("unshare", "nsenter", "mount", "chroot", "setpriv", "ip", "groupadd", "useradd")


def why_not() -> str | None:
    """Why no image can be run on this machine; None if it can."""
    if os.geteuid() != 0:
        return "only root may mount an overlay"
    missing = [name for name in _NEEDED if shutil.which(name) is None]
    if missing:
        return f"these programs are missing: {', '.join(missing)}"
    try:
        with Root():
            return None
    except (OSError, AssertionError) as error:
        return f"an overlay of the root file system cannot be mounted: {error}"


@dataclass(frozen=True)
class Instruction:
    word: str
    rest: str


def read_dockerfile(path: Path) -> list[Instruction]:
    """The instructions, continued lines joined, comments dropped."""
    lines = [line for line in path.read_text().splitlines() if not line.lstrip().startswith("#")]
    text = re.sub(r"\\\n\s*", "", "\n".join(lines))
    parts = [line.split(None, 1) for line in text.splitlines() if line.strip()]
    return [Instruction(word.upper(), rest.strip()) for word, rest in parts]


def read_compose(path: Path, variables: dict[str, str]) -> dict[str, Any]:
    """The services, `${NAME:-default}`, `${NAME-default}` and `${NAME:?message}` replaced."""

    def replace(match: re.Match[str]) -> str:
        name, kind, rest = match.groups()
        if variables.get(name) or (kind == "-" and name in variables):
            return variables[name]
        if kind == ":?":
            raise KeyError(f"{name}: {rest}")
        return str(rest or "")

    text = "\n".join(line for line in path.read_text().splitlines() if not line.lstrip().startswith("#"))
    services: dict[str, Any] = yaml.safe_load(re.sub(r"\$\{(\w+)(?:(:[-?]|-)([^}]*))?\}", replace, text))
    return services


class Root:
    """A root file system that is thrown away, and the namespaces in which commands see it."""

    def __enter__(self) -> Self:
        script = """
            mount -t tmpfs -o size=16g tmpfs /mnt
            mkdir /mnt/upper /mnt/work /mnt/root
            mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root
            mount --rbind /dev /mnt/root/dev
            mount -t tmpfs tmpfs /mnt/root/dev/shm
            mount --rbind /sys /mnt/root/sys
            mount -t proc proc /mnt/root/proc
            mount -t tmpfs -o mode=1777 tmpfs /mnt/root/tmp
            # The image's Python is this machine's; another user than root has to get at it.
            chmod 711 /mnt/root/root
            # Debian's is called python3 alone.
            command -v python > /dev/null || ln -s "$(command -v python3)" /mnt/root/usr/local/bin/python
            printf '127.0.0.1 localhost head %s\\n' "$(hostname)" > /mnt/root/etc/hosts
            echo ready
            exec sleep infinity
        """
        self._keeper, self._inside = _hold(
            ["unshare", "--mount", "--pid", "--fork", "--kill-child"], ["sh", "-ec", script]
        )
        self._network: subprocess.Popen[str] | None = None
        self._children: list[subprocess.Popen[bytes]] = []
        self._enter = ["nsenter", f"--target={self._inside}", "--mount", "--pid"]
        return self

    def __exit__(self, *_: object) -> None:
        for process in [*self._children, self._network, self._keeper]:
            if process is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def cut_off(self) -> None:
        """From now on, commands share a network that has nothing but a loopback device."""
        self._network, inside = _hold(
            [*self._enter, "unshare", "--net"], ["sh", "-ec", "ip link set lo up; echo ready; exec sleep infinity"]
        )
        self._enter = [*self._enter, f"--net=/proc/{inside}/ns/net"]

    def begin(
        self,
        command: Sequence[str],
        *,
        environment: Mapping[str, str],
        workdir: str = "/",
        user: str | None = None,
        log: Path | None = None,
    ) -> subprocess.Popen[bytes]:
        """Start a command in the root; without a user as root, else as Docker would with all capabilities dropped."""
        become = []
        if user is not None:
            become = [
                "setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups", "--no-new-privs",
                "--bounding-set=-all", "--inh-caps=-all",
            ]  # fmt: skip
        inner = f"cd {shlex.quote(workdir)} && exec {shlex.join([*become, 'env', '-i'])} "
        inner += shlex.join([f"{name}={value}" for name, value in environment.items()]) + " " + shlex.join(command)
        with log.open("wb") if log is not None else contextlib.nullcontext(subprocess.PIPE) as out:
            process = subprocess.Popen(
                [*self._enter, "chroot", "/mnt/root", "sh", "-c", inner], stdin=subprocess.DEVNULL, stdout=out,
                stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        self._children.append(process)
        return process

    def run(self, command: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
        process = self.begin(command, **options)
        out, _ = process.communicate(timeout=TIMEOUT_S)
        return subprocess.CompletedProcess(command, process.returncode, out.decode(errors="replace"))

    def make_read_only(self, *writable: str) -> None:
        """From now on, nothing can be written but /tmp, /dev/shm, and these folders, which begin empty."""
        mounts = "; ".join(f"mkdir -p /mnt/root{path}; mount -t tmpfs tmpfs /mnt/root{path}" for path in writable)
        done = subprocess.run(
            [*self._enter, "sh", "-ec", f"{mounts}; mount -o remount,ro /mnt/root"],
            check=False, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr

    def path(self, path: str) -> Path:
        """A path of the root, as this process can reach it."""
        return Path(f"/proc/{self._inside}/root/mnt/root{path}")


def _hold(namespaces: list[str], command: list[str]) -> tuple[subprocess.Popen[str], int]:
    """Start a command that says `ready` and stays, in namespaces; returns its parent and its own process id."""
    process = subprocess.Popen(
        [*namespaces, *command], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    if present(process.stdout).readline() != "ready\n":
        process.kill()
        raise OSError(process.communicate()[1].strip())
    inside = process.pid
    while children := Path(f"/proc/{inside}/task/{inside}/children").read_text().split():
        inside = int(children[0])
    return process, inside


@dataclass
class Image:
    """What a Dockerfile makes."""

    root: Root
    environment: dict[str, str] = field(default_factory=dict)
    workdir: str = "/"
    user: str | None = None
    command: list[str] = field(default_factory=list)
    healthcheck: str = ""
    given: dict[str, str] = field(default_factory=dict)

    def build(self, dockerfile: Path, context: Path) -> None:
        """Run its instructions, those that begin with FROM apart: the base is this machine, with its Python.

        Raises:
            AssertionError: A command failed; with the end of what it printed.
        """
        self.given = dict(self.environment)
        arguments = {name: value for name, value in os.environ.items() if name.startswith(_PASSED_ON)}
        # torch comes from this machine's index, too: whichever build is there.
        arguments["TORCH_INDEX_URL"] = ""
        for instruction in read_dockerfile(dockerfile):
            getattr(self, f"_{instruction.word.lower()}")(instruction.rest, context, arguments)

    def _from(self, rest: str, context: Path, arguments: dict[str, str]) -> None:
        """A stage begins, on the base image: see `build`. What an earlier one made lies there already."""
        system = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
        self.environment = {**self.given, "PATH": f"{sys.base_prefix}/bin:{system}"}
        self.workdir = "/"

    def _arg(self, rest: str, context: Path, arguments: dict[str, str]) -> None:
        name, _, default = rest.partition("=")
        arguments.setdefault(name, default.strip('"'))

    def _env(self, rest: str, context: Path, arguments: dict[str, str]) -> None:
        for assignment in shlex.split(rest):
            name, _, value = assignment.partition("=")
            self.environment[name] = value.replace("$PATH", self.environment["PATH"])

    def _workdir(self, rest: str, context: Path, arguments: dict[str, str]) -> None:
        self.workdir = rest
        self._checked(["mkdir", "-p", rest])

    def _user(self, rest: str, context: Path, arguments: dict[str, str]) -> None:
        self.user = rest.partition(":")[0]

    def _healthcheck(self, rest: str, context: Path, arguments: dict[str, str]) -> None:
        self.healthcheck = rest.partition("CMD ")[2]

    def _cmd(self, rest: str, context: Path, arguments: dict[str, str]) -> None:
        self.command = json.loads(rest)

    def _copy(self, rest: str, context: Path, arguments: dict[str, str]) -> None:
        *sources, target = rest.split()
        if sources[0].startswith("--from="):
            # One root is all stages'.
            assert sources[1:] == [target], rest
            return
        folder = self.root.path(os.path.normpath(Path(self.workdir, target)))
        ignore = shutil.ignore_patterns("__pycache__")
        for source in sources:
            if (context / source).is_dir():
                shutil.copytree(context / source, folder, ignore=ignore)
            else:
                shutil.copy(context / source, folder / source)

    def _run(self, rest: str, context: Path, arguments: dict[str, str]) -> None:
        self._checked(["sh", "-ec", rest], arguments)

    def _checked(self, command: Sequence[str], arguments: dict[str, str] | None = None) -> None:
        environment = {**(arguments or {}), "HOME": "/root", **self.environment}
        done = self.root.run(command, environment=environment, workdir=self.workdir if "-p" not in command else "/")
        assert done.returncode == 0, f"{command} failed:\n{done.stdout[-4000:]}"

    def begin(
        self,
        command: Sequence[str],
        *,
        environment: Mapping[str, str],
        log: Path | None = None,
        workdir: str | None = None,
    ) -> subprocess.Popen[bytes]:
        """Start a command as a container of this image would."""
        return self.root.begin(
            command, environment={"HOME": "/home/tune", **self.environment, **environment},
            workdir=workdir or self.workdir, user=self.user, log=log,
        )  # fmt: skip

    def run(
        self, command: Sequence[str], *, environment: Mapping[str, str], workdir: str | None = None
    ) -> subprocess.CompletedProcess[str]:
        process = self.begin(command, environment=environment, workdir=workdir)
        out, _ = process.communicate(timeout=TIMEOUT_S)
        return subprocess.CompletedProcess(command, process.returncode, out.decode(errors="replace"))

    def wait_until_healthy(
        self, service: dict[str, Any], process: subprocess.Popen[bytes], log: Path, timeout_s: float = 300
    ) -> None:
        """Ask a service's health check until it passes."""
        kind, *test = service["healthcheck"]["test"]
        command = ["sh", "-c", *test] if kind == "CMD-SHELL" else test
        deadline = time.monotonic() + timeout_s
        while (done := self.run(command, environment=service["environment"])).returncode != 0:
            assert process.poll() is None, f"the service ended:\n{log.read_text()}"
            assert time.monotonic() < deadline, f"never healthy: {done.stdout}\n{log.read_text()}"
            time.sleep(1)

    def wait_until(
        self, command: Sequence[str], pattern: str, *, environment: Mapping[str, str], timeout_s: float = 120
    ) -> None:
        """Run a command until its output matches."""
        deadline = time.monotonic() + timeout_s
        while not re.search(pattern, (done := self.run(command, environment=environment)).stdout):
            assert time.monotonic() < deadline, f"{command} never said {pattern}: {done.stdout}"
            time.sleep(1)
