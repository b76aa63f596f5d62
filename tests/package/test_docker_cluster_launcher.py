"""The file for Ray's cluster launcher: Ray's own schema, and the token on every process. No cloud was asked."""

import copy
import json
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft7Validator  # type: ignore[import-untyped]

from tune_jobs.cli.commands import cli

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture
def config() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((ROOT / "docker" / "cluster-launcher" / "aws.yaml").read_text())
    return found


def problems(config: dict[str, Any]) -> list[str]:
    schema = json.loads((files("ray") / "autoscaler" / "ray-schema.json").read_text())
    return [f"{list(error.absolute_path)}: {error.message}" for error in Draft7Validator(schema).iter_errors(config)]


def test_it_is_of_rays_schema(config: dict[str, Any]) -> None:
    assert problems(config) == []
    from ray.autoscaler._private.util import prepare_config, validate_config

    # What `ray up` does before it asks the cloud.
    validate_config(prepare_config(copy.deepcopy(config)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("max_worker", 8),
        ("idle_timeout_minutes", "five"),
        ("auth", {"ssh_users": "ubuntu"}),
        ("available_node_types", {"head": {"resources": {"CPU": "0"}, "node_config": {}}}),
    ],
)
def test_a_wrong_field_is_found(config: dict[str, Any], field: str, value: object) -> None:
    assert problems({**config, field: value}) != []


def test_every_ray_process_shows_the_token_and_the_file_has_none(config: dict[str, Any]) -> None:
    started = [
        command
        for name in ("head_start_ray_commands", "worker_start_ray_commands")
        for command in config[name]
        if "ray start" in command
    ]
    assert len(started) == 2
    for command in started:
        assert "RAY_AUTH_MODE=token" in command.partition("ray start")[0]
        assert "RAY_AUTH_TOKEN" not in command
        assert "TUNE_JOBS_STORAGE=s3://" in command
    assert config["file_mounts"]["~/.ray/auth_token"] == "~/.ray/auth_token"
    head = started[0]
    assert "--dashboard-host=127.0.0.1" in head
    assert "--num-cpus=0" in head


def test_workers_are_spot_machines_and_the_head_is_not(config: dict[str, Any]) -> None:
    types = config["available_node_types"]
    head = types.pop(config["head_node_type"])
    assert "InstanceMarketOptions" not in head["node_config"]
    assert head["resources"]["CPU"] == 0
    for kind in types.values():
        assert kind["node_config"]["InstanceMarketOptions"] == {"MarketType": "spot"}
        assert kind["max_workers"] == config["max_workers"]
    for kind in (head, *types.values()):
        assert kind["node_config"]["MetadataOptions"]["HttpTokens"] == "required"
        assert "IamInstanceProfile" in kind["node_config"]


def test_from_outside_there_is_ssh_alone_for_one_address(config: dict[str, Any]) -> None:
    (rule,) = config["provider"]["security_group"]["IpPermissions"]
    assert (rule["FromPort"], rule["ToPort"]) == (22, 22)
    (source,) = rule["IpRanges"]
    assert source["CidrIp"].endswith("/32")


def test_what_is_installed_is_pinned_and_of_this_version(config: dict[str, Any]) -> None:
    installs = [
        command
        for name in ("setup_commands", "head_setup_commands")
        for command in config[name]
        if "pip install" in command
    ]
    assert all("--constraint ~/install/constraints.txt" in command for command in installs)
    wheel = f"tune_jobs-{PROJECT['version']}-py3-none-any.whl"
    assert config["file_mounts"][f"~/install/{wheel}"] == f"dist/{wheel}"
    assert any(f"{wheel}[cluster]" in command for command in installs)


def test_new_code_of_the_same_version_is_installed_too(config: dict[str, Any]) -> None:
    wheel = f"tune_jobs-{PROJECT['version']}-py3-none-any.whl"
    first, again = [command for command in config["setup_commands"] if wheel in command]
    assert "[cluster]" in first
    assert {"--no-deps", "--force-reinstall", f"~/install/{wheel}"} <= set(again.split())


def test_your_machine_gets_what_the_launcher_needs_too(config: dict[str, Any]) -> None:
    told = (ROOT / "docker" / "README.md").read_text().partition("## Virtual machines")[2].partition("\n## ")[0]
    commands = told.split("```")[1].splitlines()
    (install,) = [number for number, line in enumerate(commands) if line.startswith("pip install ")]
    words = commands[install].partition("#")[0].split()
    assert words[2:4] == ["--constraint", "constraints.txt"]
    head = {command.split()[-1] for command in config["head_setup_commands"]}
    pinned = {line.partition("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert {"boto3"} <= head <= set(words[4:]) <= pinned
    later = [line for line in commands if "python -m build" in line or "ray up" in line]
    assert "build" in words[4:]
    assert all(commands.index(line) > install for line in later)
    assert len(later) == 2


def test_the_first_sweep_waits_for_the_first_machine(config: dict[str, Any]) -> None:
    types = config["available_node_types"]
    assert types["head"]["resources"]["CPU"] == 0
    assert types["spot"]["min_workers"] == 0
    told = (ROOT / "docker" / "README.md").read_text()
    (command,) = [line for line in told.splitlines() if line.startswith("RAY_AUTH_MODE=token ray exec")]
    words = command.rstrip("'").partition("bin/tune-jobs launch ")[2].split()
    assert cli.commands["launch"].make_context("launch", words).params["wait_for_nodes"] > 0
