"""A sweep folder whose files are wrong in one place: every file, every field in it, many values."""

import copy
import functools
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from packed_members import random_member
from sweep_folders import make_sweep_folder

from analysis.records import ChangeRecord
from policies.packed.state import save_member
from tune_jobs.store.pack_files import Assignment, PackFiles
from tune_jobs.store.record_files import seal
from tune_jobs.sweeps import verbs as sweeps

CHECKPOINT = "trials/t0001/checkpoints/000006"
FILES = (
    "sweep.json", "trials/t0001/trial.json", "trials/t0001/results.jsonl", f"{CHECKPOINT}/manifest.json",
    f"{CHECKPOINT}/policy.json", "best/evaluation.json", "best/policy.json", "packs/p00.json",
    "member/state.json",
)  # fmt: skip

Place = tuple[str | int, ...]
"""Keys and indices on the way to a place in JSON-like data."""

WRONG: dict[str, Any] = {
    "null": None, "true": True, "a negative": -1, "zero": 0, "a fraction": 1.5, "64 bits": 2**64, "a huge int": 10**300,
    "a huge float": 1e308, "infinity": float("inf"), "no text": "", "a text": "x", "a digit": "7",
    "a path up": "../../precious", "a long text": "x" * 5_000, "a NUL": "a\0b", "a surrogate": "\ud800", "a list": [],
    "a list in lists": [[1]], "a mapping": {}, "a mapping of lists": {"x": [None]},
    "deep": functools.reduce(lambda inner, _: [inner], range(200), cast("Any", 0)),
}  # fmt: skip
"""Values that are right nowhere, or in few places."""

CONTENTS = {
    "nothing": b"", "half": b'{"format_version": 1, "na', "null": b"null", "a list": b"[]", "a number": b"7",
    "no text": b"\xff\xfe\x00", "NULs": b"\0" * 100, "an empty mapping": b"{}", "deep": b"[" * 100_000,
    "a number of many digits": b'{"format_version": ' + b"1" * 10_000 + b"}",
}  # fmt: skip
"""Files that are none of ours."""


def make_template(folder: Path) -> Path:
    """A sweep with every kind of file that there is."""
    store = make_sweep_folder(folder, iterations=6, seeds_per_point=1)
    change = ChangeRecord(
        iteration=3, num_env_steps=300, source_trial_id="t0000", source_iteration=2, before={"lr": 0.1},
        after={"lr": 0.2}, time=1.0,
    )  # fmt: skip
    trial = store.trial("t0001")
    trial.write_record(trial.read_record().model_copy(update={"changes": (change,), "notes": ("a line was damaged",)}))
    sweeps.best(folder, num_episodes=2)
    store.write_record(store.read_record().model_copy(update={"allowed_modules": ("json",), "address": "auto"}))
    PackFiles(folder, "p00").write(Assignment(("t0000",), {"t0000": 1}))
    member = random_member("t0000", hidden_sizes=[4])
    member.moments = {name: {key: np.zeros_like(value) for key, value in member.weights.items()} for name in
                      ("exp_avg", "exp_avg_sq")}  # fmt: skip
    save_member(member, folder / "member")
    return folder


def places(data: Any, at: Place = ()) -> Iterator[Place]:
    """Every place in JSON-like data; of a list the first item stands for all."""
    if at:
        yield at
    items = data.items() if isinstance(data, dict) else enumerate(data[:1]) if isinstance(data, list) else ()
    for key, value in items:
        yield from places(value, (*at, key))


def read(path: Path) -> Any:
    """The content of a file; of results the last line."""
    return json.loads(path.read_text().splitlines()[-1]) if path.suffix == ".jsonl" else json.loads(path.read_text())


def put(data: Any, at: Place, value: Any) -> Any:
    """A copy of JSON-like data that has a value at a place."""
    data = copy.deepcopy(data)
    target = data
    for key in at[:-1]:
        target = target[key]
    target[at[-1]] = value
    return data


def without(data: Any, at: Place) -> Any:
    """A copy of JSON-like data that lacks a place."""
    data = copy.deepcopy(data)
    target = data
    for key in at[:-1]:
        target = target[key]
    del target[at[-1]]
    return data


def write(path: Path, data: Any) -> None:
    """Replace a file, sealed and with its hash in its checkpoint's manifest, as somebody does who knows how."""
    if isinstance(data, dict) and "sha256" in data and path.name in {"manifest.json", "evaluation.json"}:
        data = data | {"sha256": seal(data)}
    if path.suffix == ".jsonl":
        lines = path.read_text().splitlines()
        path.write_text("".join(f"{line}\n" for line in [*lines[:-1], json.dumps(data)]))
    else:
        path.write_text(json.dumps(data))
    in_manifest(path)


def in_manifest(path: Path) -> None:
    """Have the manifest beside a file name what the file is by now."""
    manifest = path.with_name("manifest.json")
    if path != manifest and manifest.is_file():
        content, data = path.read_bytes(), json.loads(manifest.read_text())
        data["files"][path.name] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        manifest.write_text(json.dumps(data | {"sha256": seal(data)}))
