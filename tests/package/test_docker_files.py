"""What the Docker files promise, read from them."""

import json
import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
from image import read_compose, read_dockerfile
from jsonschema import Draft202012Validator  # type: ignore[import-untyped]
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
    return [source for rest in rest_of("COPY") for source in rest.split()[:-1] if not rest.startswith("--from=build ")]


def test_the_image_runs_as_another_user_than_root() -> None:
    assert rest_of("USER") == ["10001:10001"]
    (made,) = [rest for rest in rest_of("RUN") if "useradd" in rest]
    assert "--uid 10001 --gid tune" in made
    assert "groupadd --gid 10001 tune" in made
    words = [instruction.word for instruction in INSTRUCTIONS]
    assert "RUN" not in words[words.index("USER") :]


def test_the_base_and_every_package_are_pinned() -> None:
    build, base = rest_of("FROM")
    assert base.startswith("python:3.11-slim-")
    assert build == f"{base} AS build"
    installs = [command for rest in rest_of("RUN") for command in rest.split("&&") if "pip install" in command]
    assert len(installs) == 3
    assert all("--constraint constraints.txt" in command or "--no-deps" in command for command in installs)


def test_torch_is_its_cpu_build_unless_the_argument_is_empty() -> None:
    argument, default = rest_of("ARG")[0].split("=")
    assert (argument, default.strip('"').rpartition("/")[2]) == ("TORCH_INDEX_URL", "cpu")
    (install,) = [rest for rest in rest_of("RUN") if "--index-url" in rest]
    # Nothing else is taken from its index.
    assert install.startswith("pip install --no-compile --constraint constraints.txt --no-deps ")
    assert install.endswith(f'${{{argument}:+--index-url "${argument}"}} torch')
    built = [
        read_compose(DOCKER / "compose.yaml", {"RAY_AUTH_TOKEN": "secret", **given})["services"]["head"]["build"][
            "args"
        ]
        for given in ({}, {argument: ""})
    ]
    assert built == [{argument: default.strip('"')}, {argument: ""}]


def test_what_is_thrown_away_may_be_missing(tmp_path: Path) -> None:
    """Wheels of other platforms lack some of it, as TensorBoard's for ARM its second reader."""
    (thrown,) = [rest for rest in rest_of("RUN") if "tensorboard_data_server" in rest]
    commands = [command for command in thrown.split("&&") if command.split()[0] == "rm"]
    assert commands
    for command in commands:
        subprocess.run(["sh", "-ec", command], cwd=tmp_path, check=True)


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


def test_the_health_check_of_the_image_asks_a_node_or_a_service(compose: dict[str, Any]) -> None:
    (check,) = rest_of("HEALTHCHECK")
    # That of a node is answered by its agent, as Kubernetes' probe is.
    assert "then at=52365/api/local_raylet_healthz; else at=8470/readyz; fi" in check
    assert "http://127.0.0.1:$at" in check
    for name, service in compose["services"].items():
        # A launcher ends with its command.
        assert ("disable" in service["healthcheck"]) == (name == "launcher")


def test_without_a_token_nothing_starts() -> None:
    with pytest.raises(KeyError, match=r"RAY_AUTH_TOKEN: Write one to docker/\.env first"):
        read_compose(DOCKER / "compose.yaml", {})


def test_every_service_shows_the_token_and_shares_the_storage(compose: dict[str, Any]) -> None:
    (storage,) = [part for rest in rest_of("ENV") for part in rest.split() if part.startswith("TUNE_JOBS_STORAGE=")]
    services = compose["services"]
    for name, service in services.items():
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["read_only"] is True
        assert service.get("user") != "root"
        assert any(mount.partition(":")[0] == "/tmp" for mount in service["tmpfs"])
        if name in ("database", "s3"):
            continue
        assert service["environment"]["RAY_AUTH_MODE"] == "token"
        assert service["environment"]["RAY_AUTH_TOKEN"] == "secret"
        assert f"sweeps:{storage.partition('=')[2]}" in service["volumes"]
        # Ray runs programs from there.
        assert "exec" in service["tmpfs"][0].partition(":")[2].split(",")
        assert service["environment"]["TUNE_JOBS_STORAGE"] == storage.partition("=")[2]
    assert services["database"]["volumes"] == ["database:/var/lib/postgresql/data"]
    assert services["s3"]["volumes"] == ["objects:/data"]
    assert list(compose["volumes"]) == ["sweeps", "service", "database", "objects"]


def test_the_bucket_is_where_every_process_looks_with_the_keys_of_its_server() -> None:
    variables = {
        "RAY_AUTH_TOKEN": "secret", "AWS_ACCESS_KEY_ID": "tune", "AWS_SECRET_ACCESS_KEY": "key",
        "TUNE_JOBS_STORAGE": "s3://sweeps/tune-jobs?endpoint=http://s3:8333",
    }  # fmt: skip
    services = read_compose(DOCKER / "compose.yaml", variables)["services"]
    server = services.pop("s3")
    assert (server["profiles"], server["user"]) == (["s3"], "1000:1000")
    # Conditional writes of several at once were not safe before 4.18.
    name, _, version = server["image"].partition(":")
    assert name == "chrislusf/seaweedfs"
    assert tuple(int(part) for part in version.split(".")) >= (4, 18)
    assert "ports" not in server
    assert "http://127.0.0.1:8333/healthz" in server["healthcheck"]["test"]
    assert server["environment"]["S3_BUCKET"] == "sweeps"
    readme = (DOCKER / "README.md").read_text()
    assert variables["TUNE_JOBS_STORAGE"] in readme
    for name, service in services.items():
        if name != "database":
            for variable in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
                assert service["environment"][variable] == server["environment"][variable] == variables[variable]
            assert service["environment"]["TUNE_JOBS_STORAGE"] == variables["TUNE_JOBS_STORAGE"]


def test_no_up_leaves_a_service_of_before_on_its_old_settings_or_begins_more_than_is_asked_for() -> None:
    readme = (DOCKER / "README.md").read_text()
    workers_later = re.findall(r"More workers later: `up ([^`]*)`", readme)
    # With no service named, `service` would begin too.
    assert [words.split()[-1] for words in workers_later] == ["worker"]
    with_database = re.findall(r"--profile postgresql up --detach (.*)", readme)
    assert len(with_database) == 2
    # Else a service that runs would stay on SQLite, and refuse the token that is in PostgreSQL.
    assert not any("--no-recreate" in words for words in with_database)


def schema() -> Draft202012Validator:
    """Compose's own, which this package carries."""
    path = files("check_jsonschema") / "builtin_schemas" / "vendor" / "compose-spec.json"
    return Draft202012Validator(json.loads(path.read_text()))


def test_the_compose_file_is_of_composes_schema(compose: dict[str, Any]) -> None:
    extension = {name: value for name, value in compose.items() if not name.startswith("x-")}
    assert [f"{list(error.path)}: {error.message}" for error in schema().iter_errors(extension)] == []
    assert {service["image"] for service in compose["services"].values() if "build" in service} == {"tune-jobs"}


@pytest.mark.parametrize(
    ("field", "value"),
    [("read_onli", True), ("cap_drop", "ALL"), ("healthcheck", {"tests": []}), ("cpus", {}), ("tmpfs", 3)],
)
def test_a_wrong_field_of_the_compose_file_is_found(field: str, value: object) -> None:
    compose = read_compose(DOCKER / "compose.yaml", {"RAY_AUTH_TOKEN": "secret"})
    compose["services"]["worker"][field] = value
    assert any(list(error.absolute_path)[:2] == ["services", "worker"] for error in schema().iter_errors(compose))


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
    assert given["wait_for_nodes"] > 0
    assert f":{given['port']}/readyz" in service["healthcheck"]["test"][-1]
    # A folder of its own: with sweeps in a bucket there is no other.
    assert f"service:{given['folder']}" in service["volumes"]
    assert any(f" {given['folder']}" in rest for rest in rest_of("RUN") if "install --directory --owner tune" in rest)
    # Without a setting, no other database; with the profile, the one beside it.
    assert service["environment"]["TUNE_JOBS_DATABASE"] == ""
    database = compose["services"]["database"]
    assert (database["profiles"], database["user"]) == (["postgresql"], "postgres")
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert "postgresql" in extras
    assert any("['postgresql']" in rest for rest in rest_of("RUN"))


def test_the_service_is_stopped_before_its_database_and_starts_without_one(compose: dict[str, Any]) -> None:
    needs = dict(compose["services"]["service"]["depends_on"])
    assert needs.pop("database") == {"condition": "service_healthy", "required": False}
    assert needs == {"head": {"condition": "service_healthy"}}
    # Which Compose reads since then.
    assert "Docker Compose 2.20.2 or newer" in (DOCKER / "README.md").read_text()


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


@pytest.mark.parametrize("name", ["head", "worker"])
def test_a_node_is_not_killed_while_ray_drains_it(compose: dict[str, Any], name: str) -> None:
    from ray._private.ray_constants import RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S as DRAIN_S

    assert int(compose["services"][name]["stop_grace_period"].removesuffix("s")) > DRAIN_S


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
    assert launcher["environment"]["RAY_API_SERVER_ADDRESS"] == "http://head:8265"
    assert launcher["profiles"] == ["launch"]
    for service in (head, worker):
        # `ray health-check` would load Ray each time.
        assert service["healthcheck"]["test"][:2] == ["CMD", "python"]
    asked = {name: " ".join(compose["services"][name]["healthcheck"]["test"]) for name in ("head", "worker")}
    assert "http://127.0.0.1:8265/api/gcs_healthz" in asked["head"]
    assert "('127.0.0.1', 10001)" in asked["head"]
    assert "http://127.0.0.1:52365/api/local_raylet_healthz" in asked["worker"]
    # Ray Jobs, for the containers alone.
    assert {"--include-dashboard=true", "--dashboard-host=0.0.0.0", "--dashboard-port=8265"} <= set(head["command"])
    for service in (worker, launcher):
        assert service["depends_on"] == {"head": {"condition": "service_healthy"}}
