"""Values that a caller gives a client: NumPy's are taken, and what JSON can't hold is the error of this machine."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_fixtures import alone  # noqa: F401 (a fixture)
from live_service import Live, live  # noqa: F401 (a fixture)
from services import FAKE
from sweep_folders import make_sweep_folder

from policies.errors import SpecError
from tune_jobs.client import Client
from tune_jobs.spec.file import load_spec
from tune_jobs.sweeps import verbs

# ruff: noqa: F811 - fixtures are named as arguments

NAN = float("nan")


@pytest.fixture
def client(live: Live) -> Iterator[Client]:
    make_sweep_folder(live.storage / "done")
    with Client(live.url) as made:
        yield made


def test_a_point_that_json_cannot_hold_is_refused_as_on_this_machine(client: Client, live: Live) -> None:
    told = []
    for inject in (
        lambda: client.inject("done", {"lr": NAN}),
        lambda: verbs.inject(live.storage / "done", {"lr": NAN}),
    ):
        with pytest.raises(SpecError) as raised:
            inject()
        told.append((raised.value.message, raised.value.hint))
    assert told == [("point: lr: nan is not a finite number", "Give a finite number.")] * 2
    with pytest.raises(SpecError, match=r"point: lr: .* of type set"):
        client.inject("done", {"lr": {0.5}})


def test_numbers_of_numpy_are_taken(client: Client) -> None:
    assert client.inject("done", {"lr": np.float32(0.5)}).arguments == {"point": {"lr": 0.5}}
    assert client.extend("done", np.int64(3)).arguments == {"to_num_samples": 5}  # type: ignore[arg-type]
    made = client.submit(FAKE, name="mine", priority=np.int64(4), tags=np.array(["a", "b"]))  # type: ignore[arg-type]
    assert made.job.priority == 4
    assert client.change("mine", priority=np.int64(5)).tags == ["a", "b"]  # type: ignore[arg-type]
    assert client.job(made.job.id).priority == 5
    top, seeds = np.array([2, 1])
    assert client.replicate("done", top=top, seeds=seeds).arguments == {"top": 2, "seeds": 1}


WRONG: dict[str, Callable[[Client], object]] = {
    "priority: nan is not": lambda client: client.submit(FAKE, priority=NAN),  # type: ignore[arg-type]
    "wait_for_nodes: inf is not": lambda client: client.submit(FAKE, wait_for_nodes=float("inf")),
    r"tags: \[1\]: ": lambda client: client.submit(FAKE, tags=["a", b"b"]),  # type: ignore[list-item]
    r"overrides: \[0\]: nan": lambda client: client.plan(FAKE, overrides=[NAN]),  # type: ignore[list-item]
    "num_samples: nan is not": lambda client: client.extend("done", NAN),  # type: ignore[arg-type]
    "top: nan is not": lambda client: client.replicate("done", top=NAN),  # type: ignore[arg-type]
    "note: .* half a character": lambda client: client.change("done", note="\ud800"),
    "key: '.*' has characters": lambda client: client.submit(FAKE, key="\u043a\u043b\u044e\u0447"),
    r"key: 'a\\nb' has characters": lambda client: client.submit(FAKE, key="a\nb"),
}


@pytest.mark.parametrize("told", WRONG)
def test_what_cannot_be_sent_is_told_by_its_name(client: Client, live: Live, told: str) -> None:
    with pytest.raises(SpecError, match=f"^{told}"):
        WRONG[told](client)
    assert live.service.queue.jobs() == []


NO_LISTS: list[Any] = ["num_samples=2", b"num_samples=2", {"num_samples": 2}, None, 3]


@pytest.mark.parametrize("given", NO_LISTS)
def test_what_is_no_list_is_refused_in_the_words_of_this_machine(client: Client, live: Live, given: Any) -> None:
    with pytest.raises(SpecError) as here:
        load_spec(FAKE, given)
    tagged = here.value.message.replace("overrides", "tags")
    calls: list[tuple[str, Callable[[], object]]] = [
        (here.value.message, lambda: client.plan(FAKE, overrides=given)),
        (here.value.message, lambda: client.submit(FAKE, overrides=given)),
        (tagged, lambda: client.submit(FAKE, tags=given)),
    ]
    if given is not None:  # which leaves the tags as they are
        calls.append((tagged, lambda: client.change("done", tags=given)))
    for message, call in calls:
        with pytest.raises(SpecError) as there:
            call()
        assert (there.value.message, there.value.hint) == (message, here.value.hint)
    assert live.service.queue.jobs() == []
    assert client.sweep("done").tags == []


def test_lists_of_other_kinds_are_taken(client: Client) -> None:
    made = client.submit(FAKE, name="mine", overrides=("num_samples=2",), tags=("a", "b"))
    assert client.spec(made.sweep)["num_samples"] == 2
    assert client.change("mine", tags=np.array(["c"])).tags == ["c"]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "source", ["", "env: CartPole-v1\nalgorithm: ppo\n" * 20, "x" * 300, Path("x" * 300), "a\0b", 3]
)
def test_what_can_be_no_source_is_refused_in_the_words_of_this_machine(
    client: Client, live: Live, source: Any, tmp_path: Path
) -> None:
    with pytest.raises(SpecError) as here:
        verbs.create(source, storage=tmp_path / "here")
    for call in (client.plan, client.submit):
        with pytest.raises(SpecError) as there:
            call(source)
        assert there.value.message == here.value.message
        # A client takes no SweepSpec.
        assert there.value.hint == here.value.hint.replace(" or a SweepSpec", "")
    assert live.service.queue.jobs() == []
