"""Arguments that JSON has no number for, in policy files."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from policy_factory import make_module_portable, make_portable

from policies.portable.file import read_policy, save_policy
from tests.narrowing import present

ARGS: dict[str, Any] = {
    "limit": math.inf, "bounds": [-math.inf, 1.5], "inner": {"gap": math.nan, "word": "Infinity", "empty": {}},
    "nothing": None,
}  # fmt: skip


def plain(text: str) -> Any:
    def refuse(word: str) -> Any:
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


def same(found: Any, wanted: Any) -> bool:
    return repr(found) == repr(wanted)  # NaN is not equal to itself


def test_arguments_of_an_env_are_read_back_as_they_were(tmp_path: Path) -> None:
    portable = dataclasses.replace(make_portable("CartPole-v1"), env_args=ARGS, training={"score": math.nan})
    description = plain(save_policy(portable, tmp_path).read_text())
    assert description["env_args"]["limit"] == {"$float": "Infinity"}
    assert description["training"] == {"score": None}
    read = read_policy(tmp_path)
    assert same(read.env_args, ARGS)
    assert same(read.training, {"score": None})


def test_numpy_s_are_read_back_as_python_s(tmp_path: Path) -> None:
    args = {"limit": np.float32(-np.inf), "bounds": np.array([np.inf, 0.0]), "size": np.int64(3)}
    save_policy(dataclasses.replace(make_portable("CartPole-v1"), env_args=args), tmp_path)
    assert same(read_policy(tmp_path).env_args, {"limit": -math.inf, "bounds": [math.inf, 0.0], "size": 3})


def test_arguments_of_a_network_are_read_back_as_they_were(tmp_path: Path) -> None:
    base = make_module_portable()
    module = dataclasses.replace(present(base.network.module), model_config=ARGS)
    portable = dataclasses.replace(base, network=dataclasses.replace(base.network, module=module))
    plain(save_policy(portable, tmp_path).read_text())
    assert same(present(read_policy(tmp_path).network.module).model_config, ARGS)
    assert same(module.model_config, ARGS)


def test_older_files_are_read_as_before(tmp_path: Path) -> None:
    path = save_policy(make_portable("CartPole-v1"), tmp_path)
    path.write_text(json.dumps(plain(path.read_text()) | {"env_args": {"limit": None, "word": {"$float": 1}}}))
    assert read_policy(tmp_path).env_args == {"limit": None, "word": {"$float": 1}}
