"""What the Docker files promise, read from them."""

import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
from image import read_compose, read_dockerfile
from served import Served

from tune_jobs.cli.serve_command import serve

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
INSTRUCTIONS = read_dockerfile(DOCKER / "Dockerfile")


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return read_compose(DOCKER / "compose.yaml", {"RAY_AUTH_TOKEN": "secret"})


def rest_of(word: str) -> list[str]:
    return [instruction.rest for instruction in INSTRUCTIONS if instruction.word == word]


def copied() -> list[str]:
    return [source for rest in rest_of("COPY") for source in rest.split()[:-1]]


def test_the_image_runs_as_another_user_than_root() -> None:
    assert rest_of("USER") == ["tune"]
    words = [instruction.word for instruction in INSTRUCTIONS]
    assert "RUN" not in words[words.index("USER") :]


def test_the_base_and_every_package_are_pinned() -> None:
    (base,) = rest_of("FROM")
    assert base.startswith("python:3.11-slim-")
    installs = [command for rest in rest_of("RUN") for command in rest.split("&&") if "pip install" in command]
    assert len(installs) == 2
    assert all("--constraint constraints.txt" in command or "--no-deps" in command for command in installs)


def test_the_whole_package_is_copied_and_nothing_else_is_sent() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = [name.rstrip("*") for name in project["tool"]["setuptools"]["packages"]["find"]["include"]]
    assert set(packages) <= set(copied())
    assert project["project"]["readme"] in copied()
    licenses = [PurePosixPath(pattern).parts[0] for pattern in project["project"]["license-files"]]
    assert set(licenses) <= set(copied())
    rules = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line[:1] != "#"]
    assert rules[0] == "*"
    assert sorted(rule[1:] for rule in rules if rule.startswith("!")) == sorted(copied())
    assert all((ROOT / source).exists() for source in copied())


def test_the_secret_is_never_committed() -> None:
    ignored = (ROOT / ".gitignore").read_text().split()
    assert any(fnmatch("docker/.env", rule) for rule in ignored)


def test_without_a_token_nothing_starts() -> None:
    with pytest.raises(KeyError, match=r"RAY_AUTH_TOKEN: Write one to docker/\.env first"):
        read_compose(DOCKER / "compose.yaml", {})


def test_every_service_shows_the_token_and_shares_the_storage(compose: dict[str, Any]) -> None:
    (storage,) = [part for rest in rest_of("ENV") for part in rest.split() if part.startswith("TUNE_JOBS_STORAGE=")]
    services = compose["services"]
    for name, service in services.items():
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        if name == "database":
            continue
        assert service["environment"]["RAY_AUTH_MODE"] == "token"
        assert service["environment"]["RAY_AUTH_TOKEN"] == "secret"
        assert f"sweeps:{storage.partition('=')[2]}" in service["volumes"]
    assert "sweeps" not in str(services["database"]["volumes"])
    assert list(compose["volumes"]) == ["sweeps", "database"]


def test_no_port_is_published_but_the_services_for_this_machine(compose: dict[str, Any]) -> None:
    services = compose["services"]
    assert not any("network_mode" in service for service in services.values())
    assert [name for name, service in services.items() if "ports" in service] == ["service"]
    assert services["service"]["ports"] == ["127.0.0.1:8470:8470"]


def test_the_service_is_asked_for_what_it_has_and_stopped_after_sweeps_have_saved(compose: dict[str, Any]) -> None:
    service = compose["services"]["service"]
    program, command, *options = service["command"]
    assert (program, command) == ("tune-jobs", "serve")
    given = serve.make_context("serve", options).params
    assert (given["address"], given["host"], given["port"]) == ("ray://head:10001", "0.0.0.0", 8470)
    assert given["drain_s"] < int(service["stop_grace_period"].removesuffix("s"))
    assert f":{given['port']}/readyz" in service["healthcheck"]["test"][-1]
    assert (service["read_only"], service["tmpfs"]) == (True, ["/tmp"])
    # Without a setting, no other database; with the profile, the one beside it.
    assert service["environment"]["TUNE_JOBS_DATABASE"] == ""
    database = compose["services"]["database"]
    assert (database["profiles"], database["user"]) == (["postgresql"], "postgres")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert "postgresql" in extras
    assert any("['postgresql']" in rest for rest in rest_of("RUN"))


def test_the_health_check_of_the_service_says_what_is_ready(compose: dict[str, Any], tmp_path: Path) -> None:
    kind, python, *test = compose["services"]["service"]["healthcheck"]["test"]
    assert (kind, python) == ("CMD", "python")
    server = Served(tmp_path / "sweeps", "--spare-idle", "0")
    try:
        test[-1] = test[-1].replace("http://127.0.0.1:8470", server.url)
        assert subprocess.run([sys.executable, *test], check=False, timeout=60).returncode == 0
    finally:
        assert server.end() == 0
    assert subprocess.run([sys.executable, *test], check=False, capture_output=True, timeout=60).returncode != 0


def test_workers_scale(compose: dict[str, Any]) -> None:
    worker = compose["services"]["worker"]
    assert "container_name" not in worker
    assert "hostname" not in worker
    assert f"--num-cpus={worker['cpus']}" in worker["command"]


def test_the_services_agree_on_the_heads_ports(compose: dict[str, Any]) -> None:
    head, worker, launcher = (compose["services"][name] for name in ("head", "worker", "launcher"))
    assert "--port=6379" in head["command"]
    assert "--address=head:6379" in worker["command"]
    assert "--ray-client-server-port=10001" in head["command"]
    assert launcher["environment"]["RAY_ADDRESS"] == "ray://head:10001"
    assert launcher["profiles"] == ["launch"]
    for service in (head, worker):
        assert "head:6379" in " ".join(service["healthcheck"]["test"])
    for service in (worker, launcher):
        assert service["depends_on"] == {"head": {"condition": "service_healthy"}}
