"""Files of a sweep that hold anything: what is asked of it is answered, or refused in our words."""

import contextlib
import itertools
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import odd_files
import pytest

from analysis.records import CheckpointRecord
from policies.acting.load import load_policy
from policies.envs import modules as env_modules
from policies.errors import TuneJobsError
from policies.packed.state import load_member
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.candidates import candidates
from tune_jobs.store.manifests import verify_checkpoint
from tune_jobs.store.pack_files import PackFiles
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import conclude as finish
from tune_jobs.sweeps import verbs as sweeps


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return odd_files.make_template(tmp_path_factory.mktemp("template") / "mine")


@pytest.fixture(autouse=True)
def _no_modules_stay_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env_modules, "_allowed", set())


@pytest.fixture
def folder(template: Path, tmp_path: Path) -> Path:
    return shutil.copytree(template, tmp_path / "mine")


def act(path: Path) -> None:
    load_policy(path).act(np.zeros(4))


def read_results(folder: Path) -> tuple[list[Any], list[CheckpointRecord]]:
    trial = SweepStore(folder).trial("t0001")
    return trial.read_iterations(), candidates(trial)


READERS = {
    "sweep.json": (lambda folder: stored_spec(SweepStore(folder).read_record()),),
    "trials/t0001/trial.json": (lambda folder: SweepStore(folder).trial("t0001").read_record(),),
    "trials/t0001/results.jsonl": (read_results,),
    f"{odd_files.CHECKPOINT}/manifest.json": (lambda folder: verify_checkpoint(folder / odd_files.CHECKPOINT),),
    f"{odd_files.CHECKPOINT}/policy.json": (lambda folder: act(folder / odd_files.CHECKPOINT),),
    "best/evaluation.json": (lambda folder: SweepStore(folder).read_best(),),
    "best/policy.json": (lambda folder: act(folder / "best"),),
    "packs/p00.json": (lambda folder: PackFiles(folder, "p00").read(),),
    "member/state.json": (lambda folder: load_member(folder / "member", "t0000"),),
}
"""What reads each file, and little else: it is asked thousands of times."""


def problems(
    folder: Path, template: Path, file: str, make: Callable[[Path], None], ask: Callable[[Path], object]
) -> Iterator[str]:
    """Errors that are none of ours, where a file was made wrong; it is mended afterwards."""
    try:
        make(folder / file)
        ask(folder)
    except TuneJobsError as error:
        if not error.message.strip() or len(str(error)) > 2_000:
            yield f"{type(error).__name__} of {len(str(error))} characters"
    except Exception as error:  # noqa: BLE001 (that there is none is what is tested)
        yield repr(error)[:200]
    finally:
        for name in {file, str((folder / file).with_name("manifest.json").relative_to(folder))}:
            if (template / name).exists():
                shutil.copyfile(template / name, folder / name)


@pytest.mark.parametrize("file", odd_files.FILES)
def test_every_field_of_every_file_may_hold_anything(folder: Path, template: Path, file: str) -> None:
    """A third of the values for each field, the next third for the next one."""
    data, values = odd_files.read(template / file), itertools.cycle(odd_files.WRONG.items())
    found: dict[str, Any] = {}
    for at, ask in itertools.product(odd_files.places(data), READERS[file]):
        some = itertools.islice(values, len(odd_files.WRONG) // 3 + 1)
        changed = {name: odd_files.put(data, at, value) for name, value in some}
        changed["gone"] = odd_files.without(data, at)
        for name, content in changed.items():
            for problem in problems(folder, template, file, lambda path: odd_files.write(path, content), ask):  # noqa: B023
                found.setdefault(problem, []).append((at, name))
    assert not found


@pytest.mark.parametrize("content", odd_files.CONTENTS)
def test_every_file_may_be_none_of_ours(folder: Path, template: Path, content: str) -> None:
    def make(path: Path) -> None:
        path.write_bytes(odd_files.CONTENTS[content])
        odd_files.in_manifest(path)

    found = {
        file: list(itertools.chain(*(problems(folder, template, file, make, ask) for ask in asked)))
        for file, asked in READERS.items()
    }
    assert not any(found.values()), found


class EarlyEndError(Exception):
    """What comes next would start Ray."""


@pytest.fixture
def resume(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], Any]:
    def early(*arguments: Any, **options: Any) -> None:
        raise EarlyEndError

    monkeypatch.setattr(sweeps, "run_sweep", early)

    def resume(folder: Path) -> None:
        with pytest.raises((EarlyEndError, TuneJobsError)):
            sweeps.resume(folder)

    return resume


@pytest.mark.parametrize("file", ["sweep.json", "trials/t0001/trial.json", "trials/t0001/results.jsonl"])
def test_a_sweep_with_anything_in_a_record_is_shown_and_resumed_or_refused(
    folder: Path, template: Path, file: str, resume: Callable[[Path], Any]
) -> None:
    """One value for each field, another for the next one."""
    data, values = odd_files.read(template / file), itertools.cycle(odd_files.WRONG.items())
    found: dict[str, Any] = {}
    for at in odd_files.places(data):
        name, value = next(values)
        readers: tuple[Callable[..., Any], ...] = (sweeps.trials, sweeps.dataframe, resume)
        for ask in readers:
            changed = odd_files.put(data, at, value)
            for problem in problems(folder, template, file, lambda path: odd_files.write(path, changed), ask):  # noqa: B023
                found.setdefault(problem, []).append((at, name, ask.__name__))
        shutil.copyfile(template / "sweep.json", folder / "sweep.json")
        for record in template.glob("trials/*/trial.json"):
            shutil.copyfile(record, folder / record.relative_to(template))
    assert not found


@pytest.mark.parametrize("content", ["null", "a list", "no text"])
@pytest.mark.parametrize("file", READERS)
def test_the_best_of_a_sweep_with_a_file_that_is_none_of_ours_is_chosen_or_refused(
    folder: Path, template: Path, file: str, content: str
) -> None:
    (folder / file).write_bytes(odd_files.CONTENTS[content])
    for ask in (
        lambda folder: sweeps.best(folder, num_episodes=1),
        lambda folder: sweeps.evaluate(f"{folder}/t0001", num_episodes=1),
        finish.find_checkpoint,
    ):
        with contextlib.suppress(TuneJobsError):
            ask(folder)


def test_a_sweep_that_cannot_be_read_does_not_hide_the_others(
    folder: Path, template: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = shutil.copytree(template, folder.parent / "other")
    (other / "sweep.json").write_text("[]")
    assert [status.sweep.name for status in sweeps.list_sweeps(folder.parent)] == ["mine"]
    assert "other/sweep.json" in caplog.text


@pytest.mark.parametrize(
    "name",
    ["../../x", "..", "/", "...", "a\0b", "\ud800", "~nobody-of-this-name/x", "x" * 5_000, "x/" + "y" * 300],
    ids=lambda name: ascii(name)[:30],
)
@pytest.mark.parametrize(
    "verb", ["status", "trials", "dataframe", "best", "report", "stop", "resume", "restore", "evaluate", "video"]
)
def test_a_sweep_is_called_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TuneJobsError):
        getattr(sweeps, verb)(name)
    with pytest.raises(TuneJobsError):
        load_policy(name)
    with contextlib.suppress(TuneJobsError):
        sweeps.list_sweeps(name)
    assert not list(tmp_path.iterdir())


# -- weights


def damage_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(content)
    for index in rng.integers(len(damaged), size=4):
        damaged[index] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


@pytest.mark.parametrize("seed", range(3))
def test_weights_that_are_damaged_are_refused(folder: Path, seed: int) -> None:
    """Also by somebody who knows which hash stands where."""
    from hashlib import sha256

    rng = np.random.default_rng(seed)
    path = folder / "best" / "policy.safetensors"
    whole, description = path.read_bytes(), json.loads(path.with_suffix(".json").read_text())
    for length in (0, 1, 8, 20, len(whole) - 1, len(whole)):
        path.write_bytes(damage_bytes(whole, rng) if length == len(whole) else whole[:length])
        with pytest.raises(TuneJobsError, match="SHA-256"):
            load_policy(path)
        description["weights_sha256"] = sha256(path.read_bytes()).hexdigest()
        path.with_suffix(".json").write_text(json.dumps(description))
        with contextlib.suppress(TuneJobsError):
            act(path)


@pytest.mark.parametrize("dtype", [np.float64, np.int32, np.bool_, np.float16])
@pytest.mark.parametrize("shape", [None, (), (0,), (3, 3, 3)])
def test_weights_of_other_types_and_shapes_are_taken_or_refused(
    folder: Path, dtype: type[np.generic], shape: tuple[int, ...] | None
) -> None:
    from hashlib import sha256

    from safetensors.numpy import load, save

    path = folder / "best" / "policy.safetensors"
    tensors = load(path.read_bytes())
    for name, value in tensors.items():
        changed = tensors | {name: np.ones(value.shape if shape is None else shape, dtype)}
        path.write_bytes(save(changed))
        description = json.loads(path.with_suffix(".json").read_text())
        description["weights_sha256"] = sha256(path.read_bytes()).hexdigest()
        path.with_suffix(".json").write_text(json.dumps(description))
        if shape is None:
            act(path)
        else:
            with pytest.raises(TuneJobsError, match=r"Wrong policy file .*policy\.json"):
                act(path)
