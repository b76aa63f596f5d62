"""What is said of nodes of a cluster that cannot take part; a node's answers are made here."""

import os
import pickle
import socket
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from sweep_folders import make_sweep_folder

from policies.errors import CannotRunError
from tune_jobs.ray_tune import node_checks
from tune_jobs.ray_tune.node_checks import Problem, problems_of, refuse
from tune_jobs.store import probe as probes
from tune_jobs.store.probe import FailedOperationError, answer, probing

OURS = {"python": "3.11.4", "tune-jobs": "1.0", "ray": "2.60.0", "torch": "2.9.0+cpu", "numpy": "2.3.0"}
FOLDER = "/mnt/sweeps/mine"


def problems(versions: dict[str, str | None] | None = None, *, same: bool = True, **told: Any) -> list[str]:
    theirs = {name: version for name, version in {**OURS, **(versions or {})}.items() if version is not None}
    answer = {"versions": theirs, "modules": {}, "question": "", **told}
    return [problem.text for problem in problems_of(answer, OURS, FOLDER, lambda _: same)]


def test_a_node_like_this_one_has_no_problem() -> None:
    assert problems() == []


def test_builds_of_torch_and_micro_versions_of_python_may_differ() -> None:
    assert problems({"torch": "2.9.0+cu128", "python": "3.11.9"}) == []


@pytest.mark.parametrize(
    ("name", "version", "said"),
    [
        ("python", "3.12.4", "has Python 3.12.4"),
        ("ray", "2.59.0", "has Ray 2.59.0"),
        ("torch", "2.8.0+cpu", "has torch 2.8.0+cpu"),
        ("numpy", None, "has no numpy"),
    ],
)
def test_a_version_that_matters_is_named_with_ours(name: str, version: str | None, said: str) -> None:
    assert problems({name: version}) == [f"{said}, {socket.gethostname()} has {OURS[name]}"]


def test_what_another_tune_jobs_finds_in_the_storage_says_nothing() -> None:
    found = problems({"tune-jobs": "2.0", "numpy": "1.0"}, same=False, failed=("write", "it is full"))
    assert [text.split(",")[0] for text in found] == ["has tune-jobs 2.0", "has numpy 1.0"]
    assert problems({"tune-jobs": "2.0"}, not_working="ImportError: probe")[0].startswith("has tune-jobs 2.0")
    assert problems(not_working="ImportError: probe") == ["has no working tune-jobs: ImportError: probe"]


def test_the_storage_and_modules_are_named() -> None:
    lacks = {"my_envs": "ModuleNotFoundError: No module named 'my_envs'"}
    assert problems(modules=lacks, failed=("delete", "Permission denied")) == [
        "cannot import the module my_envs: ModuleNotFoundError: No module named 'my_envs'",
        "cannot delete in the sweep folder /mnt/sweeps/mine: Permission denied",
    ]
    assert problems(unseen=True) == ["does not see the sweep folder /mnt/sweeps/mine"]
    assert problems(same=False) == ["sees another folder under the name /mnt/sweeps/mine"]


def test_a_node_whose_pytorch_cannot_use_its_gpus_is_named() -> None:
    told = {"versions": {"torch": "2.9.0+cpu"}, "uses_gpus": False}
    [problem] = node_checks.problems_of_gpus(told, 2)
    assert problem.text == "offers 2 GPUs, but its PyTorch 2.9.0+cpu is a build for CPUs alone"
    assert node_checks.problems_of_gpus({**told, "uses_gpus": True}, 2) == []


def test_up_to_five_nodes_are_named_and_the_others_counted() -> None:
    bad = {f"n{index}": [Problem("is old", "Renew it."), Problem("is slow", "Wait.")] for index in range(7)}
    with pytest.raises(CannotRunError) as caught:
        refuse(bad, 9)
    lines = caught.value.message.splitlines()
    assert lines[0] == "7 of 9 nodes cannot take part in the sweep:"
    assert lines[1] == "  Node n0 is old; is slow"
    assert lines[5:] == ["  Node n4 is old; is slow", "  and 2 more"]
    assert caught.value.hint == "Renew it. Wait."
    with pytest.raises(CannotRunError, match=r"^Node n0 is old; is slow\.\n"):
        refuse({"n0": bad["n0"]}, 9)
    refuse({}, 9)


def test_a_node_is_asked_for_what_it_has(tmp_path: Path) -> None:
    with probing(tmp_path) as probe:
        told = node_checks._question()(("numpy", "no-such-package"), ("json", "no_such_module"), probe.place, "node")
        assert probe.is_same(told["question"], "node")
    assert set(told["versions"]) == {"python", "numpy"}
    assert told["modules"] == {"no_such_module": "ModuleNotFoundError: No module named 'no_such_module'"}
    assert node_checks._question()((), (), probe.place, "node")["unseen"]


def test_what_is_written_too_late_hides_no_error_and_is_left_to_the_next_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    remove, times = Path.rmdir, [2]

    def removed_late(folder: Path) -> None:
        if times[0]:
            times[0] -= 1
            # A process of a node that was lost.
            (folder / "node.scratch").touch()
        remove(folder)

    monkeypatch.setattr(Path, "rmdir", removed_late)
    with probing(tmp_path) as probe:
        pass
    assert not Path(probe.place).exists()
    times[0] = 9
    with pytest.raises(KeyError, match="why"), probing(tmp_path):
        raise KeyError("why")
    assert [each.name for each in Path(probe.place).iterdir()] == ["node.scratch"]


@pytest.mark.parametrize("how", ["gone", "drained", "there"])
def test_a_node_that_leaves_while_it_is_asked_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    lost = {"NodeID": "5" * 56, "NodeManagerAddress": "10.0.0.7", "NodeManagerHostname": "seven", "Resources": {}}
    tables = [[lost], [] if how == "gone" else [lost]]
    monkeypatch.setattr(node_checks, "alive_nodes", lambda: tables.pop(0))
    task: Any = SimpleNamespace(options=lambda **_: task, remote=lambda *_: task)
    draining = ["5" * 56] if how == "drained" else []
    state = SimpleNamespace(state=SimpleNamespace(get_draining_nodes=lambda: draining))
    fake = SimpleNamespace(
        remote=lambda **_: lambda _: task, get=lambda *_, **__: 1 / 0, _private=SimpleNamespace(state=state)
    )
    monkeypatch.setattr(node_checks, "ray", fake)
    store = make_sweep_folder(tmp_path / "mine")
    with store.lock():
        if how == "there":
            with pytest.raises(CannotRunError, match=r"Node 10\.0\.0\.7 .* cannot run a worker: division by zero"):
                node_checks.check_nodes(store.place)
        else:
            assert node_checks.check_nodes(store.place) == ()


def test_a_node_with_locks_of_its_own_alone_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # As a file system does whose locks hold within one machine: another machine's lock is not seen.
    monkeypatch.setattr(probes, "_can_lock", lambda _: True)
    with probing(tmp_path) as probe, pytest.raises(FailedOperationError, match="another machine holds") as caught:
        answer(probe.place, "node")
    assert caught.value.operation == "lock"
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (copy.operation, copy.reason, copy.message) == ("lock", caught.value.reason, caught.value.message)


@pytest.mark.parametrize("operation", ["write", "list", "delete"])
def test_the_operation_that_fails_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, operation: str) -> None:
    def fail(*_: Any, **__: Any) -> Any:
        raise PermissionError(13, "Permission denied")

    with probing(tmp_path) as probe:
        where = {"write": (probes, "write_atomic"), "list": (Path, "iterdir"), "delete": (Path, "unlink")}[operation]
        with monkeypatch.context() as patched:
            patched.setattr(*where, fail)
            with pytest.raises(FailedOperationError) as caught:
                answer(probe.place, "node")
    assert (caught.value.operation, caught.value.reason) == (operation, "Permission denied")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_is_named(tmp_path: Path) -> None:
    with probing(tmp_path) as probe:
        Path(probe.place).chmod(0o500)
        with pytest.raises(FailedOperationError, match="cannot write: Permission denied"):
            answer(probe.place, "node")
        Path(probe.place).chmod(0o700)
