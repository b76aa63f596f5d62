import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

from policies.errors import CannotRunError, SpecError
from tune_jobs.cli.commands import cli
from tune_jobs.ray_tune.address import check_address, place_of, recorded_cluster


@pytest.fixture
def ray_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine of which Ray knows nothing."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    (tmp_path / "ray").mkdir()
    return tmp_path / "ray"


@pytest.fixture
def listener() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@pytest.fixture
def dead_port() -> Iterator[int]:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        # Bound and not listening: refused, and nobody else can take it meanwhile.
        yield sock.getsockname()[1]


def test_an_address_where_something_listens_passes(
    ray_folder: Path, listener: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_address(f"127.0.0.1:{listener}")
    check_address(f"ray://127.0.0.1:{listener}")
    (ray_folder / "ray_current_cluster").write_text(f"127.0.0.1:{listener}\n")
    assert recorded_cluster() == f"127.0.0.1:{listener}"
    check_address("auto")
    (ray_folder / "ray_current_cluster").unlink()
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{listener}")
    check_address("auto")


@pytest.mark.parametrize("form", ["127.0.0.1:{}", "ray://127.0.0.1:{}"])
def test_a_dead_address_is_refused(dead_port: int, form: str) -> None:
    address = form.format(dead_port)
    with pytest.raises(CannotRunError, match="No Ray cluster answers at") as caught:
        check_address(address)
    assert address in caught.value.message
    assert "Connection refused" in caught.value.message


def test_an_unknown_host_is_refused() -> None:
    with pytest.raises(CannotRunError, match=r"No Ray cluster answers at no-such-host\.invalid:6379"):
        check_address("no-such-host.invalid:6379")


def test_auto_names_where_a_dead_address_comes_from(
    ray_folder: Path, dead_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = ray_folder / "ray_current_cluster"
    record.write_text(f"127.0.0.1:{dead_port}")
    with pytest.raises(CannotRunError, match=str(record)):
        check_address("auto")
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{dead_port}")
    with pytest.raises(CannotRunError, match="from RAY_ADDRESS"):
        check_address("auto")


def test_auto_in_the_environment_is_the_recorded_cluster_as_for_ray(
    ray_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "auto")
    with pytest.raises(CannotRunError, match="RAY_ADDRESS names none"):
        place_of("auto")
    (ray_folder / "ray_current_cluster").write_text("192.0.2.7:6379")
    assert place_of("auto") == ("192.0.2.7", 6379)


@pytest.mark.parametrize(
    "address",
    ["", "localhost", "host:", ":6379", "host:port", "host:99999", "http://host:8265", "ray://", "ray://[::1"],
)
def test_what_is_no_address_is_a_wrong_argument(ray_folder: Path, address: str) -> None:
    with pytest.raises(SpecError, match="is not the address of a Ray cluster"):
        check_address(address)


def test_launching_without_a_cluster_starts_and_writes_nothing(
    ray_folder: Path, tmp_path: Path, dead_port: int
) -> None:
    storage = tmp_path / "sweeps"
    for address, message in [
        ("auto", "No Ray cluster is known on this machine"),
        (f"127.0.0.1:{dead_port}", "No Ray cluster answers"),
        (f"ray://127.0.0.1:{dead_port}", "No Ray cluster answers"),
    ]:
        done = CliRunner().invoke(cli, ["launch", "cartpole-ppo", "--storage", str(storage), "--address", address])
        assert done.exit_code == 5
        assert message in done.stderr
        assert "Traceback" not in done.stderr
        assert not storage.exists()
